"""What both commands do to denoise: their settings as options, the fit with its progress, the network."""

from __future__ import annotations

import argparse
import logging
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.buffers.tungsten_files import is_named_for_a_plane
from tungsten_dip.cli.console import duration, progress_on_stderr
from tungsten_dip.errors import InputError
from tungsten_dip.fit import denoise
from tungsten_dip.fit.model import Model, check_settings
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings, Preset
from tungsten_dip.hosts.memory import pixels_that_fit
from tungsten_dip.interrupts import deferred_interrupts

_LOG = logging.getLogger(__name__)

_BYTES_PER_PIXEL = {"draft": 550, "balanced": 1100, "final": 1300}
"""A bit less than a fit takes beside its buffers, as measured with 1 million pixels (balanced: with 8)."""

FIT_OPTIONS = ("preset", "pilot", "time_budget_s", "target_error", "device")
"""The settings that both commands leave to the user."""

MAP_HELP = "take this layer of the input for color, albedo, normal, depth, colorA, ..."

_TARGET_ERROR_HELP = "end at this relMSE (epsilon 0.01, in the image's own units)"

REPORT_HELP = "write a page with the pictures, the error and what led to them"


def add_fit_options(
    parser: argparse._ActionsContainer, prefix: str, presets: Sequence[str] = get_args(Preset)
) -> None:
    """Add the options of a fit that both commands have, as ``--{prefix}preset`` and so on."""
    add, flag = parser.add_argument, f"--{prefix}"
    devices = get_args(get_type_hints(FitSettings)["device"])
    add(f"{flag}preset", dest="preset", choices=presets, help="how to fit (default: balanced)")
    pilots = get_args(get_type_hints(FitSettings)["pilot"])
    add(
        f"{flag}pilot",
        dest="pilot",
        choices=pilots,
        help="another denoiser, whose image is an extra pilot (default: none)",
    )
    add(f"{flag}time-budget", dest="time_budget_s", metavar="S", type=_budget, help="end after 90s, 5m, ...")
    add(f"{flag}target-error", dest="target_error", metavar="E", type=_error, help=_TARGET_ERROR_HELP)
    add(f"{flag}device", dest="device", choices=devices, help="where to fit (default: auto)")
    add(f"{flag}save-model", dest="save_model", metavar="M.onnx", type=Path, help="save the fitted network")
    add(f"{flag}warm-start", dest="warm_start", metavar="M.onnx", type=Path, help="start from this network")


def _budget(text: str) -> float:
    return _above_zero(text, duration(text))


def _error(text: str) -> float:
    try:
        return _above_zero(text, float(text))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a relMSE such as 0.003, got '{text}'") from None


def _above_zero(text: str, value: float) -> float:
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a finite number above 0, got '{text}'")
    return value


def add_file_options(parser: argparse._ActionsContainer) -> None:
    """Add how buffers are read and their results are written."""
    add_map(parser)
    parser.add_argument("--half", dest="float16", action="store_true", help="write 16-bit floats")


def add_map(parser: argparse._ActionsContainer) -> None:
    """Add how buffers are read (`layer_mapping`)."""
    parser.add_argument(
        "--map", metavar="NAME=CHANNEL", type=_name_and_channel, action="append", default=[], help=MAP_HELP
    )


def layer_mapping(options: argparse.Namespace) -> dict[str, str]:
    """Return what ``--map`` settles: the layer by the name of what it is taken for.

    Raises InputError if a name is given twice.
    """
    mapping: dict[str, str] = {}
    for name, channel in options.map:
        if name in mapping:
            raise InputError(f"--map {name}: expected one layer, got {mapping[name]} and {channel}; omit one")
        mapping[name] = channel
    return mapping


def fit_settings(
    options: Mapping[str, Any], names: Sequence[str], warm_start: Model | None = None
) -> FitSettings:
    """Return the settings (a model's, to start from it) with those of the named options that were given.

    ``options`` are a command's by name, None where an option was not given.
    """
    preset = options["preset"]
    if warm_start is not None and preset not in (None, warm_start.settings.preset):
        # Reported here: what else the model leaves open may be nothing that this preset has.
        check_settings(warm_start, FitSettings(preset))
    settings = FitSettings() if warm_start is None else replace(warm_start.settings, iterations=None)
    return replace(settings, **{name: options[name] for name in names if options[name] is not None})


def load_warm_start(path: Path | None) -> Model | None:
    """Return the model that the fit is to start from, None without a path."""
    if path is None:
        return None
    with deferred_interrupts():
        from tungsten_dip.onnx import load_model  # imports ONNX

    return load_model(path)


def check_outputs_are_not_inputs(
    outputs: Iterable[Path | None],
    inputs: Collection[Path],
    folders: Collection[Path],
    mapping: Mapping[str, str],
) -> None:
    """Raise InputError if one of the outputs, where they are named, is among the resolved inputs.

    Nor may one have a name that is read in one of the ``folders`` (resolved, with their ``--map``), whether
    there is such a file or not: the next run would take it for what was rendered.
    """
    for path in filter(None, outputs):
        file = path.resolve()
        if file in inputs or (file.parent in folders and is_named_for_a_plane(file, mapping)):
            raise InputError(f"{path}: is one of the files that are read; name another file")


def warn_of_little_memory(path: Path, buffers: RenderBuffers, preset: Preset) -> None:
    """Log a warning if a fit may be killed for want of memory, of which the system says nothing."""
    if preset in _BYTES_PER_PIXEL:
        most = pixels_that_fit(_BYTES_PER_PIXEL[preset])
        if buffers.width * buffers.height > most:
            _LOG.warning(
                "%s: there may be too little memory for %d x %d pixels, with which the system may end this "
                "without a word: expected %d at most; free some%s",
                path,
                buffers.width,
                buffers.height,
                most,
                " or crop it" if preset == "draft" else ", crop it or use --preset draft",
            )


def denoise_with_progress(
    buffers: RenderBuffers, settings: FitSettings, warm_start: Model | None = None
) -> FitResult:
    """Denoise the buffers and show progress on stderr."""
    with progress_on_stderr("denoising") as progress:
        return denoise(buffers, settings, progress, warm_start=warm_start)


def write_model(path: Path, result: FitResult) -> None:
    """Save the fitted network.

    Raises InputError if nothing was fitted, or the file cannot be written.
    """
    from tungsten_dip.onnx import save_model

    if result.model is None:
        raise InputError(f"{path}: not written: no network was fitted, as the image has no noise")
    save_model(path, result.model)


def _name_and_channel(text: str) -> tuple[str, str]:
    name, separator, channel = text.partition("=")
    if not (name and separator and channel):
        raise argparse.ArgumentTypeError(f"expected NAME=CHANNEL such as color=beauty, got '{text}'")
    return name, channel
