"""The settings of a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args, get_origin, get_type_hints

from tungsten_dip.cores import MOST_THREADS
from tungsten_dip.errors import InputError, check_choice, positive_number, whole_number

Preset = Literal["draft", "balanced", "final", "paper"]
Inputs = Literal["random", "normals", "depths", "albedos", "all", "all+random"]

PAPER_SETTINGS = ("network", "inputs", "scheme", "channels")
"""What the preset ``paper`` alone leaves open."""

NETWORK_SETTINGS = ("preset", "pilot", "iterations", "seed", *PAPER_SETTINGS)
"""What determines a network; the others are where and how long it was fitted."""

MOST_ITERATIONS = 10**9

_WHOLE_NUMBERS = (
    ("iterations", 1, MOST_ITERATIONS),
    ("seed", 0, (1 << 63) - 1),
    ("threads", 1, MOST_THREADS),
)
_MOST_SCALES = 8
_MOST_CHANNELS = 4096


@dataclass(frozen=True)
class FitSettings:
    """Settings of one fit.

    ``pilot`` names a pre-trained denoiser whose image is an extra pilot, which the halves score like the
    others: Open Image Denoise, of the extra ``oidn``. ``network``, ``inputs``, ``scheme`` and
    ``channels`` describe the network of the published method and are used by the preset ``paper`` alone.
    ``channels`` may be a list, too. ``target_error`` is a relMSE (epsilon 0.01). ``iterations`` None
    means: as the preset has it. ``threads`` None uses every core. A time or an error that is None does not
    end the fit.

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
            if get_origin(hint) is Literal:
                check_choice(name, getattr(self, name), get_args(hint))
        for name, least, most in _WHOLE_NUMBERS:
            value = getattr(self, name)
            if value is not None or name == "seed":
                object.__setattr__(self, name, whole_number(name, value, least, most))
        for name in ("time_budget_s", "target_error"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, positive_number(name, value))
        counts = self.channels
        if not isinstance(counts, (list, tuple)) or not 0 < len(counts) <= _MOST_SCALES:
            raise InputError(
                f"channels: expected 1 to {_MOST_SCALES} counts, such as 8,16,32,64,128, got {counts!r:.40}"
            )
        object.__setattr__(
            self, "channels", tuple(whole_number("channels", n, 1, _MOST_CHANNELS) for n in counts)
        )
        for name in PAPER_SETTINGS:
            if self.preset != "paper" and getattr(self, name) != getattr(type(self), name):
                raise InputError(f"{name}: only the preset paper leaves that open; choose the preset paper")
