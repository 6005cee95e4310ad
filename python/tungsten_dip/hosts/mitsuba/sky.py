"""Tungsten's skydome: the sky of Hosek and Wilkie under a sun of any temperature, as an environment map.

"An Analytic Model for Full Spectral Sky-Dome Radiance", SIGGRAPH 2012, and "Predicting Sky Dome Appearance on
Earth-like Extrasolar Worlds", SCCG 2013. Mitsuba's own sky uses the same measurements in RGB and knows one
sun alone, but its wheel carries the spectral data too.
"""

from __future__ import annotations

import math
from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from tungsten_dip.hosts.mitsuba.scene_builder import SceneBuilder
from tungsten_dip.scene.types import Skydome

_Array = npt.NDArray[np.float64]

_WIDTH, _HEIGHT = 512, 256
_GROUND_ALBEDO = 0.2
_SAMPLED_WAVELENGTHS = 10

_WAVELENGTHS_NM = np.arange(320.0, 721.0, 40.0)
# The sun's spectrum above the atmosphere in the units of the model, at those wavelengths.
_SUN = np.array(
    [7500.0, 12500.0, 21127.5, 26760.5, 30663.7, 27825.0, 25503.8, 25134.2, 23212.1, 21526.7, 19870.8]
)
_COLDEST_SUN_K = 30  # the light of a colder one is 0 in floating point
_BLACKBODY_SCALE = 3.19992e-10
_RGB_FROM_XYZ = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)


def sky_pixels(builder: SceneBuilder, skydome: Skydome) -> _Array:
    """Return the sky's radiance over latitude and longitude, shape (256, 512, 3), row 0 at the zenith.

    Raises InputError where the model is not defined: a sun that is below the horizon or emits no light,
    turbidity beyond 1 to 10.
    """
    sun = skydome.world_from_local[:3, 1]
    if not 1.0 <= skydome.turbidity <= 10.0:
        raise builder.unsupported(f"a skydome of turbidity {skydome.turbidity} (expected 1 to 10)")
    if sun[1] < 0.0:
        raise builder.unsupported("a skydome whose sun is below the horizon")
    if skydome.temperature < _COLDEST_SUN_K:
        raise builder.unsupported(
            f"a skydome of temperature {skydome.temperature} (expected {_COLDEST_SUN_K} K or more)"
        )
    elevation = math.asin(min(float(sun[1]), 1.0))

    theta = (np.arange(_HEIGHT // 2) + 0.5)[:, None] * math.pi / _HEIGHT
    phi = (np.arange(_WIDTH) + 0.5)[None, :] * 2.0 * math.pi / _WIDTH
    cos_gamma = np.sin(theta) * (np.cos(phi) * sun[0] + np.sin(phi) * sun[2]) + np.cos(theta) * sun[1]
    bands = _radiance(skydome, elevation, theta, np.arccos(np.clip(cos_gamma, -1.0, 1.0)))

    wavelengths, weights = _xyz_weights()
    position = (wavelengths - _WAVELENGTHS_NM[0]) / 40.0
    xyz = np.zeros((*cos_gamma.shape, 3))
    for where, weight in zip(position, weights, strict=True):
        low, part = int(where), where % 1.0
        if low < len(bands):
            above = bands[low + 1] if low + 1 < len(bands) else 0.0
            xyz += ((1.0 - part) * bands[low] + part * above)[:, :, None] * weight
    pixels = np.zeros((_HEIGHT, _WIDTH, 3))
    pixels[: _HEIGHT // 2] = xyz @ _RGB_FROM_XYZ.T
    # Two rows more, so that nothing dark bleeds into the horizon.
    pixels[_HEIGHT // 2 : _HEIGHT // 2 + 2] = pixels[_HEIGHT // 2 - 1]
    return pixels


def _radiance(skydome: Skydome, elevation: float, theta: _Array, gamma: _Array) -> _Array:
    """Return the radiance in every band, shape (bands, *gamma.shape) (Hosek and Wilkie 2012, equation 8)."""
    path = str(Path(mi.__file__).parent / "data" / "sunsky" / "sunsky_datasets.bin")
    file = mi.TensorFile(path)
    # Interpolated over turbidity and the albedo of the ground, and with Bezier's quintic over the elevation.
    x = (elevation / (math.pi / 2.0)) ** (1.0 / 3.0)
    quintic = np.array([math.comb(5, i) * x**i * (1.0 - x) ** (5 - i) for i in range(6)])
    low = min(int(skydome.turbidity), 9)
    part = skydome.turbidity - low

    def fitted(name: str, *shape: int) -> _Array:
        shape = (10, 2, 6, len(_SUN), *shape)
        data: _Array = np.fromfile(path, "<f8", math.prod(shape), offset=file[name].offset).reshape(shape)
        data = (1.0 - part) * data[low - 1] + part * data[low]
        data = (1.0 - _GROUND_ALBEDO) * data[0] + _GROUND_ALBEDO * data[1]
        return np.asarray(np.tensordot(quintic, data, axes=1))

    a, b, c, d, e, f, g, i, h = (p[:, None, None] for p in fitted("sky_params_spec", 9).T)
    cosine = np.cos(gamma)[None]
    mie = (1.0 + cosine**2) / (1.0 + h**2 - 2.0 * h * cosine) ** 1.5
    zenith = np.sqrt(np.cos(theta))[None]
    shape = (1.0 + a * np.exp(b / (np.cos(theta)[None] + 0.01))) * (
        c + d * np.exp(e * gamma[None]) + f * cosine**2 + g * mie + i * zenith
    )
    scale = fitted("sky_rad_spec") * _emission_correction(skydome)
    return np.asarray(shape * scale[:, None, None])


def _emission_correction(skydome: Skydome) -> _Array:
    """Return a sun's spectrum over our sun's, of equal mean over the visible bands, times its intensity."""
    metres = _WAVELENGTHS_NM * 1e-9
    exponent = 0.0143878 / (metres * skydome.temperature)
    planck = 3.74177e-16 / metres**5 * np.exp(-exponent) / -np.expm1(-exponent)
    ratio = planck * _BLACKBODY_SCALE / _SUN
    return np.asarray(skydome.intensity * ratio / ratio[2:].mean())


def _xyz_weights() -> tuple[_Array, _Array]:
    """Return the wavelengths that Tungsten samples and their weights in XYZ, shape (wavelengths, 3)."""
    every_nm = np.arange(360.0, 831.0)
    matching = np.array([[float(v) for v in mi.cie1931_xyz(nm)] for nm in every_nm.tolist()])
    wavelengths = np.linspace(360.0, 830.0, _SAMPLED_WAVELENGTHS)
    spacing = wavelengths[1] - wavelengths[0]
    tents = np.maximum(1.0 - np.abs(every_nm[None, :] - wavelengths[:, None]) / spacing, 0.0)
    total = np.sum(0.5 * (matching[1:, 1] + matching[:-1, 1]))
    return wavelengths, np.asarray(tents @ matching / total)
