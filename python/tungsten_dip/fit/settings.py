"""The settings of a fit, and its result."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral, Real
from typing import TYPE_CHECKING, Literal, get_args, get_origin, get_type_hints

from tungsten_dip.buffers.model import FloatImage, Halves
from tungsten_dip.errors import InputError

if TYPE_CHECKING:
    from tungsten_dip.fit.model import Model

Preset = Literal["draft", "balanced", "final", "paper"]
Inputs = Literal["random", "normals", "depths", "albedos", "all", "all+random"]

RELMSE_EPSILON = 0.01
"""Keeps relMSE finite on black pixels; the value of Rousselle et al. 2011 (greedy error minimization)."""

PAPER_SETTINGS = ("network", "inputs", "scheme", "channels")
"""What the preset ``paper`` alone leaves open."""


_WHOLE_NUMBERS = (("iterations", 1, 10**9), ("seed", 0, (1 << 63) - 1), ("threads", 1, 1024))
_MOST_SCALES = 8
_MOST_CHANNELS = 4096


@dataclass(frozen=True)
class FitSettings:
    """Settings of one fit. None means: as the preset has it.

    ``pilot`` names a pre-trained denoiser whose image is one more pilot, a candidate that the halves score
    like the others: Open Image Denoise, of the extra ``oidn``. ``network``, ``inputs``, ``scheme`` and
    ``channels`` describe the network of the published method and are used by the preset ``paper`` alone.
    ``target_error`` is a relMSE (epsilon 0.01). ``threads`` None uses every core.

    Raises InputError if a name is none of those listed, or a number out of its range.
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
        for name, hint in get_type_hints(FitSettings).items():
            if get_origin(hint) is Literal and getattr(self, name) not in get_args(hint):
                raise InputError(
                    f"{name}: expected {', '.join(get_args(hint))}, got {getattr(self, name)!r:.40}"
                )
        for name, least, most in _WHOLE_NUMBERS:
            value = getattr(self, name)
            if value is None:
                continue
            if not _is_whole(value, least, most):
                raise InputError(f"{name}: expected a whole number from {least} to {most}, got {value!r:.40}")
            object.__setattr__(self, name, int(value))  # JSON cannot represent numpy's numbers
        for name in ("time_budget_s", "target_error"):
            value = getattr(self, name)
            if value is None:
                continue
            if not (isinstance(value, Real) and float(value) > 0):
                raise InputError(f"{name}: expected a number above 0, got {value!r:.40}")
            object.__setattr__(self, name, float(value))
        counts = self.channels
        if (
            not isinstance(counts, tuple)
            or not 0 < len(counts) <= _MOST_SCALES
            or not all(_is_whole(n, 1, _MOST_CHANNELS) for n in counts)
        ):
            raise InputError(
                f"channels: expected at most {_MOST_SCALES} counts from 1 to {_MOST_CHANNELS}, such as "
                f"8,16,32,64,128, got {counts!r:.40}"
            )
        object.__setattr__(self, "channels", tuple(map(int, counts)))
        for name in PAPER_SETTINGS:
            if self.preset != "paper" and getattr(self, name) != getattr(type(self), name):
                raise InputError(f"{name}: only the preset paper leaves that open; choose the preset paper")


def _is_whole(value: object, least: int, most: int) -> bool:
    return isinstance(value, Integral) and least <= int(value) <= most


@dataclass(frozen=True)
class HistoryPoint:
    """A point of a fit: the time and steps so far, and the estimated error."""

    seconds: float
    iteration: int
    estimated_relmse: float | None


@dataclass(frozen=True, eq=False)
class FitResult:
    """A denoised image, its estimated error, and the fitted network.

    ``color`` is linear radiance, float32, shape (height, width, 3). ``estimated_relmse`` is its estimated
    relMSE (with epsilon 0.01), and ``error`` the estimated relative squared error around every pixel, shape
    (height, width, 1), the mean over 9x9 pixels. ``halves`` are the results of half A of the samples alone
    and of half B alone, in the units and shape of ``color``, which is their mean with the preset draft, and
    with the others moved from it towards the pilots of all samples. These are None with the preset paper.
    ``halves_drawn`` indicates that the image came without independent halves, which were drawn from it
    (`fit.splitting`). ``model`` is the fitted network, None where there was no noise to fit one to.
    ``interrupted`` indicates that Ctrl-C ended the fit early. ``notes`` are one line each, for example on
    missing buffers.
    """

    color: FloatImage
    settings: FitSettings
    seconds: float
    iterations: int
    error: FloatImage | None = None
    estimated_relmse: float | None = None
    halves: Halves | None = None
    halves_drawn: bool = False
    model: Model | None = None
    history: tuple[HistoryPoint, ...] = ()
    interrupted: bool = False
    notes: tuple[str, ...] = ()
