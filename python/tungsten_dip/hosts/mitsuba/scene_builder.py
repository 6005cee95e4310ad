"""The Mitsuba scene under construction: what the translators of every kind of object share."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from tungsten_dip.errors import InputError
from tungsten_dip.scene.types import Matrix, Scene

Node = dict[str, Any]
"""A dictionary for `mitsuba.load_dict`."""


@dataclass
class SceneBuilder:
    """Collects the nodes of the scene, each under its own id, and the albedo texture of every BSDF.

    Objects that Tungsten shares (a BSDF on two primitives, a medium in two) are made once, see `made`.
    ``place`` is the part of the file that is being translated, for messages.
    """

    source: Scene
    scene: Node = field(default_factory=lambda: {"type": "scene"})
    albedo: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    place: str = ""
    _made: dict[Hashable, Any] = field(default_factory=dict)
    _keep_alive: list[Any] = field(default_factory=list)

    def unsupported(self, construct: str) -> InputError:
        """Return the error for what Mitsuba cannot show as Tungsten does."""
        return self._error(
            f"{construct} has no counterpart in the embedded renderer; render with --host tungsten"
        )

    def refused(self, error: RuntimeError) -> InputError:
        """Return the error for what Mitsuba does not load."""
        reason = " ".join(str(error).split())
        return self._error(f"Mitsuba cannot load this ({reason}); mend it, or render with --host tungsten")

    def add(self, kind: str, node: Any) -> Any:
        """Add the object that a node describes (or the object) to the scene under its id, and return it."""
        # Without the underscore that names of children have: Mitsuba takes the same for a conflict.
        name = f"{kind}{len(self.scene)}"
        self.scene[name] = built = load({**node, "id": name}) if isinstance(node, dict) else node
        return built

    def made(self, key: tuple[Any, ...]) -> Any | None:
        """Return what was made for these objects and settings before, if it was."""
        return self._made.get(_hashable(key))

    def remember(self, key: tuple[Any, ...], result: Any) -> Any:
        """Keep a result for `made`, and the objects of the key, so that no other takes their identity."""
        self._keep_alive.append(key)
        self._made[_hashable(key)] = result
        return result

    def _error(self, message: str) -> InputError:
        place = f"{self.place}: " if self.place else ""
        return InputError(f"{self.source.path}: {place}{message}")


def load(node: Node) -> Any:
    """Return the object that a node describes.

    Raises RuntimeError if Mitsuba refuses it.
    """
    return mi.load_dict(node, parallel=False, optimize=False)


def constant(value: tuple[float, float, float] | float) -> Node:
    """Return a texture of one value: linear RGB or a number, of any size and sign."""
    return {
        "type": "rawconstant",
        "value": [float(v) for v in value] if isinstance(value, tuple) else float(value),
    }


def transform(matrix: Matrix) -> Any:
    """Return a 4x4 matrix as Mitsuba's transform."""
    return mi.ScalarTransform4f(np.asarray(matrix, dtype=np.float64).tolist())


def transform_uv(matrix: Matrix) -> Any:
    """Return a 3x3 matrix as Mitsuba's transform of UV."""
    return mi.ScalarTransform3f(np.asarray(matrix, dtype=np.float64).tolist())


def _hashable(key: tuple[Any, ...]) -> Hashable:
    return tuple(part if isinstance(part, str | int | float | None) else id(part) for part in key)
