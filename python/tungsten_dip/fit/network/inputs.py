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
from tungsten_dip.fit.evidence import Evidence
from tungsten_dip.fit.neighbours import mean_around, signed_mean_around
from tungsten_dip.fit.network.layout import SCORE_RADII

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


def loss_weights(evidence: Evidence) -> Halves:
    """Return how much the squared error of each half's pixels counts, shape (height, width, 1).

    Relative to pilots of the half itself, never to the half that scores it: a pixel must not count less
    because the noise that it is compared with is bright, or the image would darken.
    """
    with np.errstate(over="ignore"):  # What is too noisy for a float32 counts for nothing.
        weight_a, weight_b = (
            np.reciprocal(d * (np.float32(_LEAST_NOISE) + error))
            for d, error in zip(evidence.measure.denominators, evidence.baseline_errors, strict=True)
        )
    return weight_a, weight_b


def inputs_of_half(evidence: Evidence, half: int) -> Iterator[FloatImage]:
    """Yield the network's inputs for one half, one after the other, each of shape (height, width).

    A pixel's values come from the pixels up to `INPUTS_RADIUS` around it.
    """
    # The other half is at work beside this one.
    threads, layout = max(evidence.threads // 2, 1), evidence.layout
    for name in layout.features:
        yield evidence.features[half][name]
    around = evidence.baseline_errors[half]
    yield np.log(around + np.float32(_LEAST_ERROR))[:, :, 0]
    baseline = evidence.candidates[layout.baseline_index][half]
    base = _log_level(baseline)
    yield base[:, :, 0]

    other = evidence.halves[1 - half]
    unit = np.float32(_SCORE_UNIT) * around + np.float32(_LEAST_ERROR)
    baseline_error = evidence.measure.error(half, baseline, other)
    for index, candidate in enumerate(evidence.candidates):
        if index == layout.baseline_index:
            continue
        image = candidate[half]
        if index == 0:
            # Without the pixel's own noise: else a noisy pixel is preferred for being dark by chance.
            image = mean_around(image, 1, threads)
        yield np.clip(_log_level(image) - base, -_LARGEST_BRIGHTNESS, _LARGEST_BRIGHTNESS)[:, :, 0]
        worse = evidence.measure.error(half, candidate[half], other) - baseline_error
        for radius in SCORE_RADII:
            score = signed_mean_around(worse, radius, threads) / unit
            yield np.clip(score, -_LARGEST_SCORE, _LARGEST_SCORE)[:, :, 0]


def network_inputs(evidence: Evidence) -> FloatArray:
    """Return the inputs of both halves, shape (2, height * width, inputs)."""
    height, width = evidence.halves[0].shape[:2]
    # Filled one input at a time: this is the largest array of a fit.
    inputs = np.empty((2, height * width, len(evidence.layout.inputs)), np.float32)

    def fill(half: int) -> None:
        for column, image in zip(inputs[half].T, inputs_of_half(evidence, half), strict=True):
            column[:] = image.ravel()

    in_pair(fill, evidence.threads)
    return inputs


def _log_level(image: FloatImage) -> FloatImage:
    log_level: FloatImage = np.log(channel_mean(image) + np.float32(_LOG_OFFSET))
    return log_level
