"""Renders a scene with Mitsuba and our integrator ``tungsten_path`` (mitsuba_ext/tungsten_path.cpp).

Samples per pixel are fixed: adaptive sampling and Sobol points, which a scene may ask for, would break the
independence of the halves and are not used.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from tungsten_dip.buffers.render_buffers import (
    CHANNELS,
    FEATURES,
    MOST_SPP,
    Buffer,
    FloatImage,
    Quantity,
    RenderBuffers,
)
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.hosts.memory import check_fits_mitsuba
from tungsten_dip.hosts.mitsuba.runtime import VERSION, mitsuba_variant
from tungsten_dip.hosts.mitsuba.translated_scene import TranslatedScene
from tungsten_dip.hosts.options import checked_option
from tungsten_dip.interrupts import wait_in_short_turns
from tungsten_dip.progress import Progress, part_of, silent
from tungsten_dip.scene.types import Scene

_LOG = logging.getLogger(__name__)

QUANTITIES: tuple[Quantity, ...] = ("color", *FEATURES)
"""What is rendered unless something else is asked for; colour is always there."""

_TRACE_SETTINGS = (
    "min_bounces",
    "max_bounces",
    "enable_consistency_checks",
    "enable_light_sampling",
    "enable_volume_light_sampling",
    "low_order_scattering",
    "include_surfaces",
)


def render(
    scene: Scene,
    spp: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    timeout_s: float | None = None,
    progress: Progress = silent,
    quantities: Sequence[Quantity] = QUANTITIES,
) -> RenderBuffers:
    """Render a scene with ``spp`` samples per pixel (None: the scene's); writes no file.

    The result depends on ``seed`` (0 to 2^32 - 1), not on ``threads`` (None: all cores). Samples go to halves
    A and B by turns and are independent, so the halves are; with 1 spp there are neither halves nor a
    variance. After ``timeout_s`` seconds the render ends at the next step of the scene's ``spp_step``.

    Raises InputError if Mitsuba is missing or cannot show what the scene calls for, the picture would not fit
    into memory, or an argument is out of range, and KeyboardInterrupt within a moment of Ctrl-C.
    """
    if scene.renderer.adaptive_sampling or scene.renderer.stratified_sampler:
        _LOG.info(
            "adaptive_sampling and stratified_sampler rest: every pixel gets as many independent samples"
        )
    if "color" not in quantities or not set(quantities) <= set(CHANNELS):
        raise InputError(
            f"quantities: expected color and others of {', '.join(CHANNELS)}, got {', '.join(quantities)}"
        )
    check_fits_mitsuba(scene, quantities)
    with mitsuba_variant():
        from tungsten_dip.hosts.mitsuba.translate import translate

        return render_translated(
            translate(scene),
            spp=scene.renderer.spp if spp is None else spp,
            seed=seed,
            threads=threads,
            timeout_s=timeout_s,
            spp_step=scene.renderer.spp_step,
            progress=progress,
            quantities=quantities,
        )


def render_translated(
    translated: TranslatedScene,
    *,
    spp: int,
    seed: int = 0,
    threads: int | None = None,
    timeout_s: float | None = None,
    spp_step: int = 16,
    progress: Progress = silent,
    quantities: Sequence[Quantity] = QUANTITIES,
) -> RenderBuffers:
    """Render a translated scene; `render` says what comes back and what is raised.

    With ``timeout_s`` the picture is rendered in passes of ``spp_step``, and no pass begins after that time;
    at least one is rendered, and the buffers hold the spp that were reached.
    """
    spp = checked_option("spp", spp)
    spp_step = whole_number("spp_step", spp_step, 1, MOST_SPP)
    threads = None if threads is None else checked_option("threads", threads)
    seed = checked_option("seed", seed)
    started = time.perf_counter()
    with mitsuba_variant() as mitsuba:
        try:
            scene = mitsuba.load_dict(
                _scene_with_integrator(translated, threads, quantities), parallel=False, optimize=False
            )
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise InputError(f"Mitsuba cannot load the scene: {reason}") from None
        done_spp = 0
        statistics: dict[Quantity, _Statistics] = {}
        while done_spp < spp:
            if done_spp and timeout_s is not None and time.perf_counter() - started > timeout_s:
                _LOG.info("out of time after %d of %d spp", done_spp, spp)
                break
            pass_spp = min(spp - done_spp, spp if timeout_s is None else spp_step)
            pass_seed = int(np.random.SeedSequence([seed, done_spp]).generate_state(1)[0])
            part = part_of(progress, done_spp / spp, (done_spp + pass_spp) / spp, f"{spp} spp")
            pixels = _render_pass(mitsuba, scene, pass_spp, pass_seed, part)
            for name, rendered in _statistics_from_pixels(pixels, quantities).items():
                statistics[name] = statistics[name].merged(rendered) if name in statistics else rendered
            done_spp += pass_spp
    _LOG.info("Mitsuba %s rendered %d spp in %.1f s", VERSION, done_spp, time.perf_counter() - started)
    if done_spp == 1:
        _LOG.warning("1 sample per pixel has no halves and no variance; render at least 2")
    buffers = {name: known.buffer(has_halves=done_spp > 1) for name, known in statistics.items()}
    return RenderBuffers(
        color=buffers.pop("color"),
        **buffers,  # type: ignore[arg-type]
        spp=float(done_spp),
        attributes={"renderer": f"Mitsuba {VERSION}", "integrator": "path_tracer", "seed": str(seed)},
    )


def _scene_with_integrator(
    translated: TranslatedScene, threads: int | None, quantities: Sequence[Quantity]
) -> dict[str, Any]:
    integrator = {
        "type": "tungsten_path",
        "quantities": " ".join(quantities),
        "threads": thread_count(threads),
        "reconstruction_filter": translated.reconstruction_filter,
        "pixel_center": translated.pixel_center,
        **translated.lens,
        **{name: getattr(translated.integrator, name) for name in _TRACE_SETTINGS},
        **{f"albedo_{bsdf}": texture for bsdf, texture in translated.albedo.items()},
    }
    return {**translated.scene, "integrator": integrator}


def _render_pass(mitsuba: Any, scene: Any, spp: int, seed: int, progress: Progress) -> FloatImage:
    """Render in a thread of its own, so that this one can report progress and be interrupted."""
    integrator = scene.integrator()
    parameters = mitsuba.traverse(integrator)
    level = mitsuba.log_level()
    # Mitsuba warns from within its handler of Ctrl-C, where no Python may run.
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    try:
        with ThreadPoolExecutor(max_workers=1) as executor:
            rendering = executor.submit(integrator.render, scene, scene.sensors()[0], seed, spp)
            try:
                wait_in_short_turns(rendering, lambda: progress(float(parameters["progress"]), ""))
            except BaseException:
                integrator.cancel()
                raise
    finally:
        mitsuba.set_log_level(level)
    pixels: FloatImage = np.array(rendering.result(), dtype=np.float32)
    if integrator.should_stop():
        raise KeyboardInterrupt
    progress(1.0, "")
    return pixels


@dataclass(frozen=True)
class _Statistics:
    """What is known of one quantity, shape (height, width, channels); the counts have one channel."""

    half_a: FloatImage
    half_b: FloatImage
    count_a: FloatImage
    count_b: FloatImage
    squared_deviations: FloatImage

    @property
    def count(self) -> FloatImage:
        return self.count_a + self.count_b

    @property
    def mean(self) -> FloatImage:
        return _weighted_mean(self.half_a, self.count_a, self.half_b, self.count_b)

    def merged(self, other: _Statistics) -> _Statistics:
        """Pool two sets of samples (Chan, Golub and LeVeque, The American Statistician 37, 1983)."""
        shift = (
            (other.mean - self.mean) ** 2 * self.count * other.count / np.maximum(self.count + other.count, 1)
        )
        # Where half A has one sample more, the next one is half B's.
        swaps = self.count_a > self.count_b
        count_a = np.where(swaps, other.count_b, other.count_a)
        count_b = np.where(swaps, other.count_a, other.count_b)
        return _Statistics(
            _weighted_mean(self.half_a, self.count_a, np.where(swaps, other.half_b, other.half_a), count_a),
            _weighted_mean(self.half_b, self.count_b, np.where(swaps, other.half_a, other.half_b), count_b),
            self.count_a + count_a,
            self.count_b + count_b,
            self.squared_deviations + other.squared_deviations + shift,
        )

    def buffer(self, has_halves: bool) -> Buffer:
        """Return the means and the variance of the mean, as Tungsten writes them."""
        if not has_halves:
            return Buffer(self.mean)
        variance = self.squared_deviations / np.maximum(self.count * (self.count - 1), 1)
        # A feature that one ray alone recorded in a pixel, in fog say, is not black in the other half.
        half_b = np.where(self.count_b > 0, self.half_b, self.half_a)
        return Buffer(self.mean, self.half_a, half_b, variance)


def _weighted_mean(a: FloatImage, weight_a: FloatImage, b: FloatImage, weight_b: FloatImage) -> FloatImage:
    mean: FloatImage = (a * weight_a + b * weight_b) / np.maximum(weight_a + weight_b, 1)
    return mean


def _statistics_from_pixels(
    pixels: FloatImage, quantities: Sequence[Quantity]
) -> dict[Quantity, _Statistics]:
    """Split what the integrator returns; mitsuba_ext/tungsten_path.cpp describes it."""
    statistics = {}
    start = 0
    for name in quantities:
        channels = CHANNELS[name]
        half_a, half_b, squared_deviations = (
            np.ascontiguousarray(pixels[..., start + i * channels : start + (i + 1) * channels])
            for i in range(3)
        )
        start += 3 * channels + 1
        count = pixels[..., start - 1 : start]
        statistics[name] = _Statistics(
            half_a, half_b, np.ceil(count / 2), np.floor(count / 2), squared_deviations
        )
    return statistics
