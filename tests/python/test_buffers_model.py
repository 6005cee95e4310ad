"""Buffers that are made of arrays: what they refuse, and how they tell it."""

from __future__ import annotations

import numpy as np
import pytest

from tungsten_dip.buffers import Buffer, RenderBuffers
from tungsten_dip.errors import InputError

GREY = np.full((4, 5, 3), 0.5, np.float32)


def unaligned() -> np.ndarray:
    return np.frombuffer(b"\0" * (GREY.nbytes + 1), np.float32, offset=1).reshape(GREY.shape)


@pytest.mark.parametrize(
    ("half", "words"),
    [
        (GREY.astype(np.float64), "expected float32, got float64"),
        (GREY[:3], r"expected shape \(4, 5, 3\)"),
        (GREY[:, :, :1], r"expected shape \(4, 5, 3\)"),
        (np.asfortranarray(GREY), "expected aligned rows"),
        (unaligned(), "expected aligned rows"),
    ],
)
def test_arrays_of_another_kind_are_refused(half, words):
    with pytest.raises(InputError, match=f"^color half_a: {words}"):
        RenderBuffers(Buffer(GREY, half, GREY))


def test_what_is_asked_for_helps():
    assert RenderBuffers(Buffer(GREY, unaligned().copy(), np.asfortranarray(GREY).copy())).width == 5
