"""Ctrl-C, and errors, during the training and the pilots of all samples that are made beside it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import wait
from contextlib import suppress
from dataclasses import replace
from threading import Event, main_thread
from typing import Any

import numpy as np
import pytest

from fitted_models import check_result, short
from synthetic import SyntheticRender
from tungsten_dip import interrupts
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.errors import InputError
from tungsten_dip.fit import blending, denoise
from tungsten_dip.fit.network import training
from tungsten_dip.fit.network.training import Training
from tungsten_dip.fit.output.all_samples import pilots_of_all_samples
from tungsten_dip.fit.output.denoised import denoised_image
from tungsten_dip.fit.settings import Preset


def test_ctrl_c_during_the_training_returns_what_was_reached(render: SyntheticRender) -> None:
    raised = []

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE") and not raised:
            raised.append(fraction)
            raise KeyboardInterrupt

    result = denoise(render.buffers, short(iterations=100_000), interrupt)
    assert len(raised) == 1
    check_result(result, render.buffers)
    assert result.interrupted
    assert any(note.startswith(f"interrupted at step {result.iterations}") for note in result.notes)
    assert 1 <= result.iterations < 1000


@pytest.fixture
def _sigint_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, also where a background job was started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_does_not_wait_for_the_pilots_of_all_samples(
    render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []

    def until_given_up(*arguments: Any, **options: Any) -> tuple[FloatImage, ...]:
        told.append(options["given_up"].wait(timeout=60))
        made = pilots_of_all_samples(*arguments, **options)
        assert made == ()
        return made

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE"):
            raise KeyboardInterrupt

    monkeypatch.setattr(blending, "pilots_of_all_samples", until_given_up)
    result = denoise(render.buffers, short(preset="balanced", threads=2, iterations=100_000), interrupt)
    check_result(result, render.buffers)
    assert told == [True]
    assert result.interrupted
    assert any(note.endswith("the image is made of the halves alone") for note in result.notes)


@pytest.mark.usefixtures("_sigint_interrupts")
@pytest.mark.parametrize("waits", [True, False])
def test_ctrl_c_after_the_training_leaves_what_was_trained(
    waits: bool, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the main thread waits for the pilots of all samples by then, or is about to."""
    waiting, told = Event(), []

    def wait_or_interrupt(*arguments: Any, **options: Any) -> Any:
        first = not waiting.is_set()
        waiting.set()
        if first and not waits:
            signal.raise_signal(signal.SIGINT)
        return wait(*arguments, **options)

    def after_training(*arguments: Any, **options: Any) -> tuple[FloatImage, ...]:
        told.append(waiting.wait(timeout=60))
        if waits:
            # Python raises it in the main thread, which waits for this one.
            signal.pthread_kill(main_thread().ident or 0, signal.SIGINT)
        told.append(options["given_up"].wait(timeout=60))
        return pilots_of_all_samples(*arguments, **options)

    monkeypatch.setattr(interrupts, "wait", wait_or_interrupt)
    monkeypatch.setattr(blending, "pilots_of_all_samples", after_training)
    result = denoise(render.buffers, short(preset="balanced", threads=2))
    check_result(result, render.buffers)
    assert told == [True, True]
    assert result.interrupted
    assert result.iterations == 30
    assert "interrupted after the training of 30 steps" in result.notes
    assert any(note.endswith("the image is made of the halves alone") for note in result.notes)


@pytest.mark.usefixtures("_sigint_interrupts")
@pytest.mark.parametrize("preset", ["draft", "balanced", "final"])
def test_ctrl_c_while_the_image_is_made_waits_for_it(
    preset: Preset, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return denoised_image(*arguments)

    whole = denoise(render.buffers, short(preset=preset))
    monkeypatch.setattr(blending, "denoised_image", interrupted)
    result = denoise(render.buffers, short(preset=preset))
    assert result.interrupted
    assert result.notes == whole.notes
    np.testing.assert_array_equal(result.color, whole.color)


def test_ctrl_c_during_the_training_keeps_complete_pilots_of_all_samples(render: SyntheticRender) -> None:
    """With one thread they are computed before."""

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE"):
            raise KeyboardInterrupt

    settings = short(preset="balanced")
    result = denoise(render.buffers, settings, interrupt)
    whole = denoise(render.buffers, replace(settings, iterations=1))
    assert result.interrupted
    assert result.iterations == 1
    assert not any("halves alone" in note for note in result.notes)
    np.testing.assert_array_equal(result.color, whole.color)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_failure_beside_the_training_is_raised_when_it_is_waited_for(
    threads: int, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = []

    def fail(*_: Any, **options: Any) -> tuple[FloatImage, ...]:
        raise InputError("a test's")

    def recorded(*arguments: Any) -> Training:
        trained.append(arguments)
        return training.train(*arguments)

    monkeypatch.setattr(blending, "pilots_of_all_samples", fail)
    monkeypatch.setattr(blending, "train", recorded)
    with pytest.raises(InputError, match="a test's"):
        denoise(render.buffers, short(preset="balanced", threads=threads))
    assert len(trained) == threads - 1


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_training_does_not_wait_for_the_pilots_of_all_samples(
    threads: int, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Training:
        raise InputError("a test's")

    def until_given_up(*_: Any, given_up: Event, **options: Any) -> tuple[FloatImage, ...]:
        assert threads == 1 or given_up.wait(timeout=60)
        return ()

    monkeypatch.setattr(blending, "train", fail)
    monkeypatch.setattr(blending, "pilots_of_all_samples", until_given_up)
    with pytest.raises(InputError, match="a test's"):
        denoise(render.buffers, short(preset="balanced", threads=threads))


@pytest.mark.parametrize("asks", [True, False])
def test_a_termination_that_was_lost_is_raised_when_asked_or_at_the_end(asks: bool) -> None:
    """Python ignores exceptions in finalisers."""
    done = []

    def work() -> None:
        with interrupts.terminations_as_interrupts() as raise_if_asked:
            raise_if_asked()
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
            done.append("one")
            if asks:
                raise_if_asked()
            done.append("another")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == (["one"] if asks else ["one", "another"])
