"""What a fit is asked to do, and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from tungsten_dip.buffers.model import FloatImage
from tungsten_dip.errors import InputError

if TYPE_CHECKING:
    from tungsten_dip.fit.model import Model

Preset = Literal["draft", "balanced", "final", "paper"]
Inputs = Literal["random", "normals", "depths", "albedos", "all", "all+random"]

RELMSE_EPSILON = 0.01
"""Keeps relMSE finite on black pixels; the value of Rousselle et al. 2011 (greedy error minimization)."""

PAPER_SETTINGS = ("network", "inputs", "scheme", "channels")
"""What the preset ``paper`` alone leaves open."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of one fit. None means: as the preset has it.

    ``pilot`` names a denoiser that somebody else trained, as one more guess that the halves judge like the
    others: Open Image Denoise, of the extra ``oidn``. ``network``, ``inputs``, ``scheme`` and ``channels``
    describe the network of the published method and are used by the preset ``paper`` alone. ``target_error``
    is a relMSE (epsilon 0.01). ``threads`` None uses every core.

    Raises InputError if a number is out of its range.
    """

    preset: Preset = "balanced"
    iterations: int | None = None
    time_budget_s: float | None = None
    target_error: float | None = None
    network: Literal["skip", "resnet"] = "skip"
    inputs: Inputs = "all+random"
    scheme: Literal["iic", "ioc"] = "iic"
    channels: tuple[int, ...] = (8, 16, 32, 64, 128)
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: int | None = None
    pilot: Literal["none", "oidn"] = "none"

    def __post_init__(self) -> None:
        for name in ("iterations", "time_budget_s", "target_error", "threads"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name}: expected a number above 0, got {value}")
        if not self.channels or any(count < 1 for count in self.channels):
            raise InputError(
                f"channels: expected positive counts such as 8,16,32,64,128, got {self.channels}"
            )


@dataclass(frozen=True)
class HistoryPoint:
    """Where a fit stood: what it had cost and how good it knew itself to be."""

    seconds: float
    iteration: int
    estimated_relmse: float | None


@dataclass(frozen=True)
class FitResult:
    """A denoised image and what is known about it.

    ``color`` is linear radiance, float32, shape (height, width, 3). ``estimated_relmse`` is the relMSE
    (with epsilon 0.01) that it is believed to have, and ``error`` tells where: the relative squared error
    around every pixel, shape (height, width, 1), the mean over 9x9 pixels. ``halves`` is what was made of
    half A of the samples alone and of half B alone, in the units and shape of ``color``, which is their
    mean (but for fireflies). These are None where the buffers hold no independent evidence. ``model`` is
    the fitted network, None where there was none to fit. ``interrupted`` tells that Ctrl-C ended the fit
    early. ``notes`` says in one line each what evidence was missing and what that meant.
    """

    color: FloatImage
    settings: FitSettings
    seconds: float
    iterations: int
    error: FloatImage | None = None
    estimated_relmse: float | None = None
    halves: tuple[FloatImage, FloatImage] | None = None
    model: Model | None = None
    history: tuple[HistoryPoint, ...] = ()
    interrupted: bool = False
    notes: tuple[str, ...] = field(default=())
