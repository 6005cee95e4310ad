"""The command ``tungsten-dip``: denoise saved buffers, look into scenes and files, compare, measure."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np

import tungsten_dip
from tungsten_dip.buffers.atomic import check_writable, write_text
from tungsten_dip.buffers.image_file import first_pixel
from tungsten_dip.buffers.read import input_files, read_buffers, read_image
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.buffers.write import write_error_map
from tungsten_dip.cli.bench import add_bench
from tungsten_dip.cli.console import (
    Parser,
    add_json,
    add_threads,
    integers,
    outcome_on_stdout,
    progress_on_stderr,
    run,
    writing_stdout,
)
from tungsten_dip.cli.denoising import (
    FIT_OPTIONS,
    REPORT_HELP,
    add_file_options,
    add_fit_options,
    add_map,
    check_outputs_are_not_inputs,
    denoise_with_progress,
    fit_settings,
    layer_mapping,
    load_warm_start,
    warn_of_little_memory,
    write_model,
)
from tungsten_dip.cli.outcome import Outcome
from tungsten_dip.cli.sequence import add_sequence
from tungsten_dip.errors import InputError
from tungsten_dip.fit import check_ready
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import PAPER_SETTINGS, FitSettings, Inputs, Preset
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.interrupts import deferred_interrupts
from tungsten_dip.remarks import remarks_from_log
from tungsten_dip.report.page import report_page
from tungsten_dip.scene.effects import inspect_facts, inspect_text
from tungsten_dip.scene.parse import load_scene

INPUT_HELP = "a folder of Tungsten's buffers, a scene that names them, or a multi-layer EXR"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 only if every output asked for was written."""
    return run("tungsten-dip", lambda: _run(arguments))


def _run(arguments: Sequence[str] | None) -> None:
    options = _parser().parse_args(arguments)
    with outcome_on_stdout(options.json) as tell:
        outcome: Outcome = options.action(options)
        with writing_stdout():
            tell(outcome)
    if outcome.error is not None:
        raise InputError(outcome.error)
    if outcome.interrupted:
        raise KeyboardInterrupt  # what was reached is written; the exit status says that it is not all


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="tungsten-dip", description="Denoise saved buffers, inspect scenes, compare images.")
    parser.add_argument("--version", action="version", version=f"tungsten-dip {tungsten_dip.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")

    denoise = commands.add_parser("denoise", help="denoise saved buffers")
    denoise.set_defaults(action=_denoise)
    add = denoise.add_argument
    add("input", metavar="INPUT", type=Path, help=INPUT_HELP)
    _add_output_options(denoise)
    add_fit_options(denoise, prefix="")
    add("--iterations", metavar="N", type=int, help="stop the fit after this many iterations")
    add(
        "--seed",
        metavar="N",
        type=int,
        help="of first weights, input noise and halves that are drawn (default: 0)",
    )
    add_threads(denoise)
    types = get_type_hints(FitSettings)
    paper = denoise.add_argument_group("the network of the published method, with --preset paper")
    paper.add_argument("--network", choices=get_args(types["network"]), help="(default: skip)")
    paper.add_argument("--inputs", choices=get_args(Inputs), help="(default: all+random)")
    paper.add_argument("--scheme", choices=get_args(types["scheme"]), help="(default: iic)")
    paper.add_argument("--channels", metavar="8,16,...", type=integers, help="(default: 8,16,32,64,128)")

    infer = commands.add_parser("infer", help="denoise with a network that was saved")
    infer.set_defaults(action=_infer)
    add = infer.add_argument
    add("model", metavar="M.onnx", type=Path, help="what denoise --save-model wrote")
    add("input", metavar="INPUT", type=Path, help=INPUT_HELP)
    _add_output_options(infer)
    add("--refit", metavar="N", type=int, default=0, help="first train on this image, N steps at most")
    add("--save-model", metavar="M.onnx", type=Path, help="save the network after --refit")
    add_threads(infer)

    inspect = commands.add_parser("inspect", help="show what a scene calls for, or what a file holds")
    inspect.set_defaults(action=_inspect)
    inspect.add_argument("input", metavar="SCENE|INPUT", type=Path, help=f"a scene, or {INPUT_HELP}")
    add_map(inspect)

    compare = commands.add_parser("compare", help="measure an image against its reference")
    compare.set_defaults(action=_compare)
    compare.add_argument("image", metavar="IMAGE", type=Path)
    compare.add_argument("reference", metavar="REFERENCE", type=Path)

    for command in (denoise, infer, inspect, compare):
        add_json(command)
    add_sequence(commands)
    add_bench(commands)
    return parser


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add what becomes of a denoised image, and how its buffers are read."""
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.exr",
        type=Path,
        required=True,
        help="where to write the denoised image",
    )
    files = parser.add_argument_group("files")
    add_file_options(files)
    add = files.add_argument
    add("--error-map", metavar="E.exr", type=Path, help="write the estimated error of every pixel")
    add("--report", metavar="R.html", type=Path, help=REPORT_HELP)


def _denoise(options: argparse.Namespace) -> Outcome:
    warm_start = load_warm_start(options.warm_start)
    names = (*FIT_OPTIONS, "iterations", "seed", "threads", *PAPER_SETTINGS)
    settings = fit_settings(vars(options), names, warm_start)
    check_ready(settings, warm_start)

    def fit(buffers: RenderBuffers) -> FitResult:
        warn_of_little_memory(options.input, buffers, settings.preset)
        return denoise_with_progress(buffers, settings, warm_start)

    return _denoised(options, settings.preset, fit)


def _infer(options: argparse.Namespace) -> Outcome:
    if options.save_model is not None and options.refit == 0:
        raise InputError(
            f"--save-model: without --refit the network is that of {options.model} still; add --refit N or "
            f"omit --save-model"
        )
    with deferred_interrupts():
        from tungsten_dip.onnx.inference import checked_settings

    model = tungsten_dip.load_model(options.model)
    checked_settings(model, options.threads, options.refit)  # before anything is read

    def infer(buffers: RenderBuffers) -> FitResult:
        with progress_on_stderr("denoising") as progress:
            return tungsten_dip.infer(
                model, buffers, progress, threads=options.threads, refit_steps=options.refit
            )

    return _denoised(options, model.settings.preset, infer)


def _denoised(
    options: argparse.Namespace, preset: Preset, denoise: Callable[[RenderBuffers], FitResult]
) -> Outcome:
    """Read the buffers, denoise them, write all that the options ask for."""
    if preset == "paper" and options.error_map is not None:
        raise InputError("--error-map: the published method estimates no error; use another preset")
    suffixes = {"output": ".exr", "error_map": ".exr", "report": ".html", "save_model": ".onnx"}
    for name, suffix in suffixes.items():
        if getattr(options, name) is not None:
            check_writable(getattr(options, name), suffix)
    if options.error_map is not None and options.error_map.resolve() == options.output.resolve():
        raise InputError(f"{options.error_map}: named for the picture and for the error map; name two files")

    mapping = layer_mapping(options)
    inputs = [file.resolve() for file in input_files(options.input, mapping)]
    resolved = options.input.resolve()
    # One file that holds everything may be replaced: the result passes all of its layers through.
    is_whole = inputs == [resolved]
    outputs = [options.error_map] if is_whole else [options.output, options.error_map]
    check_outputs_are_not_inputs(outputs, inputs, [resolved], mapping)

    with remarks_from_log() as remarks:
        buffers = read_buffers(options.input, mapping)
        result = denoise(buffers)
    write_denoised(options.output, result, buffers, float16=options.float16)
    if options.report is not None:
        named = options.input.name not in ("", "..")  # a link has a name of its own
        name = (options.input if named else options.input.resolve()).name
        write_text(options.report, report_page(name, buffers, result, remarks))
    if options.error_map is not None:
        assert result.error is not None
        write_error_map(options.error_map, result.error, buffers, result.settings.threads)
    if options.save_model is not None:
        write_model(options.save_model, result)

    facts = {
        "output": str(options.output),
        "width": buffers.width,
        "height": buffers.height,
        "seconds": result.seconds,
        "iterations": result.iterations,
        "estimated_relmse": result.estimated_relmse,
        "settings": asdict(result.settings),
        "history": [asdict(point) for point in result.history],
        "interrupted": result.interrupted,
        "notes": list(result.notes),
    }
    known = result.estimated_relmse is not None
    error = f", estimated relMSE {result.estimated_relmse:.3g}" if known else ""
    steps = "iteration" if result.iterations == 1 else "iterations"
    text = f"{options.output}: {result.iterations} {steps} in {result.seconds:.1f} s{error}"
    return Outcome(facts, text, interrupted=result.interrupted)


def _inspect(options: argparse.Namespace) -> Outcome:
    mapping = layer_mapping(options)
    if options.input.suffix.lower() == ".json" and not mapping:
        scene = load_scene(options.input)
        return Outcome(inspect_facts(scene), inspect_text(scene))
    return _facts_of_buffers(read_buffers(options.input, mapping))


def _facts_of_buffers(buffers: RenderBuffers) -> Outcome:
    spp = None if buffers.spp is None else float(np.mean(buffers.spp))
    quantities = {}
    lines = [
        f"{buffers.width} x {buffers.height} pixels" + ("" if spp is None else f", {spp:g} samples per pixel")
    ]
    for name, buffer in buffers.quantities():
        planes = dict(buffer.planes())
        nonfinite = sum(int(np.count_nonzero(~np.isfinite(array))) for array in planes.values())
        quantities[name] = {"planes": list(planes), "nonfinite": nonfinite}
        bad = f", {nonfinite} values not finite" if nonfinite else ""
        lines.append(f"{name:<11}{', '.join(planes)}{bad}")
    facts = {"width": buffers.width, "height": buffers.height, "spp": spp, "quantities": quantities}
    return Outcome(facts, "\n".join(lines))


def _compare(options: argparse.Namespace) -> Outcome:
    image, reference = read_image(options.image), read_image(options.reference)
    if image.shape != reference.shape:
        (height, width), (rows, columns) = image.shape[:2], reference.shape[:2]
        raise InputError(
            f"{options.image}: expected {columns} x {rows} pixels as {options.reference} has, got {width} x "
            f"{height}; bring both to one size"
        )
    begin, expected = first_pixel(options.image), first_pixel(options.reference)
    if begin != expected and None not in (begin, expected):
        raise InputError(
            f"{options.image}: expected pixels from {expected} on as {options.reference} has, got them from "
            f"{begin}; bring both to one data window"
        )
    facts = asdict(tungsten_dip.compare(image, reference))
    lines = (f"{name:<11}{'-' if value is None else f'{value:.5g}'}" for name, value in facts.items())
    return Outcome(facts, "\n".join(lines))
