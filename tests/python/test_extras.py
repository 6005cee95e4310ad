import re
import tomllib
from pathlib import Path

import pytest

from tungsten_dip.errors import InputError
from tungsten_dip.extras import EXTRA_BY_MODULE, require
from tungsten_dip.hosts.mitsuba.runtime import VERSION

ROOT = Path(__file__).parents[2]


def test_every_extra_is_one_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRA_BY_MODULE.values()) <= set(project["optional-dependencies"])


@pytest.mark.parametrize(
    ("file", "count"),
    [
        ("pyproject.toml", 2),
        ("constraints.txt", 1),
        (".ci/requirements.lock", 1),
        ("mitsuba_ext/tungsten_plugin.hpp", 2),
    ],
)
def test_all_files_name_the_release_of_mitsuba_that_is_asked_for(file: str, count: int) -> None:
    named = re.findall(r"(?:mitsuba|MI_VERSION\)) ?== ?\"?([\d.]+)", (ROOT / file).read_text())
    assert named == [VERSION] * count


def test_a_missing_module_is_named_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)
    message = r"preset paper needs torch; install it with: pip install 'tungsten-dip\[paper\]'"
    with pytest.raises(InputError, match=message):
        require("torch", "preset paper")


def test_an_installed_module_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: object())
    require("torch", "preset paper")
