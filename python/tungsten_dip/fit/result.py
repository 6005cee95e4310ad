"""The result of a fit."""

from __future__ import annotations

from dataclasses import dataclass

from tungsten_dip.buffers.render_buffers import FloatImage, Halves
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.settings import FitSettings


@dataclass(frozen=True)
class HistoryPoint:
    """A point of a fit: the time and steps so far, and the estimated error."""

    seconds: float
    iteration: int
    estimated_relmse: float | None


@dataclass(frozen=True, eq=False)
class DenoisedImage:
    """The part of a `FitResult` that is made of images."""

    color: FloatImage
    halves: Halves
    error: FloatImage
    estimated_relmse: float
    gain: FloatImage | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class FitResult:
    """A denoised image, its estimated error, and the fitted network.

    ``color`` is linear radiance, float32, shape (height, width, 3). ``halves`` are the results of half A of
    the samples alone and of half B alone, in the same units and shape. ``color`` is their mean, with the
    presets balanced and final moved towards the pilots of all samples, and then multiplied by the ``gain``.
    ``estimated_relmse`` is the estimated relMSE (with epsilon 0.01) of the mean of ``halves``, and ``error``
    its estimated relative squared error around every pixel, shape (height, width, 1), the mean over 9x9
    pixels. ``halves`` and both errors are None with the preset paper.
    ``gain``, shape (height, width, 1), gives back some of the radiance of fireflies (`fireflies`); None
    without fireflies. The errors do not include what is lost of it.
    ``halves_drawn`` indicates that the image came without independent halves, which were drawn from it
    (`splitting`). ``model`` is the fitted network, None where there was no noise to fit one to.
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
    gain: FloatImage | None = None
    halves_drawn: bool = False
    model: Model | None = None
    history: tuple[HistoryPoint, ...] = ()
    interrupted: bool = False
    notes: tuple[str, ...] = ()
