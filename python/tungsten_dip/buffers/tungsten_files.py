"""The files that Tungsten writes: which of a folder, or of those that a scene names, holds which buffer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from tungsten_dip.buffers.image_file import RADIANCE_SUFFIXES, radiance_suffixes, with_known_suffix
from tungsten_dip.buffers.layers import MAP_KEYS, NOTHING, PLANES, planes_of_output
from tungsten_dip.buffers.render_buffers import CHANNELS
from tungsten_dip.errors import InputError
from tungsten_dip.json_file import object_from_json_file

_SUFFIXES = tuple(PLANES.values())


def files_of_folder(folder: Path, mapping: Mapping[str, str]) -> tuple[dict[str, Path], list[str]]:
    """Return the file of every plane by its name (``color``, ``colorA``, ...), and what is ignored.

    ``mapping`` is as in `read_buffers`.

    Raises InputError if the folder or the mapping has no colour, or the mapping names what is not there.
    """
    try:
        present = sorted(file for file in folder.iterdir() if file.suffix.lower() in RADIANCE_SUFFIXES)
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed ({error.strerror}); check its permissions") from error
    present.sort(key=lambda file: RADIANCE_SUFFIXES.index(file.suffix.lower()))
    unknown = [key for key in mapping if key not in MAP_KEYS or key == "alpha"]
    if unknown:
        raise InputError(f"--map {unknown[0]}=...: expected one of {', '.join(MAP_KEYS[:-1])} for a folder")
    files = {}
    for quantity in CHANNELS:
        for suffix in _SUFFIXES:
            key = quantity + suffix
            if NOTHING in (mapping.get(key), mapping.get(quantity)):
                continue
            wanted = mapping.get(key, key)
            match = next((file for file in present if wanted in (file.name, file.stem)), None)
            if match is not None:
                files[key] = match
            elif key in mapping:
                raise InputError(f"--map {key}={wanted}: not in {folder}; there are {_names(present)}")
    for key, wanted in mapping.items():
        if wanted != NOTHING and key not in files:
            raise InputError(f"--map {key}={wanted}: there is no mean that this belongs to; map that too")
    if "color" not in files:
        raise InputError(
            f"{folder}: expected color.exr (.pfm, .hdr), found {_names(present)}; "
            "render with output_buffers, or use --map color=FILE"
        )
    return files, [file.name for file in present if file not in files.values()]


def is_named_for_a_plane(file: Path, mapping: Mapping[str, str]) -> bool:
    """Return whether `files_of_folder` takes such a file if it is there, with or without the map."""
    names = {*MAP_KEYS[:-1], *mapping.values()} - {NOTHING}
    return file.suffix.lower() in RADIANCE_SUFFIXES and not names.isdisjoint((file.name, file.stem))


def files_of_scene(path: Path) -> tuple[dict[str, Path], list[str]]:
    """Return the files that Tungsten writes for a scene, named as its ``OutputBuffer::save`` names them.

    They are returned as by `files_of_folder`.

    Raises InputError if the scene cannot be read or saves no colour, or files of its last render are missing.
    """
    scene = object_from_json_file(path)
    try:
        renderer = scene.get("renderer", {})
        folder = path.parent / renderer.get("output_directory", "")
        requests = renderer.get("output_buffers", [])
        files: dict[str, Path] = {}
        ignored = []
        later = None
        for request in requests:
            quantity, name = request["type"], request.get("hdr_output_file")
            if quantity not in CHANNELS or not name:
                ignored.append(f"output buffer {quantity} without hdr_output_file or of unknown type")
                continue
            file = with_known_suffix(folder / name, radiance_suffixes(quantity))
            settings = request.get("two_buffer_variance", False), request.get("sample_variance", False)
            for suffix in (PLANES[plane] for plane in planes_of_output(*settings)):
                files[quantity + suffix] = file.with_name(file.stem + suffix + file.suffix)
        if "color" not in files and renderer.get("hdr_output_file"):
            picture = with_known_suffix(folder / renderer["hdr_output_file"])
            if files and not renderer.get("overwrite_output_files", True):
                later = picture.with_name(f"{picture.stem}001{picture.suffix}")
            files["color"] = picture
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected renderer.output_buffers such as "
            '[{"type": "color", "hdr_output_file": "color.exr"}]; correct the scene'
        ) from error
    if "color" not in files:
        raise InputError(
            f'{path}: saves no colour; add {{"type": "color", "hdr_output_file": "color.exr"}} to '
            "renderer.output_buffers and render"
        )
    if later is not None and _is_file(later):
        # Pictures are numbered, buffers are not: those there are of the last render.
        raise InputError(
            f"{path}: expected one picture beside its buffers, found {later.name}, too; keep that of the "
            f"last render alone, as {files['color'].name}"
        )
    for quantity in CHANNELS:
        noise = [key for suffix in _SUFFIXES[1:] if (key := quantity + suffix) in files]
        if noise and not any(_is_file(files[key]) for key in noise):
            # A render of 1 spp has no halves. If some of these files are missing, it was cut short.
            ignored.append(f"{quantity}: no {', '.join(files.pop(key).name for key in noise)}")
    twice = [file for file, times in Counter(files.values()).items() if times > 1]
    if twice:
        raise InputError(f"{path}: expected one file for every buffer, got {twice[0].name} twice; rename one")
    missing = [file for file in files.values() if not _is_file(file)]
    if missing:
        raise InputError(f"{path}: saves {missing[0]}, which does not exist; render the scene first")
    return files, ignored


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # such as too long a name
        return False


def _names(files: Iterable[Path]) -> str:
    return ", ".join(file.name for file in files) or "no image"
