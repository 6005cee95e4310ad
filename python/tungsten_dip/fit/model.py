"""The network that a fit returns beside the image: later frames start from it, or use it as it is."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import FloatArray, RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.fit.layout import Layout
from tungsten_dip.fit.settings import NETWORK_SETTINGS, PAPER_SETTINGS, FitSettings
from tungsten_dip.fit.standardisation import Standardisation

Weights = dict[str, npt.NDArray[np.float32]]
"""Weights by name. Those of convolutions have shape (outputs, inputs, height, width)."""


@dataclass(frozen=True, eq=False)
class Blend:
    """What a network of the presets draft, balanced and final blends, and how its inputs are standardised.

    The constants of ``standardisation`` are those of the image that it was fitted to.
    """

    layout: Layout
    standardisation: Standardisation


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted network and all that is needed to use it on another image.

    That of the presets draft, balanced and final blends candidates pixel by pixel. The networks of the preset
    paper give the image themselves; for them ``blend`` is None.

    ``inputs`` names the network's inputs in order. Of the fit's ``settings``, only those that determine a
    network are kept; the others have their defaults, as in a model that was loaded. ``estimated_relmse`` is
    the error of the fit's result. ``source_sha256`` is the SHA-256 of the colour that the network was fitted
    to (float32, row by row), ``version`` that of this package.
    """

    inputs: tuple[str, ...]
    weights: Weights
    settings: FitSettings
    estimated_relmse: float | None
    source_sha256: str
    blend: Blend | None = None
    version: str = metadata.version("tungsten-dip")

    def __post_init__(self) -> None:
        kept = {name: getattr(self.settings, name) for name in NETWORK_SETTINGS}
        object.__setattr__(self, "settings", FitSettings(**kept))

    @property
    def kind(self) -> Literal["blend", "skip", "resnet"]:
        """What network it is."""
        return self.settings.network if self.is_paper else "blend"

    @property
    def is_paper(self) -> bool:
        """Whether it is a network of the preset paper, which gives the image itself."""
        return self.blend is None


def source_sha256(buffers: RenderBuffers) -> str:
    """Return the SHA-256 of the colour (float32, row by row), which identifies a noisy image."""
    return hashlib.sha256(np.ascontiguousarray(buffers.color.mean).data).hexdigest()


def check_settings(model: Model, settings: FitSettings) -> None:
    """Raise InputError that names the difference if the settings are not those of the model's network."""
    names = ("preset", "pilot", *(PAPER_SETTINGS if settings.preset == "paper" else ()))
    for name in names:
        expected, chosen = getattr(model.settings, name), getattr(settings, name)
        if chosen != expected:
            raise InputError(
                f"the model was fitted with {name} {_text(expected)}, this fit is to use {_text(chosen)}; "
                f"choose {_text(expected)}, or fit without the model"
            )


def check_inputs(model: Model, inputs: tuple[str, ...]) -> None:
    """Raise InputError that names the difference if an image's inputs are not the model's."""
    if inputs == model.inputs:
        return
    missing = [name for name in model.inputs if name not in inputs]
    unknown = [name for name in inputs if name not in model.inputs]
    differences = [
        f"{verb} {', '.join(names)}" for verb, names in (("lacks", missing), ("adds", unknown)) if names
    ]
    what = " and ".join(differences) or "has the inputs in another order"
    raise InputError(
        f"the input does not fit the model: it {what}; render the same buffers, or fit without the model"
    )


def check_finite(output: FloatArray) -> None:
    """Raise InputError if a network's output is not finite."""
    if not np.isfinite(output).all():
        raise InputError("the model gives no finite image: its weights are too large; fit a new one")


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
