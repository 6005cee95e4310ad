"""Pilots that no filter made: used where they are good, and harmless where they are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitted_models import check_result, short
from synthetic import SyntheticRender, relmse
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.blending import fit_blend
from tungsten_dip.progress import silent


def test_a_good_extra_pilot_is_used(render: SyntheticRender, oidn_images: list[FloatImage]) -> None:
    alone = denoise(render.buffers, short())
    truth = render.reference
    oidn_images[:] = truth, truth
    together = denoise(render.buffers, short(pilot="oidn"))
    check_result(together, render.buffers)
    assert relmse(together.color, truth) < relmse(alone.color, truth) / 2


def test_a_bad_extra_pilot_does_little_harm(render: SyntheticRender, oidn_images: list[FloatImage]) -> None:
    alone = denoise(render.buffers, short(iterations=80))
    oidn_images[:] = np.zeros_like(render.reference), 10 * render.reference
    together = denoise(render.buffers, short(iterations=80, pilot="oidn"))
    check_result(together, render.buffers)
    assert relmse(together.color, render.reference) < 1.5 * relmse(alone.color, render.reference)


def test_the_previous_frame_is_a_pilot_where_it_shows_something(render):
    """What is known of the image beats what the samples tell; where nothing is known, the samples do."""
    buffers, reference = render.buffers, render.reference
    height = buffers.height
    known = reference.copy()
    known[height // 2 :] = np.nan
    settings = FitSettings(preset="draft", threads=1)
    result = fit_blend(buffers, settings, silent, previous=(known, known))
    alone = denoise(buffers, settings)
    assert np.isfinite(result.color).all()
    assert result.model.blend.layout.extra_count == 1

    def error(image, rows):
        return float(np.mean((image[rows] - reference[rows]) ** 2))

    top, bottom = slice(0, height // 2 - 2), slice(height // 2 + 2, None)
    assert error(result.color, top) < 0.8 * error(alone.color, top)
    assert error(result.color, bottom) < 0.5 * error(buffers.color.mean, bottom)


def test_empty_space_stays_black_whatever_the_previous_frame_shows(render):
    buffers = render.buffers
    empty = np.zeros(buffers.color.mean.shape[:2], bool)
    empty[:20, :20] = True

    color, depth = buffers.color, buffers.depth
    assert color.halves is not None
    assert depth is not None
    a, b = (np.where(empty[:, :, None], np.float32(0), half) for half in color.halves)
    nothing = np.where(empty[:, :, None], np.float32(0), depth.mean)
    buffers = replace(buffers, color=Buffer((a + b) / 2, a, b), depth=Buffer(nothing))
    bright = np.full_like(render.reference, 2.0)
    settings = FitSettings(preset="draft", threads=1)
    result = fit_blend(buffers, settings, silent, previous=(bright, bright))
    assert not result.color[:17, :17].any()
    assert result.color[~empty].any()
