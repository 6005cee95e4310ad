"""The options of the command ``tungsten``: its parser, the options as a record, and what they exclude."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import tungsten_dip
from tungsten_dip.cli.console import Parser, minutes
from tungsten_dip.cli.denoising import FIT_OPTIONS, REPORT_HELP, add_fit_options
from tungsten_dip.errors import InputError
from tungsten_dip.fit.settings import Preset
from tungsten_dip.hosts import Host


@dataclass(frozen=True)
class Options:
    """What the command line asks for; None and False where it does not. Times are in seconds."""

    scenes: tuple[Path, ...]
    threads: int | None
    restart: bool
    checkpoint: float | None
    input_directory: Path | None
    output_directory: Path | None
    spp: int | None
    timeout: float | None
    seed: int | None
    output_file: Path | None
    hdr_output_file: Path | None
    host: Host
    dip_denoise: bool
    preset: Preset | None
    pilot: str | None
    time_budget_s: float | None
    target_error: float | None
    device: str | None
    save_model: Path | None
    warm_start: Path | None
    dip_preview: bool
    report: Path | None


def parse(arguments: Sequence[str]) -> tuple[Options, list[str]]:
    """Return the options, and the arguments as the native command takes them.

    Raises InputError if the arguments cannot be read.
    """
    arguments = list(arguments)
    end = arguments.index("--") if "--" in arguments else len(arguments)
    after = [Path(scene) for scene in arguments[end + 1 :]]
    given = vars(_parser().parse_intermixed_args(arguments[:end]))  # which loses the sign that options end
    options = Options(**{**given, "scenes": (*given["scenes"], *after)})
    # The native command does not know the sign, but an absolute path is no option to it.
    native = [*arguments[:end], *(str(scene.absolute()) for scene in after)]
    return options, native


def print_help() -> None:
    """Print what the options mean."""
    _parser().print_help()


def stock_arguments(arguments: Sequence[str]) -> list[str]:
    """Return the native command's arguments without ``--host``, which the stock command does not have."""
    stock, rest = [], iter(arguments)
    for argument in rest:
        if argument == "--host":
            next(rest)
        elif not argument.startswith("--host="):
            stock.append(argument)
    return stock


def check_options(options: Options) -> None:
    """Raise InputError if the options exclude one another, or a folder is missing."""
    if not options.dip_denoise:
        for name in (*FIT_OPTIONS, "report", "save_model", "warm_start", "dip_preview"):
            if getattr(options, name) not in (None, False):
                raise InputError("--dip options are given, yet nothing is to be denoised; add --dip-denoise")
    for name in ("output_file", "hdr_output_file", "report", "save_model"):
        path, count = getattr(options, name), len(options.scenes)
        if path is not None and count > 1:
            raise InputError(f"{path}: one file for {count} scenes; render them one at a time")
    if options.input_directory is not None and not options.input_directory.is_dir():
        raise InputError(f"-i {options.input_directory}: no such folder; check the name")


def check_checkpoints(options: Options, host: str) -> None:
    """Raise InputError if the host saves no checkpoints as they are asked for."""
    if host == "mitsuba" and (options.checkpoint or options.dip_preview):
        raise InputError(
            "Mitsuba saves no checkpoints for --checkpoint and --dip-preview; add --host tungsten"
        )
    if options.dip_preview and options.checkpoint == 0:
        raise InputError(
            "--checkpoint 0: without checkpoints there is no --dip-preview; name a time between them, as 5m"
        )


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="tungsten", description="Render scenes in Tungsten's format, and denoise them.")
    add = parser.add_argument
    add("scenes", metavar="scene", type=Path, nargs="*", help="scene files (JSON)")
    add("-v", "--version", action="version", version=f"tungsten, version {tungsten_dip.__version__}")
    add("-t", "--threads", metavar="N", type=int, help="number of threads")
    add("-r", "--restart", action="store_true", help="ignore saved render checkpoints and start from 0 spp")
    add(
        "-c",
        "--checkpoint",
        metavar="TIME",
        type=minutes,
        help="minutes between checkpoints, or 90s, 2h; 0: none",
    )
    add("-i", "--input-directory", metavar="DIR", type=Path, help="where the files of the scenes are")
    add("-d", "--output-directory", metavar="DIR", type=Path, help="where output goes; made if need be")
    add("--spp", metavar="N", type=int, help="samples per pixel in place of the scene's")
    add(
        "--timeout",
        metavar="TIME",
        type=minutes,
        help="render for so many minutes at most, or 90s, 2h; 0: no limit",
    )
    add("-s", "--seed", metavar="N", type=int, help="random seed of the render")
    add("-o", "--output-file", metavar="FILE", type=Path, help="PNG in place of the scene's output_file")
    add("-e", "--hdr-output-file", metavar="FILE", type=Path, help="EXR, PFM or HDR in place of the scene's")
    add(
        "--host",
        choices=get_args(Host),
        default="auto",
        help="who renders (auto: Tungsten if it was built in)",
    )
    dip = parser.add_argument_group("denoising")
    dip.add_argument(
        "--dip-denoise", action="store_true", help="denoise the picture with a network fitted to it"
    )
    add_fit_options(dip, prefix="dip-")
    dip.add_argument(
        "--dip-preview",
        action="store_true",
        help="denoise quickly every minute, or at the checkpoints, as <stem>_preview.png (with Tungsten)",
    )
    dip.add_argument("--dip-report", dest="report", metavar="R.html", type=Path, help=REPORT_HELP)
    return parser
