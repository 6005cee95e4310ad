"""What a fit knows of an image's noise before it begins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fitted_models import evidence_of
from synthetic import synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.fit import FitSettings, denoise, evidence
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.network.inputs import loss_weights
from tungsten_dip.fit.output import all_samples
from tungsten_dip.fit.pilots.maker import PilotMaker
from tungsten_dip.fit.preparation.exposure import unscaled
from tungsten_dip.fit.presets import DRAFT_PILOTS
from tungsten_dip.fit.scoring.measure import ErrorMeasure, _caps, _denominators


def test_guides_are_as_noisy_as_is_said_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of all samples have half the noise of those of one half: how renders differ tells."""
    makers: list[PilotMaker] = []

    def recorded(*arguments: Any, **options: Any) -> PilotMaker:
        makers.append(PilotMaker(*arguments, **options))
        return makers[-1]

    for module in (evidence, all_samples):
        monkeypatch.setattr(module, "PilotMaker", recorded)
    for seed in range(4):
        denoise(synthetic_render(20, 28, seed=seed).buffers, FitSettings("balanced", iterations=1, threads=1))
    for images in (2, 1):
        guides = [maker.guides for maker in makers if len(maker.colors) == images]
        assert len(guides) == 4
        true = np.var([guide.images[0] for guide in guides], axis=0, ddof=1).mean()
        said = np.mean([guide.variance for guide in guides])
        assert said == pytest.approx(true, rel=0.3)


def test_pixels_count_less_where_the_noise_is_heavy() -> None:
    """On the left a relative variance of 0.01, on the right of 9: one part in 1 + 9 of the weight."""
    shape = np.where(np.arange(80) < 40, 100, 1 / 9)[None, :, None] * np.ones((40, 1, 3))
    rng = np.random.default_rng(0)
    a, b = (rng.gamma(shape, 1 / shape).astype(np.float32) for _ in range(2))
    _, cues = evidence_of(RenderBuffers(Buffer((a + b) / 2, a, b)), DRAFT_PILOTS)
    for weight in loss_weights(cues):
        calm, heavy = np.median(weight[:, 4:30]), np.median(weight[:, 50:-4])
        assert 0.03 < heavy / calm < 0.3


def test_errors_are_relative_to_the_darker_of_the_last_pilot_and_the_median_one() -> None:
    levels = [(1, 9), (2, 2), (3, 1), (8, 3), (5, 0.5)]
    pilots = [tuple(np.full((130, 2, 3), level, np.float32) for level in pair) for pair in levels]
    of_a, of_b = _denominators([(a, b) for a, b in pilots])
    assert of_a.shape == of_b.shape == (130, 2, 1)
    np.testing.assert_allclose(of_a, 3**2 + 0.01)
    np.testing.assert_allclose(of_b, 0.5**2 + 0.01)


def test_one_outlier_is_a_small_part_of_the_error_around_it() -> None:
    """It counts as 20 times the mean error of a half by itself in the 17x17 pixels around."""
    noisy, flat = np.ones((40, 40, 3), np.float32), np.zeros((40, 40, 3), np.float32)
    candidates, ones = Candidates((noisy, 2 * noisy), ((flat, flat),)), np.ones((40, 40, 1), np.float32)
    caps = _caps(candidates, (ones, ones), 1)
    np.testing.assert_allclose(caps[0], 20, rtol=1e-3)
    np.testing.assert_allclose(caps[1], 80, rtol=1e-3)
    outlier = flat.copy()
    outlier[20, 20] = 1e3
    errors, _ = ErrorMeasure((ones, ones), caps).errors_around((outlier, outlier), (flat, flat), 1)
    assert errors[18, 22, 0] == pytest.approx(20 / (17**2 - 1), rel=1e-3)


def test_radiance_that_the_renderers_units_cannot_hold_is_the_largest_number() -> None:
    largest = np.finfo(np.float32).max
    image = np.array([[[1.0, 1e15, 0.0]]], np.float32)
    np.testing.assert_allclose(unscaled(image, 2.0**-100), [[[2.0**100, largest, 0]]], rtol=1e-6)
