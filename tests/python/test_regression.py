"""The local regression through numpy, against a plain double-precision one. (tests/cpp/ has the rest.)"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import FloatImage

Plain = npt.NDArray[np.float64]


def _images(height: int, width: int, features: int = 4, seed: int = 0) -> dict[str, FloatImage]:
    """A noisy target over two surfaces, its features, a guide of two channels and the guide's variance."""
    rng = np.random.default_rng(seed)
    surface = (np.arange(width) > 0.6 * width).astype(np.float64)[None, :, None]
    feature = rng.uniform(-1, 1, (height, width, features)) * 0.3 + surface
    truth = 0.5 + surface * (1, 2, 3) + feature.sum(axis=2, keepdims=True) * 0.1
    noise = 0.2 * rng.standard_normal((height, width, 3))
    guide = truth[:, :, :2] + 0.1 * rng.standard_normal((height, width, 2))
    variance = 0.01 * rng.chisquare(4, guide.shape) / 4
    images = {"target": truth + noise, "features": feature, "guide": guide, "guide_variance": variance}
    return {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}


def _plain_regress(
    target: FloatImage,
    features: FloatImage,
    penalty: Sequence[float],
    guide: FloatImage | None = None,
    guide_variance: FloatImage | None = None,
    *,
    radius: int,
    step: int,
    k: float = 1.0,
) -> Plain:
    """What `_core.regress` says it does, pixel by pixel."""
    height, width = target.shape[:2]
    y, f = target.astype(np.float64), features.astype(np.float64)

    def weighed(row: int, column: int, step: int) -> list[tuple[int, int, float]]:
        found = []
        reach = radius // step * step
        for dy in range(-reach, reach + 1, step):
            for dx in range(-reach, reach + 1, step):
                if not (0 <= row + dy < height and 0 <= column + dx < width):
                    continue
                distance = 0.0
                if guide is not None and guide_variance is not None:
                    at = (row, column, dy, dx)
                    distance = max(_patch_distance(guide, guide_variance, at, k), 0.0)
                apart = f[row, column] - f[row + dy, column + dx]
                distance += float(np.dot(penalty, apart**2))
                ends = (abs(dy) == reach) + (abs(dx) == reach) if step > 1 else 0
                found.append((row + dy, column + dx, 0.5**ends * np.exp(-distance)))
        return found

    fits = {}
    for pixel in np.ndindex(height, width):
        neighbours = weighed(*pixel, step)
        w = np.array([weight for *_, weight in neighbours])
        w /= w.sum()
        x = np.array([f[row, column] for row, column, _ in neighbours])
        values = np.array([y[row, column] for row, column, _ in neighbours])
        mean_x, mean_y = w @ x, w @ values
        centred = x - mean_x
        covariance = centred.T @ (w[:, None] * centred) + 1e-3 * np.eye(f.shape[2])
        slope = np.linalg.solve(covariance, centred.T @ (w[:, None] * (values - mean_y)))
        fits[pixel] = (mean_x, mean_y, slope)

    out = np.empty_like(y)
    for pixel in np.ndindex(height, width):
        neighbours = weighed(*pixel, 1 if step == 1 else step + 1)
        predictions = np.zeros(3)
        for row, column, weight in neighbours:
            mean_x, mean_y, slope = fits[row, column]
            predictions += weight * (mean_y + (f[pixel] - mean_x) @ slope)
        out[pixel] = predictions / sum(weight for *_, weight in neighbours)
    return out


def _patch_distance(
    guide: FloatImage, variance: FloatImage, at: tuple[int, int, int, int], k: float
) -> float:
    """Rousselle et al. 2012, equation 2, over patches; the image's border is repeated."""
    row, column, dy, dx = at
    height, width = guide.shape[:2]
    around = np.arange(-1, 2)

    def patch(image: FloatImage, y: int, x: int) -> Plain:
        rows, columns = np.clip(y + around, 0, height - 1), np.clip(x + around, 0, width - 1)
        return image[np.ix_(rows, columns)].astype(np.float64)

    p, q = patch(guide, row, column), patch(guide, row + dy, column + dx)
    noise_p, noise_q = patch(variance, row, column), patch(variance, row + dy, column + dx)
    distances = ((p - q) ** 2 - noise_p - np.minimum(noise_p, noise_q)) / (1e-8 + k**2 * (noise_p + noise_q))
    return float(distances.mean())


@pytest.mark.parametrize(
    ("size", "window"),
    [
        ((9, 11), {"radius": 2, "step": 1}),
        ((9, 11), {"radius": 4, "step": 2, "k": 0.7}),
        ((7, 5), {"radius": 3, "step": 3}),
        ((7, 5), {"radius": 12, "step": 4, "k": 2.0}),
        ((1, 8), {"radius": 2, "step": 1, "k": 0.5}),
        ((8, 1), {"radius": 1, "step": 1}),
        ((1, 1), {"radius": 3, "step": 1}),
        ((10, 70), {"radius": 1, "step": 1}),
        ((0, 3), {"radius": 1, "step": 1}),
    ],
)
@pytest.mark.parametrize("guided", [True, False])
@pytest.mark.parametrize("penalty", [(0.0, 0.0, 0.0, 0.0), (3.0, 0.0, 0.5, 20.0)])
def test_agrees_with_a_plain_regression(
    size: tuple[int, int], window: dict[str, float], guided: bool, penalty: tuple[float, ...]
) -> None:
    images = _images(*size)
    arguments = [images["target"], images["features"], penalty]
    if guided:
        arguments += [images["guide"], images["guide_variance"]]
    out = _core.regress(*arguments, **window, threads=2)  # type: ignore[arg-type]
    assert out.dtype == np.float32
    assert out.shape == (*size, 3)
    np.testing.assert_allclose(out, _plain_regress(*arguments, **window), atol=2e-4)  # type: ignore[arg-type]


@pytest.mark.parametrize(("radius", "step"), [(6, 2), (12, 2), (18, 2), (24, 3)])
def test_windows_that_skip_pixels_leave_no_grid(radius: int, step: int) -> None:
    nothing = np.empty((120, 130, 0), np.float32)
    for period in (step, step + 1):
        grid = np.zeros((120, 130, 3), np.float32)
        grid[::period, ::period] = period**2
        out = _core.regress(grid, nothing, (), radius=radius, step=step, threads=2)
        inside = out[2 * radius : -2 * radius, 2 * radius : -2 * radius]
        assert inside.size > 1000
        np.testing.assert_allclose(inside, 1, rtol=1e-5)


def test_repeated_and_constant_features_do_no_harm() -> None:
    images = _images(20, 30, 1)
    feature = images["features"]
    many = np.concatenate([feature] * 8 + [np.full_like(feature, 1e3)] * 8, axis=2)
    one, all_of_them = (
        _core.regress(images["target"], image, (0.0,) * image.shape[2], radius=4, step=1, threads=2)
        for image in (np.float32(8**0.5) * feature, many)
    )
    np.testing.assert_allclose(all_of_them, one, atol=1e-3)


def test_a_guide_keeps_an_edge_that_no_feature_shows() -> None:
    rng = np.random.default_rng(3)
    truth = np.ones((30, 40, 3), np.float32)
    truth[:, 20:] = 5
    target = (truth + 0.3 * rng.standard_normal(truth.shape)).astype(np.float32)
    guide = (truth + 0.1 * rng.standard_normal(truth.shape)).astype(np.float32)
    features = np.empty((30, 40, 0), np.float32)
    noise = np.full_like(guide, 0.01)
    out = _core.regress(target, features, (), guide, noise, radius=5, step=1, threads=2)
    assert np.abs(out - truth).max() < 0.5
    assert np.square(out - truth).mean() < 0.3**2 / 20


def test_inputs_may_be_read_only_and_stay_as_they_are() -> None:
    images = _images(12, 10)
    copies = {name: image.copy() for name, image in images.items()}
    for image in images.values():
        image.flags.writeable = False
    guide = images["guide"], images["guide_variance"]
    _core.regress(images["target"], images["features"], (1.0,) * 4, *guide, radius=2, step=1, threads=2)
    for name, image in images.items():
        np.testing.assert_array_equal(image, copies[name])


def test_what_does_not_fit_together_is_refused() -> None:
    images = _images(6, 7)
    target, features, guide = images["target"], images["features"], images["guide"]
    penalty = (1.0,) * 4
    many = np.zeros((6, 7, 17), np.float32)
    with pytest.raises(ValueError, match="features: expected up to 16 channels, got 17"):
        _core.regress(target, many, (0.0,) * 17, radius=1, step=1, threads=2)
    with pytest.raises(ValueError, match="target: expected 3 channels, got 1"):
        _core.regress(np.zeros((6, 7, 1), np.float32), features, penalty, radius=1, step=1, threads=2)
    with pytest.raises(ValueError, match="penalty: expected one value per feature, 4, got 3"):
        _core.regress(target, features, (1.0,) * 3, radius=1, step=1, threads=2)
    with pytest.raises(ValueError, match="features: expected the height and width of target"):
        _core.regress(target, np.zeros((7, 6, 4), np.float32), penalty, radius=1, step=1, threads=2)
    with pytest.raises(ValueError, match="guide: expected the height and width of target"):
        _core.regress(target, features, penalty, guide[:5], guide[:5], radius=1, step=1, threads=2)
    with pytest.raises(ValueError, match="both or neither"):
        _core.regress(target, features, penalty, guide, radius=1, step=1, threads=2)
    with pytest.raises(ValueError, match="guide_variance: expected the shape of guide"):
        _core.regress(target, features, penalty, guide, target, radius=1, step=1, threads=2)
    with pytest.raises(TypeError, match="target: expected an aligned C-contiguous float32"):
        _core.regress(target.astype(np.float64), features, penalty, radius=1, step=1, threads=2)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (7, 5), (4, 0), (0, 4), (20, 33), (35, 18)])
@pytest.mark.parametrize("radius", [0, 1, 4, 13, 50, 2**31 - 1])
def test_box_mean_is_the_mean_of_the_pixels_around(size: tuple[int, int], radius: int) -> None:
    # From the darkest to the brightest pixels: no window may lose digits to one that it does not cover.
    image = (10 ** np.random.default_rng(4).uniform(-30, 30, size=(*size, 2))).astype(np.float32)
    expected = np.empty(image.shape)
    for y, x in np.ndindex(*size):
        around = image[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
        expected[y, x] = around.mean(axis=(0, 1), dtype=np.float64)
    mean = _core.box_mean(image, radius, 1)
    np.testing.assert_allclose(mean, expected, rtol=1e-6)
    np.testing.assert_array_equal(mean, _core.box_mean(image, radius, 3))


def test_box_mean_refuses_a_negative_radius() -> None:
    with pytest.raises(ValueError, match="radius"):
        _core.box_mean(np.ones((3, 3, 1), np.float32), -1, 2)
