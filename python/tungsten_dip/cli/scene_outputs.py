"""Which files a scene asks for, named and placed as Tungsten does, and writing them."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tungsten_dip.buffers.atomic import check_writable
from tungsten_dip.buffers.display import ldr_from_feature
from tungsten_dip.buffers.image_file import (
    MOST_HDR,
    RADIANCE_SUFFIXES,
    radiance_suffixes,
    with_known_suffix,
    write_image,
)
from tungsten_dip.buffers.layers import PLANES, planes_of_output
from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.scene.tonemap import display_from_radiance
from tungsten_dip.scene.types import OutputBuffer, Scene, TonemapName

_LOG = logging.getLogger(__name__)

_LDR = (".png",)
_HDR = RADIANCE_SUFFIXES


@dataclass(frozen=True)
class SceneOutputs:
    """Paths of what one scene writes.

    ``ldr`` (PNG) and ``hdr`` are the picture itself, None where it is not asked for; ``buffers`` are the
    scene's ``output_buffers``, their file names with their folder.
    """

    ldr: Path | None
    hdr: Path | None
    buffers: tuple[OutputBuffer, ...] = ()

    def beside(self, suffix: str) -> Path:
        """Return the path of a file beside the picture: its name without extension, then ``suffix``."""
        picture = self.ldr or self.hdr or Path("TungstenRender")
        return picture.with_name(picture.stem + suffix)

    def with_both_pictures(self) -> SceneOutputs:
        """Return the outputs with the picture written both displayed and as radiance."""
        return replace(self, ldr=self.ldr or self.beside(".png"), hdr=self.hdr or self.beside(".exr"))

    def denoised(self) -> tuple[Path, Path, Path]:
        """Return the paths of the denoised EXR and PNG, and of the noisy picture side by side with it."""
        names = ("_denoised.exr", "_denoised.png", "_side_by_side.png")
        exr, png, pair = (self.beside(name) for name in names)
        return exr, png, pair

    def preview(self) -> Path:
        """Return the path of the picture that is denoised before the render is done."""
        return self.beside("_preview.png")

    def numbered(self, denoise: bool, taken: Collection[Path]) -> SceneOutputs:
        """Return the outputs with the first number (none, 001, 002, ...) whose pictures do not exist.

        They are not ``taken`` either, of which the paths are resolved.

        As with Tungsten, buffers get no number. Numbers of Tungsten's may differ between the two pictures.
        """
        for index in itertools.count():
            ldr, hdr = (_numbered(path, index) for path in (self.ldr, self.hdr))
            outputs = replace(self, ldr=ldr, hdr=hdr)
            pictures = [*filter(None, (ldr, hdr)), *(outputs.denoised() if denoise else ())]
            if not any(path.exists() or path.resolve() in taken for path in pictures):
                break
        return outputs

    def files(self) -> Iterator[tuple[Path, str]]:
        """Yield the path of every file and what it holds."""
        if self.ldr is not None:
            yield self.ldr, "the picture"
        if self.hdr is not None:
            yield self.hdr, "color"
        for request in self.buffers:
            yield from ((path, request.type + PLANES[plane]) for plane, path in _files_of(request))

    def check(self) -> None:
        """Raise InputError if one of the files cannot be written, or would be written over another one."""
        for path in filter(None, [self.ldr, *(_path(buffer.ldr_output_file) for buffer in self.buffers)]):
            check_writable(path, *_LDR)
        for path in filter(None, [self.hdr, *(_path(buffer.hdr_output_file) for buffer in self.buffers)]):
            check_writable(path, *_HDR)
        held: dict[Path, str] = {}
        for path, content in self.files():
            other = held.setdefault(path.resolve(), content)
            if other != content:
                raise InputError(f"{path}: named for {other} and for {content}; name two files")


def scene_outputs(
    scene: Scene, output_directory: Path | None, ldr: Path | None, hdr: Path | None
) -> SceneOutputs:
    """Decide where a scene's files go; the last three arguments are the command line's, None if not given.

    The scene's names are relative to its ``output_directory``, that to the folder of the files it
    names. The command line's names are relative to its output directory, or else to the working directory.
    """
    renderer = scene.renderer
    folder = output_directory or (scene.input_directory or scene.path.parent) / renderer.output_directory
    own_folder = output_directory or Path()

    def placed(own: Path | None, name: str) -> Path | None:
        return own_folder / own if own else folder / name if name else None

    def in_folder(name: str, suffixes: tuple[str, ...]) -> str:
        return str(folder / _known(name, suffixes)) if name else ""

    buffers = tuple(
        replace(
            buffer,
            ldr_output_file=in_folder(buffer.ldr_output_file, _LDR),
            hdr_output_file=in_folder(buffer.hdr_output_file, radiance_suffixes(buffer.type)),
        )
        for buffer in renderer.output_buffers
    )
    return SceneOutputs(
        ldr=placed(ldr, _known(renderer.output_file, _LDR)),
        hdr=placed(hdr, _known(renderer.hdr_output_file, _HDR)),
        buffers=buffers,
    )


def _known(name: str, suffixes: tuple[str, ...]) -> str:
    """Return a scene's name of a file, of another type where that cannot be written.

    Raises InputError if it names no file.
    """
    if not name:
        return name
    if name.endswith("/") or Path(name).name.lower() in ("", "..", *suffixes):
        raise InputError(
            f"{name}: expected the name of a file such as picture{suffixes[0]}; correct the scene"
        )
    written = with_known_suffix(Path(name), suffixes)
    if written != Path(name):
        _LOG.warning(
            "%s: expected a name that ends in %s; written as %s", name, " or ".join(suffixes), written
        )
    return str(written)


def write_render(buffers: RenderBuffers, outputs: SceneOutputs, tonemap: TonemapName) -> None:
    """Write the picture and the buffers that the scene asks for.

    What it asks for and this render does not have, such as the halves of 1 spp, is removed where an earlier
    render left it: it would pass for this one's.
    """
    if outputs.hdr is not None:
        _write(outputs.hdr, buffers.color.mean)
    if outputs.ldr is not None:
        write_image(outputs.ldr, display_from_radiance(buffers.color.mean, tonemap))
    outdated = []
    for request in outputs.buffers:
        for plane, path in _files_of(request):
            array: FloatImage | None = getattr(buffers.get(request.type), plane, None)
            if array is not None:
                if path.suffix.lower() in _LDR and plane != "variance":
                    array = ldr_from_feature(request.type, array)
                _write(path, array)
            elif path.is_file():
                path.unlink()
                outdated.append(path.name)
    if outdated:
        _LOG.info("removed what an earlier render left and this one does not have: %s", ", ".join(outdated))


def _write(path: Path, image: FloatImage) -> None:
    """Write an image as far as its format holds it: a refusal would come after the render, and lose it."""
    if path.suffix.lower() == ".hdr":
        held = np.nan_to_num(image.clip(0, MOST_HDR), nan=0)
        if not np.array_equal(held, image):
            _LOG.warning("%s: holds 0 to %.2g; other values are clipped, NaN is 0; .exr does", path, MOST_HDR)
        image = held
    write_image(path, image)


def _files_of(request: OutputBuffer) -> Iterator[tuple[str, Path]]:
    """Yield the plane and the path of every file of a buffer."""
    for plane in planes_of_output(request.two_buffer_variance, request.sample_variance):
        for path in map(Path, filter(None, (request.hdr_output_file, request.ldr_output_file))):
            yield plane, path.with_name(path.stem + PLANES[plane] + path.suffix)


def _path(name: str) -> Path | None:
    return Path(name) if name else None


def _numbered(path: Path | None, index: int) -> Path | None:
    """Return ``name001.exr`` and so on, the path itself for number 0."""
    return path.with_name(f"{path.stem}{index:03d}{path.suffix}") if path is not None and index else path
