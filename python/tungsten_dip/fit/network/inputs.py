"""The inputs of the network of the presets draft, balanced and final, and the weights of its loss.

Inputs contain every pixel's features, the brightness of its pilots, and how well each pilot of one half
predicts the other half in the pixels around it: never in the pixel itself, whose noise it is scored by (the
blind spot of Krull et al. 2019, "Noise2Void"). The scores of two neighbours together do depend on
that noise, which is why the network's input is one pixel.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Halves
from tungsten_dip.cores import in_pair
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.evidence import Cues
from tungsten_dip.fit.layout import SCORE_RADII, Layout
from tungsten_dip.fit.neighbours import mean_around, signed_mean_around

INPUTS_RADIUS = max(SCORE_RADII)

# What the inputs are made with is part of every saved network (`onnx.file` numbers the format): errors are
# relative to the squared radiance, brightness is in units of the evidence.
_LOG_OFFSET = 0.02
"""Added before a logarithm: brightnesses far below are not distinguished."""

_LEAST_ERROR = 1e-4
"""Smaller errors, 1% of the radiance, do not differ."""

_LARGEST_BRIGHTNESS = 2.0
"""Pilots more than e^2 times brighter than the baseline, or darker, are as far off."""

_SCORE_UNIT = 0.05
"""A pilot that is worse than the baseline by this part of the baseline's error scores 1, ..."""

_LARGEST_SCORE = 3.0
"""... and this is the worst score."""

_LEAST_NOISE = 1.0
"""Relative variance of one half's pixel below which less noise does not make a pixel count more."""


def loss_weights(cues: Cues) -> Halves:
    """Return how much the squared error of each half's pixels counts, shape (height, width, 1).

    Relative to pilots of the half itself, never to the half that scores it: a pixel must not count less
    because the noise that it is compared with is bright, or the image would darken.
    """
    with np.errstate(over="ignore"):  # What is too noisy for a float32 counts for nothing.
        weight_a, weight_b = (
            np.reciprocal(d * (np.float32(_LEAST_NOISE) + error))
            for d, error in zip(cues.measure.denominators, cues.baseline_errors, strict=True)
        )
    return weight_a, weight_b


def inputs_of_half(
    layout: Layout, candidates: Candidates, cues: Cues, half: int, threads: int
) -> Iterator[FloatImage]:
    """Yield the network's inputs for one half, one after the other, each of shape (height, width).

    A pixel's values come from the pixels up to `INPUTS_RADIUS` around it.
    """
    for name in layout.features:
        yield cues.features[half][name]
    around = cues.baseline_errors[half]
    yield np.log(around + np.float32(_LEAST_ERROR))[:, :, 0]
    images = candidates.of_half(half)
    baseline = images[layout.baseline_index]
    base = _log_level(baseline)
    yield base[:, :, 0]

    other = candidates.noisy[1 - half]
    unit = np.float32(_SCORE_UNIT) * around + np.float32(_LEAST_ERROR)
    baseline_error = cues.measure.error(half, baseline, other)
    for index, image in enumerate(images):
        if index == layout.baseline_index:
            continue
        # Without the pixel's own noise: else a noisy pixel is preferred for being dark by chance.
        seen = mean_around(image, 1, threads) if index == 0 else image
        yield np.clip(_log_level(seen) - base, -_LARGEST_BRIGHTNESS, _LARGEST_BRIGHTNESS)[:, :, 0]
        worse = cues.measure.error(half, image, other) - baseline_error
        for radius in SCORE_RADII:
            score = signed_mean_around(worse, radius, threads) / unit
            yield np.clip(score, -_LARGEST_SCORE, _LARGEST_SCORE)[:, :, 0]


def network_inputs(layout: Layout, candidates: Candidates, cues: Cues, threads: int) -> FloatArray:
    """Return the inputs of both halves, shape (2, height * width, inputs)."""
    height, width = candidates.noisy[0].shape[:2]
    # Filled one input at a time: this is the largest array of a fit.
    inputs = np.empty((2, height * width, len(layout.inputs)), np.float32)

    def fill(half: int) -> None:
        # The other half is at work beside this one.
        images = inputs_of_half(layout, candidates, cues, half, max(threads // 2, 1))
        for column, image in zip(inputs[half].T, images, strict=True):
            column[:] = image.ravel()

    in_pair(fill, threads)
    return inputs


def _log_level(image: FloatImage) -> FloatImage:
    log_level: FloatImage = np.log(channel_mean(image) + np.float32(_LOG_OFFSET))
    return log_level
