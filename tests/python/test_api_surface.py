import importlib.metadata
import inspect
import subprocess
import sys

import pytest

import tungsten_dip

NAMES = {
    "Buffer",
    "Comparison",
    "FitResult",
    "FitSettings",
    "HistoryPoint",
    "InputError",
    "Model",
    "RenderBuffers",
    "__version__",
    "compare",
    "denoise",
    "infer",
    "load_model",
    "load_scene",
    "read_buffers",
    "read_image",
    "render",
    "save_model",
    "write_denoised",
    "write_image",
}


def test_the_public_names_are_these():
    assert set(tungsten_dip.__all__) == NAMES == set(dir(tungsten_dip))


@pytest.mark.parametrize("name", sorted(NAMES - {"__version__"}))
def test_every_public_name_loads_and_is_documented(name):
    public = getattr(tungsten_dip, name)
    assert callable(public)
    assert inspect.getdoc(public)
    assert public.__name__ == name


def test_the_version_is_that_of_the_package():
    assert tungsten_dip.__version__ == importlib.metadata.version("tungsten-dip")


def test_another_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'denoize'"):
        _ = tungsten_dip.denoize


@pytest.mark.parametrize(
    "program",
    [
        "import tungsten_dip",
        "import tungsten_dip; tungsten_dip.FitSettings, tungsten_dip.read_buffers, tungsten_dip.load_scene",
        "from tungsten_dip.cli.tungsten_dip import main; main(['denoise', '--help'])",
        "from tungsten_dip.cli.tungsten import main; main([])",
        "import numpy as np, tungsten_dip as dip;"
        "a, b = np.random.default_rng(0).random((2, 32, 32, 3), np.float32);"
        "noisy = dip.Buffer((a + b) / 2, half_a=a, half_b=b);"
        "assert dip.denoise(dip.RenderBuffers(noisy), dip.FitSettings(preset='draft')).model",
    ],
)
def test_torch_and_mitsuba_load_only_when_needed(program):
    check = (
        "import atexit, sys; atexit.register(lambda: print('torch' in sys.modules, 'mitsuba' in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{check}; {program}"], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "False False"


def test_bad_input_is_a_value_error():
    assert issubclass(tungsten_dip.InputError, ValueError)
    with pytest.raises(tungsten_dip.InputError, match="iterations"):
        tungsten_dip.FitSettings(iterations=0)
