"""The settings of a fit: what is refused, and what is taken for what."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitted_models import short
from synthetic import SyntheticRender
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.write import write_denoised


@pytest.mark.parametrize(
    "changes",
    [
        {"iterations": 0},
        {"iterations": -3},
        {"time_budget_s": 0.0},
        {"time_budget_s": float("nan")},
        {"time_budget_s": float("inf")},
        {"target_error": 10**400},
        {"target_error": -1.0},
        {"threads": 0},
        {"channels": ()},
        {"channels": (8, 0)},
        {"channels": "8,16"},
        {"channels": 8},
        {"channels": (8,) * 9},
        {"channels": (8, 1 << 20)},
        {"iterations": 1.5},
        {"threads": 10**12},
        {"seed": -1},
        {"seed": None},
        {"preset": np.zeros((2, 2))},
        {"threads": np.zeros((2, 2))},
        {"time_budget_s": "3"},
        {"preset": "fast"},
        {"pilot": "OIDN"},
        {"device": "gpu"},
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any]) -> None:
    name = next(iter(changes))
    with pytest.raises(InputError, match=rf"^{name}: expected.*$") as caught:
        FitSettings(**changes)
    assert "\n" not in str(caught.value)


def test_settings_that_would_be_ignored_are_refused() -> None:
    with pytest.raises(InputError, match="network: only the preset paper leaves that open"):
        FitSettings("draft", network="resnet")
    assert FitSettings("paper", network="resnet").network == "resnet"


def test_numbers_of_numpy_are_settings_as_well(render: SyntheticRender, tmp_path: Path) -> None:
    settings = FitSettings(
        "draft", iterations=np.int32(2), seed=np.int64(3), target_error=np.float32(0.5), threads=np.int8(1)
    )
    assert [type(value) for value in (settings.iterations, settings.seed, settings.target_error)] == [
        int,
        int,
        float,
    ]
    write_denoised(tmp_path / "out.exr", denoise(render.buffers, settings), render.buffers)
    assert FitSettings("paper", channels=[np.int64(8), 16]).channels == (8, 16)


def test_settings_come_back_with_the_result(render: SyntheticRender) -> None:
    settings = short(iterations=1, seed=9)
    assert denoise(render.buffers, settings).settings == settings
