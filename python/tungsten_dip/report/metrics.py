"""The error of an image against its reference, by the usual metrics."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from tungsten_dip.buffers.display import ldr_from_radiance
from tungsten_dip.buffers.relmse import relative_squared_error
from tungsten_dip.buffers.render_buffers import FloatImage, as_float32, check_array
from tungsten_dip.errors import InputError
from tungsten_dip.extras import requirement

_LOG = logging.getLogger(__name__)

_METRIC_BY_PACKAGE = {"skimage": "SSIM", "flip_evaluator": "FLIP"}

_FLIP_DARKEST = float(np.finfo(np.float32).eps)

SSIM_WINDOW = 7
"""Side in pixels of the window in which Wang et al. 2004 compare, as scikit-image has it."""


@dataclass(frozen=True)
class Comparison:
    """Distances of an image from its reference.

    ``psnr`` (dB), ``ssim`` and ``flip`` are of the displayed images (clipped to [0, 1], gamma 2.2);
    ``relmse`` and ``hdrflip`` are of linear radiance. ``psnr`` is infinite for equal images, ``ssim`` None
    where a side is under 7 pixels, ``hdrflip`` None where the reference is uniform, which leaves no range of
    exposures. ``ssim``, ``flip`` and ``hdrflip`` are None too where the packages that compute them are not
    installed. ``nonfinite`` counts NaN and Inf values of the image, which count as 0. ``mean_ratio`` is
    the mean radiance over the reference's, None where that is black.
    """

    psnr: float
    relmse: float
    ssim: float | None
    flip: float | None
    hdrflip: float | None
    nonfinite: int
    mean_ratio: float | None


def compare(image: FloatImage, reference: FloatImage) -> Comparison:
    """Compare two images of linear radiance, shape (height, width, 3).

    PSNR is 10 log10(1 / MSE); relMSE is mean((x - r)^2 / (r^2 + 0.01)) over pixels and channels; SSIM is
    Wang et al. 2004; FLIP is Andersson et al. 2020 and HDR-FLIP theirs of 2021, at 67 pixels per degree. SSIM
    and FLIP need the extra ``compare`` of this package, and are logged as missing without it.

    Raises InputError if one is no array, if the shapes differ or are not of that form, if the image is empty,
    if the reference is not finite, or if values are too large for float32.
    """
    for name, given in (("image", image), ("reference", reference)):
        check_array(name, given, "read_image reads one from a file")
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3:
        raise InputError(
            f"compare: expected two images of one shape (height, width, 3), got {image.shape} and "
            f"{reference.shape}; bring them to one size"
        )
    if image.size == 0:
        raise InputError(f"compare: expected an image with pixels, got one of shape {image.shape}")
    if not np.isfinite(reference).all():
        raise InputError("compare: expected a finite reference, got one with NaN or Inf; render it again")

    for package, metric in _METRIC_BY_PACKAGE.items():
        if find_spec(package) is None:
            _LOG.info("%s", requirement(package, metric))

    finite = np.isfinite(image)
    x = np.where(finite, as_float32("image", image), np.float32(0))
    r = as_float32("reference", reference).copy()  # FLIP takes no array that is read-only
    displayed_x, displayed_r = ldr_from_radiance(x), ldr_from_radiance(r)
    reference_mean = float(r.mean(dtype=np.float64))
    return Comparison(
        psnr=_psnr(displayed_x, displayed_r),
        relmse=float(relative_squared_error(x, r).mean()),
        ssim=_ssim(displayed_x, displayed_r),
        flip=_flip(displayed_x, displayed_r, "LDR"),
        hdrflip=_hdrflip(x, r),
        nonfinite=int(finite.size - np.count_nonzero(finite)),
        mean_ratio=float(x.mean(dtype=np.float64)) / reference_mean if reference_mean > 0 else None,
    )


def _psnr(x: FloatImage, r: FloatImage) -> float:
    mse = float(np.mean((x.astype(np.float64) - r) ** 2))
    return float("inf") if mse == 0 else float(-10 * np.log10(mse))


def _ssim(x: FloatImage, r: FloatImage) -> float | None:
    if min(x.shape[:2]) < SSIM_WINDOW or find_spec("skimage") is None:
        return None
    from skimage import metrics

    similarity: Callable[..., float] = metrics.structural_similarity
    return float(similarity(x, r, win_size=SSIM_WINDOW, data_range=1.0, channel_axis=2))


def _hdrflip(x: FloatImage, r: FloatImage) -> float | None:
    luminance = r @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    # FLIP takes its exposures from the maximum down to the median, or to the float's epsilon, and ends the
    # process where these are equal.
    if luminance.max() <= max(float(np.median(luminance)), _FLIP_DARKEST) * (1 + 1e-4):
        return None
    return _flip(x, r, "HDR")


def _flip(x: FloatImage, r: FloatImage, dynamic_range: str) -> float | None:
    if find_spec("flip_evaluator") is None:
        return None
    import flip_evaluator

    return float(flip_evaluator.evaluate(r, x, dynamic_range, applyMagma=False)[1])
