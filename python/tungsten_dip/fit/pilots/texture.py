"""The texture that pre-filtering took from an albedo, given back as far as both halves show it."""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import Buffer, Halves
from tungsten_dip.fit.neighbours import window_pixels

_RADIUS = 5
"""Of the window, in pixels, in which texture is told from noise."""

_LEAST_POWER = np.float32(1e-12)


def with_texture(filtered: Buffer, rendered: Buffer, threads: int) -> Buffer:
    """Return a pre-filtered albedo, clipped to [0, 1], with the texture of the one that was ``rendered``.

    Non-local means blur what is as fine as a pixel, such as the pattern of a wallpaper, where single pixels
    are noisy. What they took from the halves is texture as far as it is correlated, and noise as far as it is
    not; the share of texture is given back, as by a Wiener filter. Beside emission nothing is: there, an
    albedo tells how much of a pixel a light fills. Without halves, nothing is known of the noise.
    """
    mean = np.clip(filtered.mean, 0, 1)
    if rendered.halves is None or filtered.halves is None:
        return Buffer(mean)
    rendered_a, rendered_b = _clipped(rendered.halves)
    filtered_a, filtered_b = _clipped(filtered.halves)
    taken_a, taken_b = rendered_a - filtered_a, rendered_b - filtered_b
    squares = channel_mean(taken_a * taken_a + taken_b * taken_b)
    power = _core.box_mean(squares, _RADIUS, threads) / np.float32(2)
    common = _core.box_mean(channel_mean(taken_a * taken_b), _RADIUS, threads)
    # Noise alone has a correlation of about this much by chance.
    common -= power / np.sqrt(window_pixels(power.shape, _RADIUS))
    emits = np.asarray((rendered.mean > 1).any(axis=2, keepdims=True), np.float32)
    texture = np.maximum(common, 0) * (_core.box_mean(emits, _RADIUS, threads) == 0)
    share = texture / np.maximum(power, _LEAST_POWER)
    # The mean has half the noise of a half.
    share_of_mean = 2 * texture / np.maximum(texture + power, _LEAST_POWER)
    return Buffer(
        mean + share_of_mean * (np.clip(rendered.mean, 0, 1) - mean),
        filtered_a + share * taken_a,
        filtered_b + share * taken_b,
    )


def _clipped(halves: Halves) -> Halves:
    a, b = halves
    return np.clip(a, 0, 1), np.clip(b, 0, 1)
