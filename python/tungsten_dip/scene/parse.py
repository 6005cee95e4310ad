"""Reads a Tungsten scene file; every error in it is found here and reported in one line.

Follows Tungsten where it is lenient: comments and trailing commas are allowed, of two equal keys or names the
first is used, unknown fields are ignored (and reported once). Stricter than Tungsten where it would silently
render something else: missing files, numbers that are not finite, names of objects that do not exist.
"""

from __future__ import annotations

import dataclasses
import logging
import re
from collections import Counter
from collections.abc import Container
from itertools import chain
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from tungsten_dip.buffers.image_file import MAX_PIXELS
from tungsten_dip.errors import InputError
from tungsten_dip.json_file import object_from_json_file, shown
from tungsten_dip.scene.metals import ETA_AND_K
from tungsten_dip.scene.transforms import matrix_from_transform
from tungsten_dip.scene.types import (
    BitmapTexture,
    Bsdf,
    Camera,
    ConductorBsdf,
    ConstantTexture,
    InfiniteSphereCap,
    Instances,
    Integrator,
    Key,
    Matrix,
    Medium,
    Mesh,
    OutputBuffer,
    PhaseFunction,
    Placement,
    Primitive,
    Range,
    Renderer,
    RoughConductorBsdf,
    RoughWireBsdf,
    Scene,
    Texture,
    ThinlensCamera,
    Transmittance,
    VdbGrid,
    Vec3,
)

_LOG = logging.getLogger(__name__)

MAX_NESTED_BSDFS = 256
"""BSDFs that one BSDF may contain, each counted as often as it is named.

Bounds what a host must walk.
"""

# Names of the families of types in messages.
_FAMILIES: dict[type, str] = {
    Texture: "texture",
    Bsdf: "BSDF",
    Medium: "medium",
    PhaseFunction: "phase function",
    Transmittance: "transmittance",
    VdbGrid: "grid",
    Primitive: "primitive",
    Camera: "camera",
    Integrator: "integrator",
}

# Fields that are common in files and ignored by Tungsten: no reason for a warning.
_HARMLESS = {"type", "name", "bump_strength"}
# Lights without a surface have a BSDF in files written by Tungsten.
_HARMLESS_IN_LIGHTS = _HARMLESS | {"bsdf"}

_T = TypeVar("_T")


def load_scene(path: Path | str, input_directory: Path | str | None = None) -> Scene:
    """Read a scene file. Files that it names are searched in ``input_directory``, else beside it.

    Raises InputError, one line with the file, the place in it (such as ``primitives[3].bsdf``) and the
    remedy.
    """
    path = Path(path)
    return _read(_Parser(path, None if input_directory is None else Path(input_directory)))


def load_camera(path: Path | str) -> Camera:
    """Read the camera of a scene file; the textures and meshes that the scene names need not be there.

    Raises InputError as `load_scene` does.
    """
    return _read(_Parser(Path(path), None, files_exist=False)).camera


def _read(parser: _Parser) -> Scene:
    raw = object_from_json_file(parser.path)
    try:
        return parser.scene(raw)
    except RecursionError:
        raise InputError(f"{parser.path}: objects are nested too deeply; flatten the scene") from None


def _types_by_name(family: type[Any]) -> dict[str, type[Any]]:
    """Return every type of a family by its name in the file."""
    found: dict[str, type[Any]] = {family.kind: family} if family.kind else {}
    for derived in family.__subclasses__():
        found |= _types_by_name(derived)
    return found


_TYPES_BY_NAME = {family: _types_by_name(family) for family in _FAMILIES}


@dataclasses.dataclass(frozen=True)
class _Field:
    name: str
    annotation: Any
    required: bool


def _fields_by_key(cls: type[Any]) -> dict[str, _Field]:
    """Return the fields of a type by their key in the file."""
    hints = get_type_hints(cls, include_extras=True)
    found = {}
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        key = next(
            (mark.name for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, Key)), field.name
        )
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        found[key] = _Field(field.name, hint, required)
    return found


_FIELDS_BY_KEY = {
    cls: _fields_by_key(cls)
    for cls in (
        *chain.from_iterable(t.values() for t in _TYPES_BY_NAME.values()),
        Renderer,
        OutputBuffer,
        Placement,
    )
}


class _MissingFileError(InputError):
    """A file that the scene names does not exist."""


class _Parser:
    """The state while reading: the objects declared and the files named so far, and the fields ignored.

    ``files_exist``: a file that the scene names has to exist.
    """

    def __init__(self, path: Path, input_directory: Path | None, files_exist: bool = True) -> None:
        self.path = path
        self.files_exist = files_exist
        self.input_directory = input_directory
        self.folder = path.parent if input_directory is None else input_directory
        self.named: dict[type, dict[str, Any]] = {Bsdf: {}, Medium: {}}
        self.missing: list[_MissingFileError] = []
        self.nested_bsdfs: dict[Bsdf, int] = {}
        self.ignored: Counter[str] = Counter()
        self.files: set[Path] = set()

    def fail(self, where: str, expected: str, got: object, remedy: str) -> InputError:
        return InputError(f"{self.path}: {where}: expected {expected}, got {shown(got)}; {remedy}")

    def scene(self, raw: dict[str, Any]) -> Scene:
        """Read the parts in Tungsten's order: a name must be declared before it is used."""
        parts: dict[str, Any] = {}
        for key, family in (("media", Medium), ("bsdfs", Bsdf), ("primitives", Primitive)):
            items = []
            for index, value in enumerate(self.array(raw.get(key, []), key)):
                where = f"{key}[{index}]"
                item: Any
                try:
                    item = self.typed(family, value, where)
                    name = item.name
                    items.append(item)
                except _MissingFileError as missing:
                    # No error unless something uses it: `reference` raises it then.
                    if family not in self.named:
                        raise
                    item, name = missing, value.get("name", "")
                    self.missing.append(missing)
                if family in self.named and name:
                    if name in self.named[family]:
                        _LOG.warning(
                            "%s: %s: the name %s is taken; the first is used", self.path, where, shown(name)
                        )
                    self.named[family].setdefault(name, item)
            parts[key] = tuple(items)
        parts["primitives"] = self.with_suns_aimed(parts["primitives"])
        for key, single in (("camera", Camera), ("integrator", Integrator)):
            if key in raw:
                parts[key] = self.typed(single, raw[key], key)
        if "renderer" in raw:
            parts["renderer"] = self.fields(Renderer, raw["renderer"], "renderer")
        if isinstance(parts.get("camera"), ThinlensCamera):
            parts["camera"] = self.focused(parts["camera"], parts["primitives"])
        self.ignored.update(shown(key)[1:-1] for key in raw if key not in parts and key not in _HARMLESS)
        if self.ignored:
            listed = ", ".join(key if n == 1 else f"{key} ({n} times)" for key, n in self.ignored.items())
            _LOG.warning("%s: fields that Tungsten does not read are ignored: %s", self.path, listed[:500])
        for error in self.missing:
            _LOG.warning("%s (ignored: nothing uses it)", error)
        files = frozenset(self.files)
        return Scene(path=self.path, input_directory=self.input_directory, files=files, **parts)

    # --- Values by annotation ---

    def value(self, annotation: Any, value: Any, where: str) -> Any:
        """Read one value of the JSON by its annotation."""
        limits = None
        if get_origin(annotation) is Annotated:
            limits = next((mark for mark in annotation.__metadata__ if isinstance(mark, Range)), None)
            annotation = annotation.__origin__
        if get_origin(annotation) in (Union, UnionType):
            inner = next(option for option in get_args(annotation) if option is not type(None))
            return self.value(inner, value, where)
        if get_origin(annotation) is Literal:
            options = get_args(annotation)
            if not isinstance(value, str) or value not in options:
                raise self.fail(where, f"one of {', '.join(options)}", value, "choose one of them")
            return value
        if get_origin(annotation) is tuple:
            return self.tuple_of(get_args(annotation), value, where, limits)
        if annotation is float:
            return self.number(value, where, limits)
        if annotation is int:
            return self.integer(value, where, limits)
        if annotation is bool or annotation is str:
            if not isinstance(value, annotation):
                expected = "true or false" if annotation is bool else "a text"
                raise self.fail(where, expected, value, f"write {expected}")
            return value
        if annotation is Path:
            return self.file(value, where)
        if annotation == Matrix:
            return self.matrix(value, where)
        if annotation is Texture:
            return self.texture(value, where)
        if annotation in self.named and isinstance(value, str):
            return self.reference(annotation, value, where)
        if annotation in _FAMILIES:
            return self.typed(annotation, value, where)
        return self.fields(annotation, value, where)

    def array(self, value: Any, where: str) -> list[Any]:
        if value is None:
            return []
        if not isinstance(value, list):
            raise self.fail(where, "an array", value, "put it in [ ]")
        return value

    def tuple_of(
        self, inner: tuple[Any, ...], value: Any, where: str, limits: Range | None
    ) -> tuple[Any, ...]:
        if inner[-1] is Ellipsis:
            # The one kind of list that may be written without brackets, in Tungsten too.
            if inner[0] in (Bsdf, Path) and not isinstance(value, list):
                value = [value]
            return tuple(
                self.value(inner[0], v, f"{where}[{i}]") for i, v in enumerate(self.array(value, where))
            )
        values = value if isinstance(value, list) else [value] * len(inner)
        if len(values) != len(inner):
            raise self.fail(where, f"{len(inner)} numbers", value, "write one number, or all of them in [ ]")
        read = self.integer if inner[0] is int else self.number
        return tuple(read(v, where, limits) for v in values)

    def number(self, value: Any, where: str, limits: Range | None = None) -> float:
        largest = float(np.finfo(np.float32).max)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= largest:
            raise self.fail(where, "a finite number", value, "correct it")
        self.check_range(value, where, limits)
        return float(value)

    def integer(self, value: Any, where: str, limits: Range | None = None) -> int:
        # Tungsten truncates numbers.
        number = int(self.number(value, where)) if isinstance(value, float) else value
        self.number(number, where, limits)
        return int(number)

    def check_range(self, value: float, where: str, limits: Range | None) -> None:
        if limits is not None and not limits.lowest <= value <= limits.highest:
            lowest = "a number above 0" if 0.0 < limits.lowest < 1e-20 else f"at least {limits.lowest:g}"
            highest = "" if np.isinf(limits.highest) else f" and at most {limits.highest:g}"
            raise self.fail(where, lowest + highest, value, "correct it")

    def file(self, value: Any, where: str) -> Path:
        if not isinstance(value, str) or not value:
            raise self.fail(where, "the name of a file", value, "name the file")
        path = self.folder / value
        try:
            exists = not self.files_exist or path.exists()
        except (OSError, ValueError):
            exists = False
        if not exists:
            raise _MissingFileError(
                f"{self.path}: {where}: expected a file, found none at {str(path)!r:.300}; "
                "put it there or correct the name"
            )
        self.files.add(path)
        return path

    def matrix(self, value: Any, where: str) -> Matrix:
        if isinstance(value, list):
            if len(value) != 16:
                raise self.fail(where, "16 numbers", value, "write the matrix row by row")
            matrix = np.array([self.number(v, where) for v in value]).reshape(4, 4)
        elif isinstance(value, dict):
            keys = ("position", "look_at", "up", "x_axis", "y_axis", "z_axis", "scale", "rotation")
            self.note_ignored(value, keys, where, _HARMLESS)
            parts = {key: self.value(Vec3, value[key], f"{where}.{key}") for key in keys if key in value}
            try:
                matrix = matrix_from_transform(**parts)
            except ValueError as error:
                raise InputError(
                    f"{self.path}: {where}: expected axes with a direction, but {error}; "
                    "move look_at away from position"
                ) from None
        else:
            raise self.fail(where, "a transform object or 16 numbers", value, 'write {"position": [x, y, z]}')
        matrix.flags.writeable = False
        return matrix

    def texture(self, value: Any, where: str) -> Texture:
        if isinstance(value, str):
            return BitmapTexture(file=self.file(value, where))
        if isinstance(value, dict):
            return self.typed(Texture, value, where)
        return ConstantTexture(value=self.value(Vec3, value, where))

    def reference(self, family: type, name: str, where: str) -> Any:
        if name not in self.named[family]:
            what = "media" if family is Medium else "bsdfs"
            raise self.fail(
                where, f"the name of a {_FAMILIES[family]}", name, f"declare it in {what}, before its use"
            )
        found = self.named[family][name]
        if isinstance(found, _MissingFileError):
            raise found
        return found

    # --- Objects ---

    def typed(self, family: type[_T], value: Any, where: str) -> _T:
        """Read an object; its ``type`` selects the class."""
        what = _FAMILIES[family]
        if not isinstance(value, dict):
            raise self.fail(where, f"a {what} object", value, f'write {{"type": ...}} of the {what}')
        if "type" not in value:
            raise InputError(
                f'{self.path}: {where}: the {what} has no "type"; add one of {self.types(family)}'
            )
        if not isinstance(value["type"], str) or value["type"] not in _TYPES_BY_NAME[family]:
            raise self.fail(where, f"a known {what} type", value["type"], f"use one of {self.types(family)}")
        return self.fields(_TYPES_BY_NAME[family][value["type"]], value, where)  # type: ignore[no-any-return]

    def types(self, family: type) -> str:
        return ", ".join(sorted(_TYPES_BY_NAME[family]))

    def fields(self, cls: type[Any], value: Any, where: str) -> Any:
        """Read an object field by field, then check and combine what depends on several fields."""
        if not isinstance(value, dict):
            raise self.fail(where, "an object", value, "put its fields in { }")
        if cls is VdbGrid and "grid_name" in value:
            value = {"density_name": value["grid_name"], **value}
        if cls is Instances and isinstance(value.get("instances"), str):
            value = {"instancesA": value["instances"], **{k: v for k, v in value.items() if k != "instances"}}
        known = _FIELDS_BY_KEY[cls]
        is_light = issubclass(cls, Primitive) and "bsdf" not in known
        self.note_ignored(value, known, where, _HARMLESS_IN_LIGHTS if is_light else _HARMLESS)
        parts = {}
        for key, field in known.items():
            if key in value:
                parts[field.name] = self.value(field.annotation, value[key], f"{where}.{key}")
            elif field.required:
                raise InputError(f'{self.path}: {where}: the field "{key}" is missing; add it')
        self.settle(cls, parts, where)
        result = cls(**parts)
        if isinstance(result, Bsdf):
            self.limit_nesting(result, where)
        return result

    def note_ignored(
        self, value: dict[str, Any], known: Container[str], where: str, harmless: set[str]
    ) -> None:
        for key in value:
            if key not in known and key not in harmless:
                # One line for all elements of an array.
                self.ignored[re.sub(r"\[\d+\]", "[]", f"{where}.") + shown(key)[1:-1]] += 1

    def settle(self, cls: type, parts: dict[str, Any], where: str) -> None:
        if issubclass(cls, Camera):
            if "world_from_local" in parts:
                parts["world_from_local"] = _frozen(
                    parts["world_from_local"] @ np.diag([-1.0, 1.0, 1.0, 1.0])
                )
            width, height = parts.get("resolution", (1, 1))
            if min(width, height) < 1 or width * height > MAX_PIXELS:
                raise InputError(
                    f"{self.path}: {where}.resolution: expected 1 to {MAX_PIXELS} pixels, "
                    f"got {width} x {height}; choose a size that fits in memory"
                )
        elif cls in (ConductorBsdf, RoughConductorBsdf, RoughWireBsdf) and parts.get("material"):
            if parts["material"] not in ETA_AND_K:
                remedy = f"use one of {', '.join(ETA_AND_K)}, or give eta and k"
                raise self.fail(f"{where}.material", "the name of a material", parts["material"], remedy)
            parts["eta"], parts["k"] = ETA_AND_K[parts["material"]]
        elif cls in (ConductorBsdf, RoughConductorBsdf, RoughWireBsdf) and "eta" not in parts:
            # As in Tungsten, which reads both or none.
            parts.pop("k", None)
        elif cls is Mesh and not parts.get("bsdf", True):
            raise self.fail(f"{where}.bsdf", "at least one BSDF", [], "name one")
        elif cls is Instances:
            for index, placement in enumerate(parts.get("instances", ())):
                if placement.id >= len(parts.get("masters", ())):
                    raise self.fail(
                        f"{where}.instances[{index}].id", "the number of a master", placement.id, "correct it"
                    )

    def limit_nesting(self, bsdf: Bsdf, where: str) -> None:
        inner = [value for value in vars(bsdf).values() if isinstance(value, Bsdf)]
        count = 1 + sum(self.nested_bsdfs.get(value, 1) for value in inner)
        if count > MAX_NESTED_BSDFS:
            raise InputError(
                f"{self.path}: {where}: expected at most {MAX_NESTED_BSDFS} BSDFs within one another, "
                "got more; flatten it"
            )
        self.nested_bsdfs[bsdf] = count

    # --- References to primitives ---

    def with_suns_aimed(self, primitives: tuple[Primitive, ...]) -> tuple[Primitive, ...]:
        aimed = []
        for index, primitive in enumerate(primitives):
            if isinstance(primitive, InfiniteSphereCap) and primitive.skydome:
                dome = self.primitive_named(primitive.skydome, primitives, f"primitives[{index}].skydome")
                if dome is not None:
                    primitive = dataclasses.replace(primitive, world_from_local=dome.world_from_local)
            aimed.append(primitive)
        return tuple(aimed)

    def focused(self, camera: ThinlensCamera, primitives: tuple[Primitive, ...]) -> ThinlensCamera:
        pivot = None
        if camera.focus_pivot:
            pivot = self.primitive_named(camera.focus_pivot, primitives, "camera.focus_pivot")
        if pivot is None:
            return camera
        distance = np.linalg.norm(pivot.world_from_local[:3, 3] - camera.world_from_local[:3, 3])
        return dataclasses.replace(camera, focus_distance=float(distance))

    def primitive_named(self, name: str, primitives: tuple[Primitive, ...], where: str) -> Primitive | None:
        found = next((primitive for primitive in primitives if primitive.name == name), None)
        if found is None:
            _LOG.warning("%s: %s: no primitive is named %s; ignored", self.path, where, shown(name))
        return found


def _frozen(matrix: Matrix) -> Matrix:
    matrix.flags.writeable = False
    return matrix
