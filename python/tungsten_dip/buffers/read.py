"""Buffers from files: a folder of Tungsten's buffers, a scene that names them, or one image with many layers.

A file written by ``write_denoised`` reads like the input it was made from: its colour is the noisy picture
(layer ``noisy``), not the denoised one at the top level.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.buffers.image_file import MOST_CHANNELS, is_folder, read_parts, too_many_channels
from tungsten_dip.buffers.layers import (
    NOTHING,
    PLANES,
    Found,
    check_no_chroma,
    denoised_layer,
    find_layers,
    mapped_channels,
    names_quantity,
    view_layers,
)
from tungsten_dip.buffers.render_buffers import (
    CHANNELS,
    MOST_SPP,
    TRAITS,
    Buffer,
    FloatImage,
    RenderBuffers,
    are_counts,
)
from tungsten_dip.buffers.source import ADDED, FRAME, MAP, MOVED_TO, OWN, SPP, Channel, Part, Source
from tungsten_dip.buffers.tungsten_files import files_of_folder, files_of_scene
from tungsten_dip.errors import InputError

_LOG = logging.getLogger(__name__)

_CHANNELS = {q + suffix: traits.channels for q, traits in TRAITS.items() for suffix in PLANES.values()} | {
    "alpha": "A",
    "spp": "Y",
}
"""Channels as in `Traits`, by the key of --map."""

_OTHER_FILE = "save its file with what is expected"
"""What to do about the layers of a file whose layers --map does not choose."""


def read_buffers(path: str | Path, mapping: Mapping[str, str] | None = None) -> RenderBuffers:
    """Read what a renderer saved and log which layer was taken for which quantity.

    ``path`` is a folder with files named as Tungsten names them (``color.exr``, ``colorA.exr``, ...; also
    .pfm and .hdr), a Tungsten scene whose ``renderer.output_buffers`` names them, or one image, as a rule a
    multi-layer or multi-part EXR. ``mapping`` settles what its names leave open: ``{"color": "beauty"}``.
    Its keys are the quantities and ``alpha``, quantities also with ``A``, ``B`` (halves) and ``Variance``
    (of the mean). A value is a layer, a channel, channels joined by commas, for a folder a file name, or
    ``none``. What was given for the input of a denoised file still holds for what it leaves open. Values of
    pixels are not changed: nothing is sanitised.

    Raises InputError if a file is missing, damaged or no image, if sizes differ, or if there is no colour.
    """
    path = Path(path)
    if mapping is not None:
        _check_mapping(mapping)
    mapping = dict(mapping or {})
    if is_folder(path):
        excluded = {key: value for key, value in mapping.items() if value == NOTHING}
        return _from_images(path, *files_of_folder(path, mapping), excluded)
    if path.suffix.lower() == ".json":
        if mapping:
            raise InputError(f"{path}: a scene names its buffers itself; use --map with a folder or an image")
        return _from_images(path, *files_of_scene(path), {})
    source, attributes = _unwrapped(path, read_parts(path))
    # Halves and variance that were given for one mean are not those of another.
    means = tuple(key for key in mapping if key in CHANNELS)
    remembered = {key: value for key, value in source.mapping.items() if not key.startswith(means)}
    return _from_source(path, replace(source, mapping=remembered | mapping), attributes)


def _check_mapping(mapping: Any) -> None:
    expected = 'a dictionary of texts such as {"color": "beauty"}'
    if not isinstance(mapping, Mapping):
        raise InputError(f"mapping: expected {expected}, got {type(mapping).__name__}")
    for text in (*mapping.keys(), *mapping.values()):
        if not isinstance(text, str):
            raise InputError(f"mapping: expected {expected}, got {type(text).__name__} in it")


def read_image(path: str | Path) -> FloatImage:
    """Read the picture that a viewer would show: the top-level R, G, B (or Y) of the first part.

    Where there are none, as in files of Blender, it is the colour that `read_buffers` finds, or the denoised
    one beside it (`denoised_layer`). Returns linear radiance, float32, shape (height, width, 3).

    Raises InputError if the file is missing, damaged or no image, or if there is no colour.
    """
    path = Path(path)
    parts = read_parts(path)
    channels = parts[0].channels
    names = next((names for names in ("RGB", "Y") if all(name in channels for name in names)), None)
    if names is None:
        source, _ = _unwrapped(path, parts)
        denoised = denoised_layer(_full_names(source.parts))
        try:
            owner, found = _find_layers(replace(source, mapping={"color": denoised}) if denoised else source)
        except InputError as error:
            reason = str(error).partition("; ")[0]  # without a remedy that is none here
            raise InputError(
                f"{path}: expected R, G, B or Y, or a layer that is the picture ({reason}); name another file"
            ) from error
        color = found.channels["color"]
        return _plane(path, "color", color, owner, owner[color[0]][0])
    try:
        check_no_chroma(names, channels)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    image = np.stack([channels[name].astype(np.float32) for name in names], axis=-1)
    return np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))


def input_files(path: str | Path, mapping: Mapping[str, str] | None = None) -> list[Path]:
    """Return the files that `read_buffers` reads, whose change is a change of the input.

    Raises InputError if a folder or a scene does not name them.
    """
    path = Path(path)
    if is_folder(path):
        return list(files_of_folder(path, dict(mapping or {}))[0].values())
    if path.suffix.lower() == ".json":
        return [path, *files_of_scene(path)[0].values()]
    return [path]


def _from_images(
    path: Path, files: Mapping[str, Path], ignored: Sequence[str], excluded: Mapping[str, str]
) -> RenderBuffers:
    """Read one file per plane; each becomes a layer named as Tungsten names its file.

    ``excluded`` maps what is not read to ``none``.
    """
    images = {key: read_parts(file) for key, file in files.items()}
    color = images["color"][0]
    channels: dict[str, Channel] = {}
    ignored = list(ignored)
    for key, (first, *others) in images.items():
        if ADDED in first.attributes:
            raise InputError(
                f"{files[key]}: expected what was rendered, found a denoised image; move it away, or name it "
                "alone as the input, for the noisy image that it holds"
            )
        if first.window != color.window:
            raise InputError(_sizes_differ(str(files[key]), first, color))
        fitting = [first]
        for part in others:
            if part.window == color.window:
                fitting.append(part)
            else:
                ignored.append(f"{files[key].name}: {part.name}, of another size")
        channels |= _channels_of_file(key, fitting)
    if ignored:
        _LOG.info("ignored: %s", ", ".join(ignored))
    attributes = {key: value for part in reversed(images["color"]) for key, value in part.attributes.items()}
    # The name of a file says what it holds, whatever the names of its other layers and parts.
    named = {}
    for key, count in CHANNELS.items():
        top_level = mapped_channels(key, channels) if key in files else ()
        # Any other single channel of what has three may be an id.
        if len(top_level) >= count or top_level == (f"{key}.Y",):
            named[str(key)] = str(key)
    return _from_source(path, Source((Part(channels, attributes),), {**excluded, **named}), attributes)


def _channels_of_file(key: str, parts: Sequence[Part]) -> dict[str, Channel]:
    """Return the channels of one file of a folder, by names that are unique in the folder.

    Their layer is ``key``, except for layers of the colour's file that are not named for a quantity: its
    attributes, which travel with them, refer to some by name (Cryptomatte).
    """
    channels = {}
    for full_name, (part, name) in _full_names(parts).items():
        unique = name if part is parts[0] else full_name
        layer = unique.rpartition(".")[0]
        keeps_name = key == "color" and layer and not names_quantity(layer)
        channels[unique if keeps_name else f"{key}.{unique}"] = part.channels[name]
    return channels


def _unwrapped(path: Path, parts: tuple[Part, ...]) -> tuple[Source, dict[str, Any]]:
    """Undo what `write_layers` did: drop what it added, put back what it moved."""
    first, *others = parts
    attributes = first.attributes
    if ADDED not in attributes:
        return Source(parts), attributes
    try:
        moved = attributes[MOVED_TO] + "."
        channels = {
            name.removeprefix(moved): channel
            for name, channel in first.channels.items()
            if name not in attributes[ADDED]
        }
        mapping = {str(key): str(value) for key, value in json.loads(attributes[MAP]).items()}
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: its attributes {OWN}* are damaged; denoise the original input again"
        ) from error
    restored = Part(
        channels, {key: value for key, value in attributes.items() if not key.startswith(OWN)}, first.name
    )
    kept = tuple(part for part in (restored, *others) if part.channels)
    # Other tools take channels out, and leave the attributes as they are.
    names = _full_names(kept)
    mapping = {key: value if mapped_channels(value, names) else NOTHING for key, value in mapping.items()}
    source = Source(kept, mapping)
    try:
        _find_layers(source)
    except InputError:
        _LOG.warning("%s: holds the noisy colour no longer: the denoised one is taken for it", path)
        return Source((replace(restored, channels=first.channels), *others)), restored.attributes
    return source, attributes


def _find_layers(source: Source) -> tuple[dict[str, tuple[Part, str]], Found]:
    """Return the part and name of every channel, and what was recognised.

    Raises InputError as `layers.find_layers` does.
    """
    owner = _full_names(source.parts)
    default = source.parts[0].name if len(source.parts) > 1 else ""
    return owner, find_layers(owner, source.mapping, default)


def _from_source(path: Path, source: Source, attributes: Mapping[str, Any]) -> RenderBuffers:
    if any(len(part.channels) > MOST_CHANNELS for part in source.parts):
        raise InputError(f"{path}: {too_many_channels()}")
    try:
        owner, found = _find_layers(source)
    except InputError as error:
        reason = str(error) if _maps_layers(path) else f"{str(error).partition('; ')[0]}; {_OTHER_FILE}"
        raise InputError(f"{path}: {reason}") from None
    groups = dict(found.channels)
    main, _ = owner[groups["color"][0]]
    color_part = next(index for index, part in enumerate(source.parts) if part is main)
    attributes = {**attributes, **main.attributes}
    planes = {key: _plane(path, key, names, owner, main) for key, names in groups.items()}
    spp = attributes.get(SPP, attributes.get("samplesPerPixel"))
    spp = float(spp) if isinstance(spp, (int, float)) and 0 < spp <= MOST_SPP else None
    if "colorVariance" not in source.mapping:
        _settle_variance(groups, planes, spp)
    if "spp" in planes and not are_counts(planes["spp"]):
        del planes["spp"]
        _LOG.info("ignored: %s, because some values are no numbers of samples", _shown(groups["spp"]))
    buffers: dict[str, Any] = {"spp": planes.get("spp", spp)}
    _LOG.info("%s: %d x %d pixels", path, main.window[2], main.window[3])
    for quantity in CHANNELS:
        known = {field: quantity + suffix for field, suffix in PLANES.items() if quantity + suffix in planes}
        if "mean" in known:
            buffers[quantity] = Buffer(**{field: planes[key] for field, key in known.items()})
            taken = (f"{field} {_shown(groups[key])}" for field, key in known.items())
            _LOG.info("%s: %s", quantity, ", ".join(taken))
    if "alpha" in planes:
        buffers["alpha"] = planes["alpha"]
        _LOG.info("alpha: %s", groups["alpha"][0])
    if found.ignored:
        _LOG.info("ignored: %s", ", ".join(found.ignored))
    if "color" not in source.mapping:
        _warn_of_other_views(path, groups["color"], source.parts, owner)
    return RenderBuffers(
        **buffers,
        attributes={k: v for k, v in attributes.items() if k not in FRAME and not k.startswith(OWN)},
        source=replace(source, color_part=color_part, read=buffers),
    )


def _warn_of_other_views(
    path: Path, color: tuple[str, ...], parts: Sequence[Part], channel_names: Iterable[str]
) -> None:
    """Warn where a file holds several pictures, of which one is the colour."""
    views, several = _views(parts), view_layers(color, channel_names)
    if len(views) > 1:
        _LOG.warning(
            "%s: views %s: only %s is denoised, with features that are found by name; choose the layers of "
            "one view with --map, for each view in turn",
            path,
            ", ".join(views),
            _shown(color),
        )
    elif len(several) > 1:
        _LOG.warning(
            "%s: view layers %s: only %s is denoised; choose others with --map color=LAYER, each in turn",
            path,
            ", ".join(several),
            _shown(color),
        )


def _views(parts: Sequence[Part]) -> list[str]:
    """Return the names of the views, of a stereo pair for example, that a file's header says it holds."""
    named: list[Any] = []
    for part in parts:
        several = part.attributes.get("multiView")
        named += [*(several if isinstance(several, list) else ()), part.attributes.get("view")]
    return list(dict.fromkeys(name for name in named if isinstance(name, str)))


def _plane(
    path: Path, key: str, names: tuple[str, ...], owner: Mapping[str, tuple[Part, str]], main: Part
) -> FloatImage:
    """Make one image of channels of one key of --map. Raises InputError if their part differs in its window.

    ``main`` is the part that holds the colour.
    """
    sources = [owner[name] for name in names]
    channels = []
    for part, name in sources:
        if part.window != main.window:
            differ = _sizes_differ(f"{path}: {key}", part, main)
            raise InputError(differ if key == "color" else f"{differ}, or use --map {key}={NOTHING}")
        channels.append(part.channels[name])
    stacked = np.stack([channel.astype(np.float32) for channel in channels], axis=-1)
    plane = _with_channel_count(stacked, path, key, names)
    if plane is stacked:
        _share(stacked, sources)
    return plane


def _full_names(parts: Sequence[Part]) -> dict[str, tuple[Part, str]]:
    """The part and name of every channel by a name unique in the file: of several parts, each is a layer."""
    names = {}
    for part in parts:
        prefix = f"{part.name}." if len(parts) > 1 else ""
        # In a part "beauty" that holds both R and beauty.R, the latter is of a layer "beauty" within.
        nested = any(prefix + name in part.channels for name in part.channels)
        for name in part.channels:
            names[name if name.startswith(prefix) and not nested else prefix + name] = (part, name)
    return names


def _share(stacked: FloatImage, sources: list[tuple[Part, str]]) -> None:
    """Let channels that were read be views of the image made of them (`Part`).

    In place: what was read is freed image by image, whoever else holds its part.
    """
    for index, (part, name) in enumerate(sources):
        if part.channels[name].dtype == np.float32:
            part.channels[name] = stacked[..., index]


def _with_channel_count(image: FloatImage, path: Path, key: str, names: tuple[str, ...]) -> FloatImage:
    """Make one channel of equal ones, and red, green and blue of grey."""
    given, count = image.shape[2], len(_CHANNELS[key])
    if given == count:
        return image
    if count == 1 and all(np.array_equal(image[..., 0], image[..., k], equal_nan=True) for k in range(given)):
        return np.ascontiguousarray(image[..., :1])
    if _CHANNELS[key] == "RGB" and given == 1:
        return np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))
    remedy = f"choose with --map {key}=CHANNEL" if _maps_layers(path) else _OTHER_FILE
    raise InputError(f"{path}: {key}: expected {count} channels, found {', '.join(names)}; {remedy}")


def _maps_layers(path: Path) -> bool:
    """Whether --map chooses layers of an input: of a folder it chooses files, a scene takes none."""
    return path.suffix.lower() != ".json" and not is_folder(path)


def _settle_variance(
    groups: dict[str, tuple[str, ...]], planes: dict[str, FloatImage], spp: float | None
) -> None:
    """Make the variance of the mean of a layer that is merely called "Variance".

    pbrt-v4 saves the variance of one sample there (``GBufferFilm::GetImage`` in its film.cpp), and the
    number of samples as an attribute. Without that number (Arnold) the scale is unknown.
    """
    if not groups.get("colorVariance", ("",))[0].lower().startswith("variance."):
        return
    if spp:
        planes["colorVariance"] = planes["colorVariance"] / np.float32(spp)
        _LOG.info("Variance: of one sample, divided by %g samples per pixel", spp)
    else:
        del planes["colorVariance"]
        _LOG.info("ignored: Variance, of unknown scale; if it is of the mean: --map colorVariance=Variance")


def _shown(names: tuple[str, ...]) -> str:
    """Channels in short, such as albedo.RGB."""
    layer, dot, _ = names[0].rpartition(".")
    if any(name.rpartition(".")[0] != layer for name in names):
        return "+".join(names)
    return layer + dot + "".join(name.removeprefix(layer + dot) for name in names)


def _sizes_differ(label: str, part: Part, color: Part) -> str:
    got, expected = (
        f"{width} x {height} pixels from ({column}, {row})"
        for column, row, width, height in (part.window, color.window)
    )
    remedy = (
        "bring all to one data window" if part.window[2:] == color.window[2:] else "render all at one size"
    )
    return f"{label}: expected {expected} as the colour has, got {got}; {remedy}"
