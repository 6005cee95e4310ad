"""Tungsten's scene files as typed objects, and the effects that a scene calls for."""

from tungsten_dip.scene.effects import (
    decision_of,
    effects_of,
    inspect_facts,
    inspect_text,
)
from tungsten_dip.scene.parse import load_scene
from tungsten_dip.scene.types import Scene

__all__ = [
    "Scene",
    "decision_of",
    "effects_of",
    "inspect_facts",
    "inspect_text",
    "load_scene",
]
