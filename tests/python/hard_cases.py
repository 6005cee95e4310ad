"""The catalogue of hard cases: renders as ugly as renderers, disks and users make them, and what is promised.

Every case damages a small synthetic render whose truth is known. `test_hard_cases.py` holds a slice of what
`tests/stress` measures of all of them; `docs/hard-cases.md` lists them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import strategies

from synthetic import relmse, synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.fit import FitResult

HEIGHT, WIDTH, SPP = 32, 48, 16

REACH = 9
"""Pixels that a window of the filter reaches; good ones farther from every bad one must not notice it."""

MOST_DRIFT = 0.01
"""Or the standard error of the input's own mean, where that is larger: the mean is not known any better."""

INVISIBLE = 1e-4
"""A relMSE that nobody sees: an error of 1% of the radiance."""

LEAST_FAR = 0.5
"""Part of the image that must be out of reach: the mean of few noisy pixels says nothing."""

ROUNDING = 1e-6
"""Part by which an error may differ that comes from rounding alone."""

MOST_HARM = 1.5
"""How many times larger the error of good pixels may be than without the damage."""


@dataclass(frozen=True)
class Damaged:
    """A damaged render. ``bad`` marks the pixels that are not to be believed, shape (height, width)."""

    buffers: RenderBuffers
    reference: FloatImage
    bad: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class HardCase:
    """A case, and why a promise does not hold for it, by promise."""

    group: str
    name: str
    make: Callable[[], Damaged]
    unpromised: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """What was measured of a result; None where there is nothing to measure."""

    finite: bool
    drift: float | None = None
    most_drift: float = MOST_DRIFT
    error: float | None = None
    input_error: float | None = None
    harm: float | None = None

    def broken(self, case: HardCase) -> tuple[str, ...]:
        """Return every promise that does not hold, with the number that says so."""
        broken = {}
        if not self.finite:
            broken["finite"] = "finite"
        if self.drift is not None and not abs(self.drift) <= self.most_drift:
            broken["mean"] = f"mean {self.drift:+.1%}"
        most = None if self.input_error is None else max(self.input_error * (1 + ROUNDING), INVISIBLE)
        if self.error is not None and most is not None and not self.error <= most:
            broken["error"] = f"error {self.error:.2g} > {self.input_error:.2g}"
        if self.harm is not None and not self.harm <= MOST_HARM:
            broken["harm"] = f"harm {self.harm:.2g}"
        return tuple(text for promise, text in broken.items() if promise not in case.unpromised)


def measure(result: FitResult, damaged: Damaged, undamaged: FitResult | None = None) -> Outcome:
    """Compare a result with the truth, its input, and the result of the healthy render if that is given."""
    color, error = result.color, result.error
    finite = color.shape == damaged.reference.shape and bool(np.isfinite(color).all() and (color >= 0).all())
    if error is not None:
        finite &= bool(np.isfinite(error).all() and (error >= 0).all())
    if not finite:
        return Outcome(False)
    truth, noisy = damaged.reference, sanitize(damaged.buffers, 1)[0].color.mean
    good, far = ~damaged.bad, out_of_reach(damaged.bad)
    drift = harm = None
    most_drift = MOST_DRIFT
    if far.mean() > LEAST_FAR and noisy[far].max() > 0:
        drift = float(color[far].mean(dtype=np.float64) / noisy[far].mean(dtype=np.float64) - 1)
        noise = (noisy[far] - truth[far]).astype(np.float64)
        most_drift = max(
            MOST_DRIFT, math.sqrt(float((noise**2).sum())) / float(noisy[far].sum(dtype=np.float64))
        )
    if undamaged is not None and far.mean() > LEAST_FAR and damaged.bad.any():
        harm = rel_mse(color, truth, far) / rel_mse(undamaged.color, truth, far)
    if not good.any():
        return Outcome(True, drift, most_drift)
    return Outcome(True, drift, most_drift, rel_mse(color, truth, good), rel_mse(noisy, truth, good), harm)


def rel_mse(image: FloatImage, reference: FloatImage, where: npt.NDArray[np.bool_]) -> float:
    """Return the relative squared error of some pixels, whatever the exposure."""
    image, truth = (array[where].astype(np.float64) for array in (image, reference))
    typical = float(truth.mean()) or 1.0
    return relmse(image / typical, truth / typical)


def out_of_reach(bad: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which pixels are farther than `REACH` from every bad one."""
    near = np.zeros_like(bad)
    for y, x in np.argwhere(bad):
        near[max(y - REACH, 0) : y + REACH + 1, max(x - REACH, 0) : x + REACH + 1] = True
    return ~near


def exposed(buffers: RenderBuffers, exponent: int) -> RenderBuffers:
    """Return the buffers with radiance times 2^exponent."""
    scale = np.float32(2.0**exponent)
    planes = dict(buffers.color.planes())
    with np.errstate(over="ignore"):
        scaled = {
            name: array * (scale * scale if name == "variance" else scale) for name, array in planes.items()
        }
    return buffers.with_quantities(color=Buffer(**scaled))


def healthy(height: int = HEIGHT, width: int = WIDTH) -> Damaged:
    """Return the render that the cases damage."""
    render = synthetic_render(height, width, SPP)
    albedo = render.buffers.albedo
    assert albedo is not None
    # Above 1 it would be light, in the renderer's units, which a change of exposure changes, too.
    assert albedo.half_a is not None
    assert albedo.half_b is not None
    half_a, half_b = np.minimum(albedo.half_a, 1), np.minimum(albedo.half_b, 1)
    surfaces = Buffer((half_a + half_b) / 2, half_a, half_b, albedo.variance)
    buffers = render.buffers.with_quantities(albedo=surfaces)
    return Damaged(buffers, render.reference, np.zeros((height, width), bool))


# --- where the damage is

Pixels = Callable[[tuple[int, int]], npt.NDArray[np.bool_]]


def _one(shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return _at(shape, (shape[0] // 4, shape[1] // 4))


def _cluster(shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return _at(shape, (slice(6, 9), slice(10, 13)))


def _hundredth(shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return np.random.default_rng(1).random(shape) < 0.01


def _rows(shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return _at(shape, slice(5, 8))


def _all(shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return np.ones(shape, bool)


def _at(shape: tuple[int, int], where: Any) -> npt.NDArray[np.bool_]:
    mask = np.zeros(shape, bool)
    mask[where] = True
    return mask


# --- what the damage is


def _fireflies(factor: float, pixels: Pixels) -> Damaged:
    """Samples so bright, in half A and hence in the mean and the variance."""
    render = healthy()
    bad = pixels(render.bad.shape)
    planes = _planes(render.buffers.color)
    value = factor * float(np.median(planes["mean"]))
    planes["half_a"][bad] = value
    planes["mean"][bad] = value / 2
    planes["variance"][bad] = np.float32(min(value**2 / 4, 3e38))
    return replace(render, buffers=render.buffers.with_quantities(color=Buffer(**planes)), bad=bad)


_PLANES_OF = {
    "colour": {"color": ("mean", "half_a")},
    "halves": {"color": ("half_a", "half_b")},
    "variance": {"color": ("variance",)},
    "features": dict.fromkeys(("albedo", "normal", "depth"), ("mean", "half_a", "half_b", "variance")),
}


def _values(value: float, where: str, pixels: Pixels) -> Damaged:
    """A value that is no number a renderer can mean."""
    render = healthy()
    spoiled = pixels(render.bad.shape)
    changed = {}
    for quantity, names in _PLANES_OF[where].items():
        planes = _planes(getattr(render.buffers, quantity))
        for name in names:
            planes[name][spoiled] = value
        changed[quantity] = Buffer(**planes)
    # What the colour still says of a pixel can be believed.
    bad = spoiled if where == "colour" else render.bad
    return replace(render, buffers=render.buffers.with_quantities(**changed), bad=bad)


def _color(change: Callable[[dict[str, FloatImage]], Any], **others: Any) -> Callable[[], Damaged]:
    """A case whose colour planes are changed: in place, or to what ``change`` returns."""

    def make() -> Damaged:
        render = healthy()
        planes = _planes(render.buffers.color)
        planes = change(planes) or planes
        return replace(render, buffers=render.buffers.with_quantities(color=Buffer(**planes)), **others)

    return make


def _feature(name: str, change: Callable[[FloatImage, Damaged], Any]) -> Callable[[], Damaged]:
    """A case whose feature has other means and halves."""

    def make() -> Damaged:
        render = healthy()
        planes = _planes(getattr(render.buffers, name))
        for plane in ("mean", "half_a", "half_b"):
            planes[plane] = np.asarray(
                np.broadcast_to(change(planes[plane], render), planes[plane].shape), np.float32
            ).copy()
        return replace(render, buffers=render.buffers.with_quantities(**{name: Buffer(**planes)}))

    return make


def _scaled(factor: float) -> Damaged:
    render = healthy()
    planes = _planes(render.buffers.color)
    with np.errstate(over="ignore"):
        scaled = {
            name: (array.astype(np.float64) * factor ** (2 if name == "variance" else 1)).astype(np.float32)
            for name, array in planes.items()
        }
    buffers = render.buffers.with_quantities(color=Buffer(**scaled))
    return replace(
        render, buffers=buffers, reference=(render.reference * np.float64(factor)).astype(np.float32)
    )


def _of_truth(truth: FloatImage, noise: float = 0.0, features: bool = True, seed: int = 0) -> Damaged:
    """A render of another picture, its halves with independent relative Gaussian noise."""
    render = healthy()
    rng = np.random.default_rng(seed)
    truth = np.ascontiguousarray(np.broadcast_to(truth, render.reference.shape), np.float32)
    half_a, half_b = (
        np.maximum(truth * (1 + noise * rng.standard_normal(truth.shape)), 0).astype(np.float32)
        for _ in range(2)
    )
    color = Buffer((half_a + half_b) / 2, half_a, half_b, (truth * np.float32(noise)) ** 2 / 2)
    buffers = render.buffers.with_quantities(color=color) if features else RenderBuffers(color)
    return replace(render, buffers=buffers, reference=truth)


def _half_floats() -> Damaged:
    """A bright picture saved as half floats: beyond 65504 is infinity, most of all in the variance."""
    render = _scaled(2e4)
    changed = {}
    with np.errstate(over="ignore"):
        for name, buffer in render.buffers.quantities():
            planes = {plane: array.astype(np.float16).astype(np.float32) for plane, array in buffer.planes()}
            changed[name] = Buffer(**planes)
    bad = ~np.isfinite(changed["color"].mean).all(axis=2) | (render.reference > 5e4).any(axis=2)
    return replace(render, buffers=render.buffers.with_quantities(**changed), bad=bad)


def _filter_lobes() -> Damaged:
    """Undershoot beside edges and bright samples, as a sinc or Mitchell filter leaves it."""
    render = healthy()

    def sharpened(image: FloatImage) -> FloatImage:
        return np.asarray(1.5 * image - 0.25 * (np.roll(image, 1, axis=1) + np.roll(image, -1, axis=1)))

    planes = {
        name: array if name == "variance" else sharpened(array)
        for name, array in render.buffers.color.planes()
    }
    assert planes["mean"].min() < 0
    return replace(
        render,
        buffers=render.buffers.with_quantities(color=Buffer(**planes)),
        reference=np.maximum(sharpened(render.reference), 0),
    )


def _lit_pixel() -> Damaged:
    truth = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    truth[16, 20] = 7
    return _of_truth(truth, noise=0.05)


def _shared_noise() -> Damaged:
    """Noise that a wide reconstruction filter has spread over its neighbours."""
    render = healthy()
    planes = _planes(render.buffers.color)

    def spread(image: FloatImage) -> FloatImage:
        noise = image / render.reference - 1
        padded = np.pad(noise, ((1, 1), (1, 1), (0, 0)), mode="edge")
        mean = sum(padded[y : y + HEIGHT, x : x + WIDTH] for y in range(3) for x in range(3)) / 9
        return np.asarray(render.reference * (1 + mean), np.float32)

    half_a, half_b = spread(planes["half_a"]), spread(planes["half_b"])
    color = Buffer((half_a + half_b) / 2, half_a, half_b, planes["variance"] / 9)
    return replace(render, buffers=render.buffers.with_quantities(color=color))


def _correlated(correlation: float) -> Callable[[], Damaged]:
    def mixed(planes: dict[str, FloatImage]) -> None:
        a, b = planes["half_a"], planes["half_b"]
        planes["half_b"] = np.maximum(b + np.float32(correlation) * (a - b), 0)
        planes["mean"] = (a + planes["half_b"]) / 2

    return _color(mixed)


def _range() -> Damaged:
    """Radiance from 1e-5 on the left to 1e5 on the right."""
    ramp = np.logspace(-5, 5, WIDTH)[None, :, None]
    render = healthy()
    planes = {
        name: (array * ramp ** (2 if name == "variance" else 1)).astype(np.float32)
        for name, array in render.buffers.color.planes()
    }
    return replace(
        render,
        buffers=render.buffers.with_quantities(color=Buffer(**planes)),
        reference=(render.reference * ramp).astype(np.float32),
    )


def _other_frame(image: FloatImage, _: Damaged) -> FloatImage:
    return np.roll(image, (5, -11), axis=(0, 1))


def _against(image: FloatImage, render: Damaged) -> FloatImage:
    brightness = render.reference.mean(axis=2, keepdims=True)
    return np.asarray(1 - brightness / brightness.max(), np.float32)


def _unlike(image: FloatImage, _: Damaged) -> FloatImage:
    return np.random.default_rng(3).random(image.shape, np.float32)


def _planes(buffer: Buffer) -> dict[str, FloatImage]:
    return {name: array.copy() for name, array in buffer.planes()}


def _without(*names: str) -> Callable[[dict[str, FloatImage]], dict[str, FloatImage]]:
    return lambda planes: {name: array for name, array in planes.items() if name not in names}


def _depth_of_sky(value: float) -> Callable[[FloatImage, Damaged], FloatImage]:
    return lambda image, _: np.where(np.abs(image) < 0.1, np.float32(value), image)


_NO_EDGES = {
    "mean": "edges that no feature contains are detected in the noisy colour, which darkens small images"
}
_TOO_DARK = {"exposure": "float32 has no power of two that brings such radiance to the usual level"}
_BEYOND = {"exposure": "exposures are compensated up to a factor of 2^126"}
_EMITTED = {"exposure": "albedo above 1 is emission, in the renderer's units"}


def _cases() -> Iterator[HardCase]:
    extents = {"one pixel": _one, "3x3 pixels": _cluster, "1% of the pixels": _hundredth}
    for factor in (1e4, 1e6, 1e30):
        for extent, pixels in extents.items():
            name = f"{factor:g} times the median, {extent}"
            yield HardCase("Fireflies", name, lambda f=factor, p=pixels: _fireflies(f, p))

    extents = {"one pixel": _one, "whole rows": _rows, "all pixels": _all}
    for value, shown in ((np.nan, "NaN"), (np.inf, "+Inf"), (-np.inf, "-Inf")):
        for where in _PLANES_OF:
            for extent, pixels in extents.items():
                name = f"{shown} in {where}, {extent}"
                known = _NO_EDGES if (where, pixels) == ("features", _all) else {}
                yield HardCase(
                    "NaN and infinity", name, lambda v=value, w=where, p=pixels: _values(v, w, p), known
                )

    group = "Radiance"
    yield HardCase(group, "half-float overflow", _half_floats)
    yield HardCase(group, "negative, from filter lobes", _filter_lobes)
    yield HardCase(group, "subnormal (1e-40)", lambda: _scaled(1e-40), _TOO_DARK)
    yield HardCase(group, "around 1e-8", lambda: _scaled(1e-8))
    yield HardCase(group, "around 1e6", lambda: _scaled(1e6))
    yield HardCase(group, "around 1e30", lambda: _scaled(1e30), _BEYOND)
    yield HardCase(group, "from 1e-5 to 1e5 across the image", _range)
    yield HardCase(group, "all black", lambda: _of_truth(np.zeros((1, 1, 3))))
    yield HardCase(group, "one constant, no noise", lambda: _of_truth(np.full((1, 1, 3), 0.5)))
    yield HardCase(group, "one constant, noisy", lambda: _of_truth(np.full((1, 1, 3), 0.5), 0.3))
    yield HardCase(group, "one lit pixel on black", _lit_pixel)
    yield HardCase(
        group, "pure noise, no features", lambda: _of_truth(np.full((1, 1, 3), 0.5), 1.0, features=False)
    )

    group = "Evidence"
    yield HardCase(group, "1 spp: no variance, no halves", _color(_without("half_a", "half_b", "variance")))
    yield HardCase(group, "no halves", _color(_without("half_a", "half_b")))
    yield HardCase(group, "no variance", _color(_without("variance")))
    yield HardCase(group, "zero variance", _color(lambda p: p | {"variance": 0 * p["variance"]}))
    yield HardCase(
        group, "halves identical", _color(lambda p: p | {"half_a": p["mean"], "half_b": p["mean"].copy()})
    )
    yield HardCase(group, "halves correlated, +0.5", _correlated(0.3))
    yield HardCase(group, "halves correlated, -0.3", _correlated(-0.2))
    yield HardCase(group, "noise shared by neighbours", _shared_noise)
    yield HardCase(group, "converged, noise 1e-4", lambda: _of_truth(healthy().reference, 1e-4))
    yield HardCase(group, "converged, no noise", lambda: _of_truth(healthy().reference))

    group = "Features"
    for feature in ("albedo", "normal", "depth"):
        known = _NO_EDGES if feature == "albedo" else {}
        yield HardCase(
            group, f"{feature} constant", _feature(feature, lambda image, _: np.float32(0.5)), known
        )
        yield HardCase(group, f"{feature} against the image", _feature(feature, _against), known)
        yield HardCase(group, f"{feature} of another frame", _feature(feature, _other_frame), known)
        yield HardCase(group, f"{feature} of white noise", _feature(feature, _unlike), known)
    yield HardCase(
        group, "none", lambda: replace(healthy(), buffers=RenderBuffers(healthy().buffers.color)), _NO_EDGES
    )
    yield HardCase(group, "normals 10 long", _feature("normal", lambda image, _: 10 * image))
    yield HardCase(group, "normals 0", _feature("normal", lambda image, _: 0 * image))
    for value in (np.inf, 1e30, 65504.0):
        yield HardCase(group, f"depth of the sky {value:g}", _feature("depth", _depth_of_sky(value)))
    yield HardCase(group, "depth infinite", _feature("depth", lambda image, _: np.float32(np.inf)))
    yield HardCase(group, "depth 0", _feature("depth", lambda image, _: 0 * image))
    yield HardCase(group, "albedo 0", _feature("albedo", lambda image, _: 0 * image), _NO_EDGES)
    yield HardCase(group, "albedo 0 in half the image", _feature("albedo", _black_on_the_left), _NO_EDGES)
    yield HardCase(
        group, "albedo above 1", _feature("albedo", lambda image, _: 20 * image), _EMITTED | _NO_EDGES
    )
    yield HardCase(group, "albedo 1e30 in one pixel", _feature("albedo", _one_wild), _EMITTED)

    for height, width in ((1, 1), (1, 64), (64, 1), (5, 7), (65, 33), (1000, 31), (16, 8192), (4096, 1)):
        yield HardCase("Sizes", f"{width}x{height}", lambda h=height, w=width: healthy(h, w))


def _black_on_the_left(image: FloatImage, _: Damaged) -> FloatImage:
    black = image.copy()
    black[:, : WIDTH // 2] = 0
    return black


def _one_wild(image: FloatImage, _: Damaged) -> FloatImage:
    wild = image.copy()
    wild[20, 20] = 1e30
    return wild


CASES = tuple(_cases())


# --- damage that nobody thought of

_WILD = (np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e-45, 1e-38, 1e-20, 65504.0, 1e12, 1e20, 1e30, 3.4e38)


@strategies.composite
def broken_renders(draw: strategies.DrawFn) -> RenderBuffers:
    """Small renders of any size with wild values anywhere, planes that are missing, scaled or swapped."""
    height, width = draw(strategies.integers(1, 14)), draw(strategies.integers(1, 14))
    buffers = synthetic_render(height, width, 4, seed=draw(strategies.integers(0, 3))).buffers
    changed: dict[str, Buffer | None] = {}
    for quantity, buffer in buffers.quantities():
        if quantity != "color" and draw(strategies.integers(0, 5)) == 0:
            changed[quantity] = None
            continue
        planes = _planes(buffer)
        for name in draw(
            strategies.sets(strategies.sampled_from(("half_a", "half_b", "variance")), max_size=2)
        ):
            if draw(strategies.booleans()):
                del planes[name]
            else:
                planes[name] = planes["mean"].copy()
        for name in draw(strategies.lists(strategies.sampled_from(sorted(planes)), max_size=4)):
            rows, columns, channels = (
                draw(strategies.one_of(strategies.just(slice(None)), strategies.integers(0, size - 1)))
                for size in planes[name].shape
            )
            planes[name][rows, columns, channels] = draw(
                strategies.one_of(strategies.sampled_from(_WILD), strategies.floats(width=32))
            )
        if draw(strategies.booleans()):
            scale = np.float32(10.0 ** draw(strategies.integers(-38, 38)))
            with np.errstate(over="ignore", invalid="ignore", under="ignore"):
                planes = {name: array * scale for name, array in planes.items()}
        changed[quantity] = Buffer(**planes)
    return buffers.with_quantities(**changed)
