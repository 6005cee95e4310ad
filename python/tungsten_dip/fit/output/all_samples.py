"""The pilots of all samples; their blend, with the weights found from the halves, moves the result.

Guides and features of all samples have half the noise variance, so that their pilots resolve more than the
mean of two pilots of a half each. But no independent samples are left to score them, and they retain
outliers.
"""

from __future__ import annotations

from dataclasses import replace
from threading import Event

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import (
    FloatImage,
    Halves,
    RenderBuffers,
    mean_of,
    variance_of_mean,
)
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import PILOTS_SHARE, Evidence, occupied_pixels
from tungsten_dip.fit.pilots.maker import PilotMaker, guides_of_colors
from tungsten_dip.fit.pilots.oidn import oidn_pilot
from tungsten_dip.fit.pilots.surfaces import surfaces_of_colors

_SPREAD_RADIUS = 3
_AGREED = 0.25
"""Relative difference of the halves' results from their mean at which all samples get weight 0.5."""


def pilots_of_all_samples(
    evidence: Evidence,
    buffers: RenderBuffers,
    clock: Clock,
    *,
    with_oidn: bool,
    given_up: Event | None = None,
) -> tuple[FloatImage, ...]:
    """Return the noisy image and its pilots, of all samples.

    They correspond to ``evidence.candidates``, in the units of the evidence, shape (height, width, 3). None
    are returned where the pilots of the halves have used up their share of the time budget, or once
    ``given_up`` is set.
    """
    if clock.share_spent() > PILOTS_SHARE:
        return ()
    colors, threads, noisy = (evidence.mean,), evidence.threads, evidence.candidates.noisy
    surfaces = surfaces_of_colors(buffers, colors, evidence.scale, threads)
    variance = variance_of_mean(noisy)
    guides = guides_of_colors(colors, surfaces, threads, variance)
    guides = replace(guides, variance=evidence.guide_variance / np.float32(2))
    maker = PilotMaker(colors, surfaces, guides, threads, variance)
    occupied = occupied_pixels(noisy, buffers, threads)
    computed = []
    for pilot in evidence.layout.pilots:
        if given_up is not None and given_up.is_set():
            return ()
        computed.append(maker.images(pilot)[0] * occupied)
    if with_oidn:
        computed.extend(oidn_pilot(buffers, colors, threads))
    return (evidence.mean, *computed)


def with_all_samples(denoised: Halves, all_samples_blend: FloatImage, threads: int) -> FloatImage:
    """Return the mean of both halves' results, moved towards the blended pilots of all samples.

    All are linear radiance of shape (height, width, 3). The result moves no further than the halves' results
    differ in the surrounding pixels, and less where they differ strongly.
    """
    image = mean_of(denoised)
    spread = _core.box_mean(channel_mean(variance_of_mean(denoised)), _SPREAD_RADIUS, threads)
    level = _core.box_mean(channel_mean(image), _SPREAD_RADIUS, threads)
    agreed = (np.float32(_AGREED) * level) ** 2
    share = agreed / (agreed + spread + np.float32(1e-30))
    bound = np.sqrt(spread)
    moved: FloatImage = image + share * np.clip(all_samples_blend - image, -bound, bound)
    return moved
