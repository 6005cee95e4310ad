"""Takes light away that was smeared into pixels none of whose samples saw it.

Beside lamps and the sky, filters estimate from the pixels along an edge which part of a pixel the light
fills. Where the edge ends or bends, as at the tip of a dark post before the sky, that part is too large. The
samples of the pixel itself tell: all n of them miss a light that fills the part p of it with probability
(1 - p)^n. Which part it fills is known only beside pixels that it fills entirely, and not of a lamp that
smooth plastic reflects in one of many samples.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, mean_of
from tungsten_dip.fit.neighbours import largest_around
from tungsten_dip.fit.preparation.exposure import BLACK

_BRIGHTER = 2.0
"""Results brighter than so many times the noisy pixel may contain light that is not there."""

_LEAST_PART = 0.05
"""Results are uncertain by smaller parts anyway."""

_LARGEST_PART = 0.98
"""Nothing is certain of a light after finitely many samples."""

_STANDARD_ERRORS = 2.0
"""So many standard errors are subtracted from the number of pixels without light."""

_MOST_SAMPLES = 1e4

_FILLED_RADIUS = 2
_FILLED = 0.6
"""A light fills a pixel if its halves have at least so much of one another's light, and of the brightest one
around: they differ by no more than texture."""

_FILLED_OVER_CHANCE = 2.0
"""Beside a light in plain view, so many times more pixels are filled than hit in one half only."""

_Floats = npt.NDArray[np.float64]


def without_unseen_light(
    noisy: Halves, denoised: Halves, image: FloatImage, light: Halves, threads: int
) -> tuple[Halves, FloatImage]:
    """Return both halves' results and the image, nearer to the noisy ones where they have unseen light.

    All are linear radiance in the units of `evidence.Evidence`, of shape (height, width, 3); but ``light``,
    what the samples of each half saw directly of lights, has one channel. Of the pixels beside a light that
    one half did not see, the other half misses it more often than the results allow: this excess is the
    probability that there is none. By Bayes' rule follows that of a pixel that both halves missed.
    """
    seen, mean = mean_of(light), mean_of(noisy)
    brightest = largest_around(np.where(_filled(light, threads), channel_mean(mean), np.float32(0)), 1)
    rim = (brightest > 0) & (-largest_around(-seen, 1) == 0)
    if not rim.any():
        return denoised, image
    samples = _samples(light, seen, rim) / 2

    def missed(
        result: FloatImage, pixel: FloatImage, unseen: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.bool_], _Floats]:
        """Return which of the unseen pixels have light in the result, and the probability to miss it."""
        level, dark = channel_mean(result), channel_mean(pixel)
        chosen = rim & unseen & (level > _BRIGHTER * (dark + np.float32(BLACK)))
        part = (level - dark) / np.maximum(brightest - dark, np.float32(1e-15))
        chosen &= part > _LEAST_PART
        probability: _Floats = (1 - np.minimum(part[chosen].astype(np.float64), _LARGEST_PART)) ** samples
        return chosen, probability

    excess, expected, count = 0.0, 0.0, 0
    for half, (own, other) in enumerate((light, light[::-1])):
        chosen, probability = missed(denoised[half], noisy[half], own == 0)
        missing = np.count_nonzero(other[chosen] == 0)
        error = np.sqrt((probability * (1 - probability)).sum())
        excess += missing - probability.sum() - _STANDARD_ERRORS * error
        expected += probability.sum()
        count += len(probability)
    if excess <= 0:
        return denoised, image
    prior = excess / (count - expected)
    chosen, probability = missed(image, mean, seen == 0)
    share: FloatImage = np.zeros_like(seen)
    share[chosen] = prior / (prior + (1 - prior) * probability)

    a, b = (result + share * (half - result) for result, half in zip(denoised, noisy, strict=True))
    return (a, b), image + share * (mean - image)


def _filled(light: Halves, threads: int) -> npt.NDArray[np.bool_]:
    """Return which pixels a light fills, where it fills many compared to those that it hit by chance."""
    darker, brighter = np.minimum(*light), np.maximum(*light)
    filled = (darker > 0) & (darker >= np.float32(_FILLED) * brighter)
    filled &= mean_of(light) >= np.float32(_FILLED) * largest_around(mean_of(light), _FILLED_RADIUS)
    chance = (darker == 0) & (brighter > 0)
    more = filled - np.float32(_FILLED_OVER_CHANCE) * chance
    plain: npt.NDArray[np.bool_] = filled & (_core.box_mean(more, _FILLED_RADIUS, threads) > 0)
    return plain


def _samples(light: Halves, seen: FloatImage, rim: npt.NDArray[np.bool_]) -> float:
    """Estimate how many samples a pixel has from how the halves differ where a light fills a part of it.

    The parts p_a and p_b that n / 2 samples each hit, and their mean p, fulfil
    E[(p_a - p_b)^2] / E[p (1 - p)] = 4 / (n - 1). Other noise makes n smaller.
    """
    largest = largest_around(seen, 1)[rim].astype(np.float64)
    a, b = (np.minimum(half[rim] / largest, 2) for half in light)
    part = np.clip((a + b) / 2, 0, 1)
    varied = float(((a - b) ** 2).sum())
    return min(1 + 4 * float((part * (1 - part)).sum()) / max(varied, 1e-9), _MOST_SAMPLES)
