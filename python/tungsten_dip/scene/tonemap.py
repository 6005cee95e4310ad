"""Tungsten's five tonemaps: how its PNG files display linear radiance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tungsten_dip.buffers.display import ldr_from_radiance
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.errors import check_choice
from tungsten_dip.scene.types import TonemapName

# Every curve is flat up here; beyond it the squares in the filmic one would overflow.
_SATURATED = np.float32(1e6)


def display_from_radiance(radiance: FloatImage, tonemap: TonemapName = "gamma") -> FloatImage:
    """Return display values in [0, 1] of linear radiance, any shape; NaN and negative radiance become black.

    The default is Tungsten's.

    Raises InputError if Tungsten has no such tonemap.
    """
    check_choice("tonemap", tonemap, _CURVES)
    light = np.clip(np.nan_to_num(radiance, nan=0.0), 0.0, _SATURATED)
    return np.clip(_CURVES[tonemap](light), 0.0, 1.0).astype(np.float32)


def _linear(light: FloatImage) -> FloatImage:
    return light


def _reinhard(light: FloatImage) -> FloatImage:
    return ldr_from_radiance(light / (light + 1.0))


def _filmic(light: FloatImage) -> FloatImage:
    """Hejl and Burgess-Dawson's fit of film, "Filmic tonemapping for real-time rendering" (SIGGRAPH 2010)."""
    x = np.maximum(light - 0.004, 0.0)
    return np.asarray(x * (6.2 * x + 0.5) / (x * (6.2 * x + 1.7) + 0.06))


def _pbrt(light: FloatImage) -> FloatImage:
    """The transfer function of sRGB (IEC 61966-2-1), which pbrt writes its images with."""
    return np.where(light < 0.0031308, 12.92 * light, 1.055 * np.power(light, 1.0 / 2.4) - 0.055)


_CURVES: dict[TonemapName, Callable[[FloatImage], FloatImage]] = {
    "linear": _linear,
    "gamma": ldr_from_radiance,
    "reinhard": _reinhard,
    "filmic": _filmic,
    "pbrt": _pbrt,
}
