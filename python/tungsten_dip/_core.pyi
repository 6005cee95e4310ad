"""The core in C++. Arrays are float32, C-contiguous, aligned, (height, width, channels), never modified.

Every function raises TypeError for arrays of another dtype (those of bfloat16 for another layout, too), and
ValueError for another shape or layout or a number out of range. Nothing is converted. Inputs are read in
place, also read-only ones. The interpreter lock is released during long work. ``threads`` is 1 at least (see
`cores.thread_count`); no result depends on it.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Quantity

INFINITE_DEPTH: float
"""A depth from here on counts as infinite: the sky."""

INFINITE_RADIANCE: float
"""Radiance from here on counts as infinite."""

class Defects:
    """How many values of an image no renderer can have meant."""

    @property
    def nan(self) -> int: ...
    @property
    def infinite(self) -> int: ...
    @property
    def negative(self) -> int: ...

class HalvesTest:
    """Whether the noise of two half buffers is independent. Without arguments: nothing is known.

    ``correlation`` is that of the halves' errors, NaN if the image does not allow measuring it. Then
    ``independent`` is False as well. ``variance_ratio`` is that of the variance that the halves show to the
    given one, NaN if it is not known, and ``variance_fits`` is False if these are variances of different
    things.
    """

    def __init__(self) -> None: ...
    @property
    def correlation(self) -> float: ...
    @property
    def variance_ratio(self) -> float: ...
    @property
    def variance_fits(self) -> bool: ...
    @property
    def independent(self) -> bool: ...

def sanitize(
    quantity: Quantity,
    mean: FloatImage,
    half_a: FloatImage | None,
    half_b: FloatImage | None,
    variance: FloatImage | None,
    threads: int,
) -> tuple[
    tuple[FloatImage, FloatImage | None, FloatImage | None, FloatImage | None],
    tuple[Defects, Defects, Defects, Defects],
]:
    """Return (mean, half_a, half_b, variance), copied and mended if defective, and all defects."""

def compare_halves(
    half_a: FloatImage, half_b: FloatImage, variance: FloatImage | None, threads: int
) -> HalvesTest:
    """Test the halves of a colour for independence, and its variance; NaN in the halves is left out."""

def prefilter_feature(
    mean: FloatImage,
    half_a: FloatImage,
    half_b: FloatImage,
    variance: FloatImage | None,
    *,
    radius: int,
    step: int,
    k: float,
    threads: int,
) -> tuple[FloatImage, FloatImage, FloatImage, FloatImage]:
    """Return the cross-filtered (mean, half_a, half_b) of a feature and the variance that remains."""

def box_mean(image: FloatImage, radius: int, threads: int) -> FloatImage:
    """Return the mean over (2 radius + 1)^2 pixels around every pixel, clipped at the borders."""

def regress(
    target: FloatImage,
    features: FloatImage,
    penalty: Sequence[float],
    guide: FloatImage | None = None,
    guide_variance: FloatImage | None = None,
    *,
    radius: int,
    step: int,
    k: float = 1.0,
    threads: int,
) -> FloatImage:
    """Return ``target`` (3 channels) denoised by first-order regression on ``features`` in local windows.

    Neighbours weigh by non-local means of ``guide`` (``guide_variance`` is its noise, same shape; ``k``, how
    many standard deviations of it apart they may be, is not used without a guide), times exp(-sum of
    ``penalty`` times squared differences of features). ``radius`` must be a multiple of ``step``, 256 at
    most. At most 16 features; everything must be finite, and features should differ by no more than some tens
    within a window. See ``regress`` in core.hpp.
    """

def structure_tensor(features: FloatImage, threads: int) -> FloatImage:
    """Return the products xx, yy, xy of the features' gradients, summed, smoothed: (height, width, 3)."""

def smooth_along_edges(
    image: FloatImage, tensor: FloatImage, *, along: float, across: float, threads: int
) -> FloatImage:
    """Return ``image``, averaged by a Gaussian that follows the edges of a `structure_tensor`.

    ``along`` and ``across`` are its standard deviations, 0.01 to 128 pixels; see core.hpp.
    """

Bits = npt.NDArray[np.uint16]
"""An image in bfloat16, shape (pixels, channels), as the bits of its numbers."""

def norm_act(
    x: Bits, weight: FloatArray, bias: FloatArray, epsilon: float, slope: float
) -> tuple[Bits, FloatArray, FloatArray]:
    """Return batch norm and leaky ReLU of an image, and mean and 1 / standard deviation of its channels.

    ``weight`` and ``bias`` are the norm's, one for each channel. ``epsilon`` is added to the variance.
    """

def norm_act_gradient(
    gradient: Bits,
    x: Bits,
    weight: FloatArray,
    bias: FloatArray,
    epsilon: float,
    slope: float,
    y: Bits,
    mean: FloatArray,
    scale: FloatArray,
) -> tuple[Bits, FloatArray, FloatArray]:
    """Return the gradients of x, weight and bias, given that of y and what `norm_act` took and returned."""
