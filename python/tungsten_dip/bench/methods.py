"""What is compared: our presets and time budgets, the published method, other denoisers, more samples."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import get_args

import numpy as np

from tungsten_dip.bench.nfor import nfor_image
from tungsten_dip.bench.paper_curve import checkpoints_up_to, paper_curve
from tungsten_dip.bench.sets import BenchSet
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.extras import require
from tungsten_dip.fit import denoise
from tungsten_dip.fit.paper.constants import ITERATIONS
from tungsten_dip.fit.pilots.oidn import Quality, oidn_image
from tungsten_dip.fit.settings import MOST_ITERATIONS, FitSettings, Preset
from tungsten_dip.hosts import render
from tungsten_dip.hosts.options import checked_option
from tungsten_dip.progress import Progress
from tungsten_dip.scene.parse import load_scene

_LOG = logging.getLogger(__name__)

KINDS = ("presets", "budgets", "paper", "oidn", "nfor", "samples")
"""What `Plan.kinds` chooses from."""

OUR_PRESETS: tuple[Preset, ...] = ("draft", "balanced", "final")

OURS, IN_TIME, PAPER, OIDN, NFOR, SAMPLES = SERIES = (
    "our presets",
    "ours, in a given time",
    "published method",
    "Open Image Denoise",
    "NFOR",
    "more samples",
)
NOISY = "noisy"


@dataclass(frozen=True)
class Outcome:
    """An image, and the seconds and iterations of its computation where they are known."""

    label: str
    image: np.ndarray
    seconds: float | None
    iterations: int | None = None
    loss: float | None = None
    psnr_noisy: float | None = None


@dataclass(frozen=True)
class Method:
    """One way to compute a denoised image; a run of it gives one outcome for each of its labels.

    ``marks`` are the labels in the shortest words, for plots that show the series by colour. ``settings``
    distinguishes two runs of one label. ``run`` takes the number of the repeat. A method that is not
    ``timed`` is run once. ``pictured`` are the labels that a page shows the images of.
    """

    series: str
    labels: tuple[str, ...]
    marks: tuple[str, ...]
    settings: str
    run: Callable[[int, Progress], list[Outcome]]
    timed: bool = True
    pictured: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What to measure.

    ``presets`` and ``budgets_s`` are ours; a budget is one for ``final``. ``nfor_s`` is the time of the saved
    NFOR image, ``denoiser`` Tungsten's command to measure it with. ``scenes`` are those of the sets in their
    order, if any; they are rendered with ``sample_factors`` times the samples.
    """

    kinds: tuple[str, ...] = KINDS
    presets: tuple[Preset, ...] = OUR_PRESETS
    budgets_s: tuple[float, ...] = (2, 5, 10, 20)
    paper_iterations: int = ITERATIONS
    nfor_s: float | None = None
    denoiser: Path | None = None
    scenes: tuple[Path, ...] = ()
    sample_factors: tuple[int, ...] = (2, 4, 16)
    repeats: int = 3
    threads: int | None = None

    def __post_init__(self) -> None:
        unknown = [kind for kind in self.kinds if kind not in KINDS]
        if unknown:
            raise InputError(f"methods: expected some of {', '.join(KINDS)}, got {unknown[0]}")
        for preset in self.presets:
            if preset not in OUR_PRESETS:
                raise InputError(f"presets: expected some of {', '.join(OUR_PRESETS)}, got {preset}")
        for name in ("repeats", "paper_iterations"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name), 1, MOST_ITERATIONS))
        if self.threads is not None:
            object.__setattr__(self, "threads", checked_option("threads", self.threads))


def methods_for(sets: Sequence[BenchSet], plan: Plan) -> dict[str, list[Method]]:
    """Return the methods of every set by its name. What a machine or a set lacks is left out and logged.

    Raises InputError if the plan names something that cannot be used.
    """
    if plan.scenes and len(plan.scenes) != len(sets):
        raise InputError(f"expected a scene for each of {len(sets)} sets, got {len(plan.scenes)}")
    if plan.denoiser is not None and not plan.denoiser.is_file():
        raise InputError(f"{plan.denoiser}: no such file; name Tungsten's command denoiser")
    plan = replace(plan, kinds=tuple(kind for kind in plan.kinds if _can_run(kind)))
    methods = {}
    for index, bench_set in enumerate(sets):
        scene = plan.scenes[index] if plan.scenes else None
        methods[bench_set.name] = list(_methods(bench_set, plan, scene))
        if len(methods[bench_set.name]) == 1:
            raise InputError(
                f"{bench_set.name}: nothing to compare the noisy image with; install what the methods need, "
                "give --scene for more samples, or name other methods"
            )
    return methods


def paper_method(
    bench_set: BenchSet, settings: FitSettings, counts: Sequence[int], label_of: Callable[[int], str]
) -> Method:
    """Return one fit of the published method, with an outcome after each of the iterations ``counts``."""

    def run(repeat: int, progress: Progress) -> list[Outcome]:
        return [
            Outcome(label_of(p.iteration), p.color, p.seconds, p.iteration, p.loss, p.psnr_noisy)
            for p in paper_curve(bench_set.buffers, settings, counts, progress)
        ]

    labels = tuple(label_of(count) for count in counts)
    marks = tuple(map(str, counts))
    return Method(PAPER, labels, marks, settings_text(settings), run, pictured=labels[-1:])


def settings_text(settings: FitSettings) -> str:
    """Return the settings that are not the default, ``preset=draft threads=2``."""
    default = FitSettings()
    values = ((field.name, getattr(settings, field.name)) for field in fields(settings))
    return " ".join(
        f"{name}={','.join(map(str, value)) if isinstance(value, tuple) else value}"
        for name, value in values
        if value != getattr(default, name)
    )


def _can_run(kind: str) -> bool:
    try:
        if kind == "paper":
            require("torch", "preset paper")
        elif kind == "oidn":
            require("pyoidn", "Open Image Denoise")
    except InputError as error:
        _LOG.warning("%s; measured without", error)
        return False
    return True


def _methods(bench_set: BenchSet, plan: Plan, scene: Path | None) -> Iterator[Method]:
    noisy = Outcome(NOISY, bench_set.buffers.color.mean, None)
    yield Method(
        NOISY, (NOISY,), (NOISY,), "", lambda repeat, progress: [noisy], timed=False, pictured=(NOISY,)
    )
    if "presets" in plan.kinds:
        for preset in plan.presets:
            settings = FitSettings(preset, threads=plan.threads)
            yield _ours(bench_set, OURS, preset, preset, settings, pictured=True)
        if "oidn" in plan.kinds and "final" in plan.presets:
            guided = FitSettings("final", pilot="oidn", threads=plan.threads)
            yield _ours(bench_set, OURS, "final, with OIDN as a pilot", "with OIDN", guided, pictured=True)
    if "budgets" in plan.kinds:
        for budget_s in plan.budgets_s:
            settings = FitSettings("final", time_budget_s=budget_s, threads=plan.threads)
            mark = f"{budget_s:g} s"
            yield _ours(bench_set, IN_TIME, f"final in {mark}", mark, settings, pictured=False)
    if "paper" in plan.kinds:
        counts = checkpoints_up_to(plan.paper_iterations)
        settings = FitSettings("paper", threads=plan.threads)
        yield paper_method(bench_set, settings, counts, lambda count: f"paper, {count} iterations")
    if "oidn" in plan.kinds:
        for quality in get_args(Quality):
            yield _oidn(bench_set, quality, plan.threads)
    if "nfor" in plan.kinds:
        yield from _nfor(bench_set, plan)
    if "samples" in plan.kinds:
        if scene is not None:
            yield from _samples(bench_set, plan, scene)
        else:
            _LOG.info("%s: measured without more samples: no scene is given", bench_set.name)


def _ours(
    bench_set: BenchSet, series: str, label: str, mark: str, settings: FitSettings, pictured: bool
) -> Method:
    def run(repeat: int, progress: Progress) -> list[Outcome]:
        start = time.perf_counter()
        result = denoise(bench_set.buffers, settings, progress)
        if result.interrupted:
            raise KeyboardInterrupt  # the fit ended early, which is no measurement
        return [Outcome(label, result.color, time.perf_counter() - start, result.iterations)]

    shown = (label,) if pictured else ()
    return Method(series, (label,), (mark,), settings_text(settings), run, pictured=shown)


def _oidn(bench_set: BenchSet, quality: Quality, threads: int | None) -> Method:
    label = f"OIDN {quality}"
    buffers = bench_set.buffers

    def run(repeat: int, progress: Progress) -> list[Outcome]:
        albedo = buffers.albedo.mean if buffers.albedo else None
        normal = buffers.normal.mean if buffers.normal else None
        start = time.perf_counter()
        image = oidn_image(buffers.color.mean, albedo, normal, quality=quality, threads=threads)
        return [Outcome(label, image, time.perf_counter() - start)]

    shown = (label,) if quality == "high" else ()
    return Method(OIDN, (label,), (quality,), f"quality={quality}", run, pictured=shown)


def _nfor(bench_set: BenchSet, plan: Plan) -> Iterator[Method]:
    label, denoiser = "NFOR", plan.denoiser
    color = bench_set.buffers.color
    if denoiser is not None and (color.halves is None or color.variance is None):
        _LOG.info("%s: the colour has no halves or no variance: NFOR is left out", bench_set.name)
    elif denoiser is not None:

        def run(repeat: int, progress: Progress) -> list[Outcome]:
            start = time.perf_counter()
            image = nfor_image(bench_set.buffers, denoiser)
            return [Outcome(label, image, time.perf_counter() - start)]

        yield Method(NFOR, (label,), ("",), "measured", run, pictured=(label,))
    elif bench_set.nfor is not None:
        saved = Outcome(label, bench_set.nfor, plan.nfor_s)
        settings = f"saved, {plan.nfor_s:g} s" if plan.nfor_s else "saved"
        yield Method(
            NFOR,
            (label,),
            ("",),
            settings,
            lambda repeat, progress: [saved],
            timed=False,
            pictured=(label,),
        )
    else:
        _LOG.info(
            "%s: no nfor.exr beside the buffers and no denoiser named: NFOR is left out", bench_set.name
        )


def _samples(bench_set: BenchSet, plan: Plan, scene_path: Path) -> Iterator[Method]:
    scene = load_scene(scene_path)
    size = (bench_set.buffers.width, bench_set.buffers.height)
    if tuple(scene.camera.resolution) != size:
        raise InputError(
            f"{scene_path}: expected the resolution of {bench_set.name}, {size[0]} x {size[1]}, got "
            f"{scene.camera.resolution[0]} x {scene.camera.resolution[1]}"
        )
    known = bench_set.buffers.spp
    spp = scene.renderer.spp if known is None else round(float(np.mean(known)))

    def method(factor: int) -> Method:
        label = f"{factor} times the samples"

        def run(repeat: int, progress: Progress) -> list[Outcome]:
            start = time.perf_counter()
            # Another seed than a first render has, so that it repeats none of its samples.
            rendered = render(
                scene, spp=factor * spp, seed=1000 + repeat, threads=plan.threads, progress=progress
            )
            # A denoiser needs the noisy render as well, so only the additional time counts here.
            seconds = (time.perf_counter() - start) * (1 - 1 / factor)
            return [Outcome(label, rendered.color.mean, seconds)]

        return Method(SAMPLES, (label,), (f"{factor}x",), f"spp={factor * spp}", run)

    for factor in plan.sample_factors:
        yield method(factor)
