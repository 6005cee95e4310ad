import logging
from dataclasses import replace

import numpy as np
import pytest

from synthetic import relmse, synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.pilots import oidn


def image(render, *, albedo=True, normal=True, **options):
    buffers = render.buffers
    return oidn.oidn_image(
        buffers.color.mean,
        buffers.albedo.mean if albedo else None,
        buffers.normal.mean if normal else None,
        **options,
    )


@pytest.fixture(autouse=True)
def _needs_pyoidn(request):
    if "without_pyoidn" not in request.fixturenames:
        pytest.importorskip("pyoidn", reason="pyoidn is not installed")


@pytest.fixture
def without_pyoidn(monkeypatch):
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)


@pytest.mark.parametrize("quality", ["fast", "balanced", "high"])
def test_it_removes_most_of_the_noise_and_keeps_the_input(render, quality):
    planes = [buffer.mean for _, buffer in render.buffers.quantities()]
    before = [plane.copy() for plane in planes]
    denoised = image(render, quality=quality)
    assert denoised.dtype == np.float32
    errors = [np.mean((x - render.reference) ** 2) for x in (render.buffers.color.mean, denoised)]
    assert errors[1] < 0.3 * errors[0]
    for plane, kept in zip(planes, before, strict=True):
        np.testing.assert_array_equal(plane, kept)


def test_features_change_the_result_and_threads_do_not(render):
    guided = image(render)
    np.testing.assert_allclose(image(render, threads=1), guided, atol=1e-5)
    without = [image(render, normal=False), image(render, albedo=False, normal=False)]
    assert all(np.abs(other - guided).max() > 1e-3 for other in without)


def test_normals_alone_are_left_out_and_that_is_said(render, caplog):
    with caplog.at_level(logging.INFO):
        alone = image(render, albedo=False)
    assert "normals are left out" in caplog.text
    np.testing.assert_array_equal(alone, image(render, albedo=False, normal=False))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 9), (5, 3)])
def test_any_size_is_possible_but_none(height, width):
    color = np.random.default_rng(0).random((height, width, 3), dtype=np.float32)
    assert oidn.oidn_image(color, color, color).shape == color.shape
    with pytest.raises(InputError, match="at least one pixel"):
        oidn.oidn_image(color[:0])


def test_wild_values_are_mended_before(render):
    color = render.buffers.color.mean.copy()
    color[3, 4], color[5, 6], color[7] = np.nan, np.inf, -2
    albedo = np.where(np.arange(56)[:, None] % 9 == 0, np.float32(np.nan), render.buffers.albedo.mean)
    denoised = oidn.oidn_image(color, np.asfortranarray(albedo), render.buffers.normal.mean)
    assert np.isfinite(denoised).all()
    assert denoised.min() >= 0


def test_images_of_other_sizes_are_refused(render):
    with pytest.raises(InputError, match="albedo mean: expected"):
        oidn.oidn_image(render.buffers.color.mean, render.buffers.albedo.mean[1:])


def test_without_the_package_the_command_that_installs_it_is_told(render, without_pyoidn):
    with pytest.raises(InputError, match=r"pip install 'tungsten-dip\[oidn\]'"):
        image(render)


def test_as_a_pilot_it_is_judged_by_the_halves():
    """Each half's image comes from that half alone; the result is no worse than without it."""
    render = synthetic_render(spp=4)

    def error(pilot):
        settings = FitSettings(preset="draft", threads=1, pilot=pilot)
        result = denoise(render.buffers, settings)
        assert result.model is not None
        assert result.model.blend is not None
        assert result.model.blend.layout.extra_count == (pilot == "oidn")
        return relmse(result.color, render.reference)

    assert error("oidn") < 1.1 * error("none")


def test_as_a_pilot_it_must_be_installed(render, without_pyoidn):
    with pytest.raises(InputError, match=r"tungsten-dip\[oidn\]"):
        denoise(render.buffers, FitSettings(pilot="oidn"))


def test_without_halves_it_is_a_pilot_too(render):
    buffers = render.buffers.with_quantities(color=Buffer(render.buffers.color.mean))
    result = denoise(buffers, FitSettings("draft", pilot="oidn", threads=1))
    assert result.model.blend.layout.extra_count == 1
    assert any("no half buffers" in note for note in result.notes)


@pytest.mark.parametrize("exponent", [-80, 60])
def test_as_a_pilot_it_does_the_same_at_any_exposure(render, exponent):
    scale = np.float32(2.0**exponent)
    color = render.buffers.color
    scaled = Buffer(color.mean * scale, color.half_a * scale, color.half_b * scale)
    settings = FitSettings("draft", pilot="oidn", threads=1)
    # The albedo of emitted light would be in another unit.
    plain = render.buffers.with_quantities(color=replace(color, variance=None), albedo=None)
    expected = denoise(plain, settings).color
    found = denoise(plain.with_quantities(color=scaled), settings).color
    np.testing.assert_allclose(found / scale, expected, rtol=1e-3)
