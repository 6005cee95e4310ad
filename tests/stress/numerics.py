"""Every hard case through every preset, warm start and onnxruntime: what is promised, measured."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from unittest import mock

import numpy as np
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings

from hard_cases import (
    CASES,
    Damaged,
    HardCase,
    Outcome,
    broken_renders,
    exposed,
    healthy,
    measure,
)
from row import Row
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitResult, FitSettings, denoise
from tungsten_dip.onnx import infer

EXPOSURES = (-21, 13)
"""Powers of two."""

DRAFT = FitSettings(preset="draft", threads=1, device="cpu")
FEW_STEPS = 60
PAPER = FitSettings(preset="paper", iterations=4, channels=(4, 8), threads=1, device="cpu")

PATHS = ("draft", "balanced", "final", "paper", "warm start", "onnxruntime")


@dataclass(frozen=True)
class Measured:
    """What became of one case: of draft all numbers, of every path the promises that did not hold."""

    case: HardCase
    draft: Outcome
    broken: dict[str, tuple[str, ...]]

    @property
    def held(self) -> bool:
        """Whether all held."""
        return not any(self.broken.values())


def measured_cases(processes: int = 2) -> list[Measured]:
    """Measure every case of the catalogue."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        outcomes = pool.map(_measured, range(len(CASES)))
        return [Measured(case, *outcome) for case, outcome in zip(CASES, outcomes, strict=True)]


def rows(measured: list[Measured]) -> list[Row]:
    """Return a row per group of cases."""
    groups = list(dict.fromkeys(m.case.group for m in measured))
    found = []
    for group in groups:
        of_group = [m for m in measured if m.case.group == group]
        lost = tuple(
            f"{m.case.name}, {path}: {', '.join(broken)}"
            for m in of_group
            for path, broken in m.broken.items()
            if broken
        )
        tried = len(of_group) * len(PATHS)
        held = sum(not broken for m in of_group for broken in m.broken.values())
        found.append(Row(f"{group}: {len(of_group)} cases, {len(PATHS)} ways", tried, held, lost))
    return found


def other_rows() -> list[Row]:
    """Return what is tried beside the catalogue: threads, learning rates, what a search finds."""
    return [_threads(), _learning_rates(), _search()]


@contextmanager
def quiet() -> Iterator[None]:
    """Let floating-point warnings be errors: nobody promises a result that numpy complains about."""
    with warnings.catch_warnings(), np.errstate(all="warn", under="ignore"):
        warnings.simplefilter("error", RuntimeWarning)
        yield


def _measured(index: int) -> tuple[Outcome, dict[str, tuple[str, ...]]]:
    case = CASES[index]
    damaged = case.make()
    broken: dict[str, tuple[str, ...]] = {}
    drafts: list[FitResult] = []

    def draft() -> FitResult:
        drafts.append(denoise(damaged.buffers, DRAFT))
        return drafts[0]

    def onnx() -> FitResult:
        own = drafts[0].model if drafts else None
        return infer(own or _healthy(DRAFT).model, damaged.buffers, threads=1)

    ways: dict[str, Callable[[], FitResult]] = {
        "draft": draft,
        "balanced": lambda: denoise(damaged.buffers, _few("balanced")),
        "final": lambda: denoise(damaged.buffers, _few("final")),
        "paper": lambda: denoise(damaged.buffers, PAPER),
        "warm start": lambda: denoise(damaged.buffers, DRAFT, warm_start=_healthy(DRAFT).model),
        "onnxruntime": onnx,
    }
    drafted = Outcome(False)
    for path, fit in ways.items():
        try:
            with quiet():
                result = fit()
        except InputError as refused:
            # A network of another image may not fit this one; it says so in one line.
            one_line = "\n" not in str(refused) and path in ("warm start", "onnxruntime")
            broken[path] = () if one_line else (f"refused: {refused}",)
            continue
        except Exception as error:
            broken[path] = (f"{type(error).__name__}: {error}",)
            continue
        undamaged = None
        if path in ("draft", "balanced", "final") and np.array_equal(damaged.reference, healthy().reference):
            undamaged = _healthy(DRAFT if path == "draft" else _few(path))
        outcome = measure(result, damaged, undamaged)
        found = outcome.broken(case)
        if path == "draft":
            drafted = outcome
            found += _repeated(case, damaged, result)
        elif path == "paper":  # clips highlights, and has had no time to learn anything
            found = tuple(text for text in found if text == "finite")
        elif path == "onnxruntime" and drafts and drafts[0].model is not None:
            found += () if _close(result.color, drafts[0].color) else ("differs from torch",)
        broken[path] = found
    return drafted, broken


def _repeated(case: HardCase, damaged: Damaged, first: FitResult) -> tuple[str, ...]:
    """Return what is broken of: same seed, same bits (with other threads, too); the exposure is undone."""
    broken = []
    with quiet():
        again = denoise(damaged.buffers, replace(DRAFT, threads=2))
        if not np.array_equal(first.color, again.color):
            broken.append("seed")
        for exponent in EXPOSURES:
            brighter = exposed(damaged.buffers, exponent)
            if "exposure" in case.unpromised or not _same_digits(damaged.buffers, brighter, exponent):
                continue
            result = denoise(brighter, DRAFT)
            if not _close(result.color, first.color * np.float32(2.0**exponent)):
                broken.append(f"exposure 2^{exponent}")
    return tuple(broken)


def _same_digits(buffers: RenderBuffers, scaled: RenderBuffers, exponent: int) -> bool:
    """Whether float32 can hold the scaled radiance without overflow and underflow."""
    back = exposed(scaled, -exponent)
    return all(
        np.array_equal(a, b, equal_nan=True)
        for (_, a), (_, b) in zip(buffers.color.planes(), back.color.planes(), strict=True)
    )


def _close(image: np.ndarray, expected: np.ndarray) -> bool:
    typical = max(float(np.median(expected)), float(np.finfo(np.float32).tiny))
    return bool(np.allclose(image, expected, rtol=1e-4, atol=1e-4 * typical))


def _few(preset: str) -> FitSettings:
    return replace(DRAFT, preset=preset, iterations=FEW_STEPS)


@cache
def _healthy(settings: FitSettings) -> FitResult:
    return denoise(healthy().buffers, settings)


def _threads() -> Row:
    expected = _healthy(DRAFT).color
    counts = (2, 3, 8, 16, 64)
    lost = tuple(
        f"{count} threads: other bits"
        for count in counts
        if not np.array_equal(denoise(healthy().buffers, replace(DRAFT, threads=count)).color, expected)
    )
    return Row("2 to 64 threads, same bits", len(counts), len(counts) - len(lost), lost)


def _learning_rates() -> Row:
    case = HardCase("Settings", "learning rate", healthy)
    lost = []
    ways = {preset: _few(preset) for preset in ("draft", "balanced", "final")} | {"paper": PAPER}
    with (
        mock.patch("tungsten_dip.fit.network.training.LEARNING_RATE", 1.0),
        mock.patch("tungsten_dip.fit.paper.fit.LEARNING_RATE", 0.1),
    ):
        for path, settings in ways.items():
            found = measure(denoise(healthy().buffers, settings), healthy()).broken(case)
            if path == "paper":
                found = tuple(text for text in found if text == "finite")
            lost += [f"{path}: {text}" for text in found]
        refitted = infer(_healthy(DRAFT).model, healthy().buffers, threads=1, refit_steps=20)
        lost += [f"onnxruntime: {text}" for text in measure(refitted, healthy()).broken(case)]
    return Row("a learning rate 100 times too high", len(ways) + 1, len(ways) + 1 - len(lost), tuple(lost))


def _search(examples: int = 1500) -> Row:
    """Let hypothesis search for renders that break a fit."""
    tried = 0

    @hypothesis_settings(
        max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(broken_renders())
    def search(buffers: RenderBuffers) -> None:
        nonlocal tried
        tried += 1
        with quiet():
            result = denoise(buffers, replace(DRAFT, iterations=2))
        assert np.isfinite(result.color).all()
        assert (result.color >= 0).all()

    try:
        search()
    except Exception as error:
        return Row("renders that hypothesis makes up", tried, tried - 1, (str(error).splitlines()[0],))
    return Row("renders that hypothesis makes up", tried, tried)
