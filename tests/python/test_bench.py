import csv
import json
import logging
import os
import re
import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from browser import assert_page_works
from synthetic import synthetic_render
from tungsten_dip.bench import methods, pareto, plot
from tungsten_dip.bench.methods import Plan, settings_text
from tungsten_dip.bench.nfor import nfor_image
from tungsten_dip.bench.pareto import run_pareto
from tungsten_dip.bench.results import COLUMNS, Key, Measurement, Results
from tungsten_dip.bench.sets import cropped_as_published, read_sets
from tungsten_dip.bench.table import Row, SetRows, markdown_table
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.read import read_image
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.cli import tungsten_dip as command
from tungsten_dip.errors import InputError
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.progress import silent
from tungsten_dip.report.metrics import Comparison, compare

DENOISER = "TUNGSTEN_DENOISER"
"""Names Tungsten's command denoiser, where there is one."""


@pytest.fixture
def folder(tmp_path):
    """A set as a folder of Tungsten's buffers, its reference in the folder above."""
    render = synthetic_render(32, 48)
    write_tungsten_folder(tmp_path / "room" / "n16", render.buffers)
    write_image(tmp_path / "room" / "reference.exr", render.reference)
    return tmp_path / "room" / "n16"


@pytest.fixture
def bench_set(folder):
    return read_sets([str(folder)])[0]


@pytest.fixture
def fits(monkeypatch):
    """Replaces the fit by one that takes the noisy image halfway to grey; lists what it was asked for."""
    calls = []

    def denoise(buffers, settings=None, progress=silent):
        calls.append(settings)
        progress(0.5, "halfway")
        color = (buffers.color.mean + buffers.color.mean.mean()) / 2
        return FitResult(color, settings, 0.0, len(calls))

    monkeypatch.setattr("tungsten_dip.bench.methods.denoise", denoise)
    monkeypatch.setattr("tungsten_dip.bench.pareto._warm_up", lambda bench_set, plan, series: None)
    monkeypatch.setattr("tungsten_dip.bench.pareto.write_pareto_plot", lambda folder, found: None)
    monkeypatch.setattr("tungsten_dip.bench.pareto.pareto_page", lambda found, facts, repeats: "the page")
    return calls


def refused(capfd, arguments, *words):
    """Assert that the command ended with one line that holds the words."""
    assert command.main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert "Traceback" not in err
    assert all(word in err.splitlines()[-1] for word in words), err


# --- sets -------------------------------------------------------------------------------------------


def test_a_reference_is_found_in_the_folder_above_it_or_where_it_is_named(folder, bench_set):
    reference = folder.parent / "reference.exr"
    assert bench_set.name == "room/n16"
    np.testing.assert_array_equal(bench_set.reference, read_image(reference))
    named = reference.rename(folder.parent / "truth.exr")
    with pytest.raises(InputError, match="no reference"):
        read_sets([str(folder)])
    (same,) = read_sets([f"{folder}={named}"])
    assert same.digest == bench_set.digest
    (folder.parent / "p=1").mkdir()
    in_folder = named.rename(folder.parent / "p=1" / "truth.exr")
    assert read_sets([f"{folder}={in_folder}"])[0].digest == bench_set.digest
    write_image(folder / "reference.exr", bench_set.reference * 2)
    assert read_sets([str(folder)])[0].digest != bench_set.digest


def test_a_single_file_is_a_set_too(folder, bench_set):
    (single,) = read_sets([str(folder / "color.exr") + f"={folder.parent / 'reference.exr'}"])
    assert single.name == "n16/color"
    assert single.buffers.albedo is None


def test_the_map_chooses_the_layers_of_the_sets(folder, fits, tmp_path, capfd):
    options = ["-o", str(tmp_path / "out"), "--methods", "presets", "--presets", "draft", "--map"]
    refused(capfd, ["bench", "pareto", str(folder), *options, "albedo=gone"], "--map albedo=gone: not in")
    refused(capfd, ["bench", "paper", str(folder), "--map", "albedo=gone"], "--map albedo=gone: not in")
    (without,) = read_sets([str(folder)], {"albedo": "none"})
    assert without.buffers.albedo is None
    assert without.digest != read_sets([str(folder)])[0].digest


def test_sets_that_cannot_be_told_apart_are_refused(folder):
    with pytest.raises(InputError, match="two sets"):
        read_sets([str(folder), str(folder)])


def test_references_of_another_size_or_broken_are_refused(folder, bench_set):
    path = folder.parent / "reference.exr"
    write_image(path, bench_set.reference[1:])
    with pytest.raises(InputError, match="expected the size"):
        read_sets([str(folder)])
    write_image(path, np.full_like(bench_set.reference, np.nan))
    with pytest.raises(InputError, match="finite reference"):
        read_sets([str(folder)])
    write_image(path, bench_set.reference)
    write_image(folder / "nfor.exr", bench_set.reference[1:])
    with pytest.raises(InputError, match=r"nfor\.exr: expected the size"):
        read_sets([str(folder)])


@pytest.mark.parametrize("what", ["pareto", "paper"])
def test_a_missing_reference_is_one_line(folder, capfd, what):
    (folder.parent / "reference.exr").unlink()
    refused(capfd, ["bench", what, str(folder)], "no reference to measure against", "=REFERENCE.exr")


def test_a_crop_keeps_the_middle_in_multiples_of_32(tmp_path):
    render = synthetic_render(67, 101)
    write_tungsten_folder(tmp_path / "odd", render.buffers)
    write_image(tmp_path / "odd" / "reference.exr", render.reference)
    write_image(tmp_path / "odd" / "nfor.exr", render.reference)
    (whole,) = read_sets([str(tmp_path / "odd")])
    crop = cropped_as_published(whole)
    np.testing.assert_array_equal(crop.reference, whole.reference[1:65, 2:98])
    np.testing.assert_array_equal(crop.nfor, crop.reference)
    planes = {(name, plane): v for name, b in whole.buffers.quantities() for plane, v in b.planes()}
    cut = {(name, plane): v for name, b in crop.buffers.quantities() for plane, v in b.planes()}
    assert cut.keys() == planes.keys()
    for key, values in cut.items():
        np.testing.assert_array_equal(values, planes[key][1:65, 2:98])
    assert crop.name != whole.name
    assert crop.digest != whole.digest
    assert cropped_as_published(crop).digest == crop.digest


def test_alpha_and_spp_are_cropped_and_make_another_set(tmp_path):
    render = synthetic_render(67, 101)
    alpha = np.linspace(0, 1, 67 * 101, dtype=np.float32).reshape(67, 101, 1)
    result = FitResult(render.buffers.color.mean, FitSettings(), 0.0, 1)
    write_image(tmp_path / "reference.exr", render.reference)
    digests = set()
    for more in ({}, {"alpha": alpha}, {"spp": 4.0}, {"spp": 8.0}, {"spp": alpha + 1}):
        write_denoised(tmp_path / "set.exr", result, replace(render.buffers, **more))
        (whole,) = read_sets([f"{tmp_path / 'set.exr'}={tmp_path / 'reference.exr'}"])
        digests.add(whole.digest)
        crop = cropped_as_published(whole).buffers
        for name, values in more.items():
            expected = values[1:65, 2:98] if isinstance(values, np.ndarray) else values
            np.testing.assert_array_equal(getattr(crop, name), expected)
    assert len(digests) == 5


def test_what_is_too_small_to_crop_is_refused(bench_set):
    small = replace(bench_set, reference=bench_set.reference[:31])
    with pytest.raises(InputError, match="from 32 pixels on, got room/n16 with 48 x 31"):
        cropped_as_published(small)


# --- results ----------------------------------------------------------------------------------------


def measurement(repeat=0, method="draft", seconds=1.5, relmse=0.01):
    key = Key("room/n16", method, "preset=draft channels=1,2", "0.1", "abc", 'a "CPU", 2 threads', repeat)
    distances = Comparison(float("inf"), relmse, None, 0.1, None, 0, None)
    return Measurement(key=key, seconds=seconds, iterations=7, **asdict(distances))


def test_runs_at_once_keep_the_measurements_of_each_other(tmp_path):
    path = tmp_path / "results.csv"
    runs = [Results(path) for _ in range(4)]

    def measure(run):
        for repeat in range(5):
            runs[run].add([measurement(repeat, method=f"method {run}")])

    with ThreadPoolExecutor() as pool:
        list(pool.map(measure, range(len(runs))))
    with path.open() as stream:
        assert len(list(csv.DictReader(stream))) == 20


def test_measurements_survive_their_file(tmp_path):
    path = tmp_path / "results.csv"
    rows = [measurement(0), measurement(1, seconds=None), measurement(method="a, b")]
    for row in rows:
        Results(path).add([row])
    again = Results(path)
    assert all(row.key in again for row in rows)
    assert [again.medians(row.key, 1) for row in (rows[0], rows[2])] == [rows[0], rows[2]]
    with path.open() as stream:
        assert tuple(csv.DictReader(stream).fieldnames) == COLUMNS


def test_medians_are_of_the_repeats_that_are_there(tmp_path):
    results = Results(tmp_path / "results.csv")
    results.add(measurement(index, seconds=seconds) for index, seconds in enumerate((3.0, 1.0, 8.0)))
    assert results.medians(measurement().key, 3).seconds == 3
    assert results.medians(measurement().key, 5).seconds == 3
    assert results.medians(measurement().key, 2).seconds == 2


HUGE = ",".join(COLUMNS) + "\n" + ",".join(f"{10**400}" if name == "iterations" else "1" for name in COLUMNS)


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", ",".join(COLUMNS) + "\nx\n", "\0", HUGE])
def test_a_file_of_something_else_is_refused(tmp_path, text):
    path = tmp_path / "results.csv"
    path.write_text(text)
    with pytest.raises(InputError, match="choose another folder"):
        Results(path)
    assert path.read_text() == text


# --- pareto -----------------------------------------------------------------------------------------

QUICK = Plan(("presets", "budgets"), ("draft", "final"), budgets_s=(1.0,), repeats=2, threads=1)


def test_a_run_measures_in_turns_and_another_run_measures_nothing(bench_set, fits, tmp_path):
    (found,) = run_pareto([bench_set], QUICK, tmp_path / "bench")
    settings = [settings_text(each) for each in fits]
    turn = ["preset=draft threads=1", "preset=final threads=1", "preset=final time_budget_s=1.0 threads=1"]
    assert settings == turn * 2
    assert [row.label for row in found.rows] == ["noisy", "draft", "final", "final in 1 s"]
    assert found.rows[0].median.seconds is None
    assert all(row.median.seconds > 0 for row in found.rows[1:])

    (again,) = run_pareto([bench_set], QUICK, tmp_path / "bench")
    assert len(fits) == 6
    assert [row.median for row in again.rows] == [row.median for row in found.rows]
    run_pareto([bench_set], replace(QUICK, repeats=3), tmp_path / "bench")
    assert len(fits) == 9


def test_another_version_image_or_number_of_threads_is_measured_anew(bench_set, fits, tmp_path, monkeypatch):
    plan = replace(QUICK, kinds=("presets",), presets=("draft",), repeats=1)
    run_pareto([bench_set], plan, tmp_path)
    run_pareto([bench_set], plan, tmp_path)
    assert len(fits) == 1
    run_pareto([bench_set], replace(plan, threads=2), tmp_path)
    run_pareto([replace(bench_set, digest="other")], plan, tmp_path)
    monkeypatch.setattr("tungsten_dip.bench.runner.__version__", "99")
    run_pareto([bench_set], plan, tmp_path)
    assert len(fits) == 4


def test_warming_up_silences_nobody_else(bench_set, caplog, monkeypatch):
    def denoise(buffers, settings):
        logging.getLogger("tungsten_dip.fit").critical("of a discarded result")
        logging.getLogger("host").info("of the host")

    monkeypatch.setattr(pareto, "denoise", denoise)
    with caplog.at_level(logging.INFO):
        pareto._warm_up(bench_set, QUICK, {methods.OURS})
        logging.getLogger("tungsten_dip.fit").info("afterwards")
    assert caplog.messages == ["of the host", "afterwards"]


def test_an_interrupt_loses_the_measurement_in_hand_alone(bench_set, fits, tmp_path, monkeypatch):
    def interrupted(buffers, settings=None, progress=silent):
        # As a real fit does, which ends early on Ctrl-C with what it has.
        stops = len(fits) == 2
        fits.append(settings)
        return FitResult(buffers.color.mean, settings, 0.0, 1, interrupted=stops)

    monkeypatch.setattr("tungsten_dip.bench.methods.denoise", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_pareto([bench_set], QUICK, tmp_path)
    with (tmp_path / "results.csv").open() as stream:
        assert [row["method"] for row in csv.DictReader(stream)] == ["noisy", "draft", "final"]
    assert not (tmp_path / "page.html").exists()
    run_pareto([bench_set], QUICK, tmp_path)
    assert len(fits) == 3 + 4


def test_all_that_can_be_measured_here_is_shown_in_table_plot_and_page(folder, bench_set, tmp_path):
    pytest.importorskip("pyoidn", reason="pyoidn is not installed")
    write_image(folder / "nfor.exr", bench_set.reference * np.float32(1.1))
    sets = read_sets([str(folder)])
    plan = Plan(
        presets=("draft", "final"), budgets_s=(0.5,), paper_iterations=3, repeats=1, threads=1, nfor_s=4
    )
    (found,) = run_pareto(sets, plan, tmp_path / "bench")
    labels = [row.label for row in found.rows]
    oidn = ["OIDN fast", "OIDN balanced", "OIDN high"]
    ours = ["draft", "final", "final, with OIDN as a pilot", "final in 0.5 s"]
    assert labels == ["noisy", *ours, "paper, 3 iterations", *oidn, "NFOR"]
    assert found.rows[-1].median.seconds == 4
    by_label = {row.label: row.median for row in found.rows}
    assert by_label["OIDN high"].relmse < 0.5 * by_label["noisy"].relmse
    assert by_label["NFOR"].mean_ratio == pytest.approx(1.1, rel=1e-5)

    table = (tmp_path / "bench" / "table.md").read_text()
    assert "| method | seconds | PSNR, dB | relMSE | FLIP | HDR-FLIP | mean ratio |" in table
    assert all(f"{label}" in table for label in labels)
    assert "processor" in table
    assert "our presets" in (tmp_path / "bench" / "plot.svg").read_text()
    assert (tmp_path / "bench" / "plot.png").read_bytes().startswith(b"\x89PNG")
    page = tmp_path / "bench" / "page.html"
    html = page.read_text()
    assert html.count("<svg") == len(plot.METRICS)
    assert "var(--series-1)" in html
    assert not re.search(r"https?://", html)
    assert all(f'alt="{label}"' in html for label in ("reference", "noisy", "draft", "OIDN high", "NFOR"))
    assert all(f'alt="error of {label}"' in html for label in ("noisy", "draft", "OIDN high", "NFOR"))
    assert_page_works(page)


@pytest.mark.parametrize("presets", [("draft",), ("draft", "final")])
def test_final_is_guided_by_oidn_only_where_final_is_asked_for(bench_set, fits, tmp_path, presets):
    pytest.importorskip("pyoidn", reason="pyoidn is not installed")
    plan = replace(QUICK, kinds=("presets", "oidn"), presets=presets, repeats=1)
    run_pareto([bench_set], plan, tmp_path)
    guided = [("final", "oidn")] if "final" in presets else []
    assert [(each.preset, each.pilot) for each in fits] == [*((p, "none") for p in presets), *guided]


def test_peers_that_are_missing_are_left_out_and_that_is_said(bench_set, fits, tmp_path, monkeypatch, caplog):
    missing = ("torch", "pyoidn")
    monkeypatch.setattr(
        "tungsten_dip.extras.find_spec", lambda name: None if name in missing else find_spec(name)
    )
    with caplog.at_level(logging.INFO):
        plan = replace(QUICK, kinds=("presets", "paper", "oidn", "nfor", "samples"), repeats=1)
        (found,) = run_pareto([bench_set], plan, tmp_path)
    assert [row.label for row in found.rows] == ["noisy", *QUICK.presets]
    assert "measured without more samples" in caplog.text
    assert "pip install 'tungsten-dip[paper]'" in caplog.text
    assert "pip install 'tungsten-dip[oidn]'" in caplog.text
    assert "NFOR is left out" in caplog.text


def test_the_front_is_what_no_faster_method_beats(bench_set):
    def row(label, seconds, relmse):
        return Row(label, label, methods.OURS, measurement(0, label, seconds, relmse), None)

    points = [("a", 5.0, 0.1), ("b", 1.0, 0.2), ("c", 2.0, 0.3), ("d", None, 0.01), ("e", 9.0, 0.1)]
    rows = SetRows(bench_set, [row(*point) for point in points])
    assert [rows.rows[index].label for index in rows.front()] == ["a", "b"]
    lines = markdown_table(rows).splitlines()
    assert lines[2].startswith("| **a** | 5.0 | inf | 0.100 |")
    assert lines[5].startswith("| d |  | inf |")


def test_more_samples_cost_what_they_take_beyond_the_noisy_render(bench_set, fits, tmp_path, monkeypatch):
    scene = tmp_path / "scene.json"
    scene.write_text(
        json.dumps({"camera": {"type": "pinhole", "resolution": [48, 32]}, "renderer": {"spp": 16}})
    )
    asked = []

    def render(scene, spp, seed, threads, progress):
        asked.append((spp, seed))
        return synthetic_render(32, 48, spp=spp, seed=seed).buffers

    clock = iter(range(0, 800, 8))
    monkeypatch.setattr("tungsten_dip.bench.methods.render", render)
    monkeypatch.setattr("tungsten_dip.bench.methods.time.perf_counter", lambda: float(next(clock)))
    plan = replace(QUICK, kinds=("samples",), scenes=(scene,), sample_factors=(2, 4), repeats=2)
    (found,) = run_pareto([bench_set], plan, tmp_path / "bench")
    assert asked == [(32, 1000), (64, 1000), (32, 1001), (64, 1001)]
    noisy, twice, four_times = (row.median for row in found.rows)
    assert (twice.seconds, four_times.seconds) == (4, 6)
    assert noisy.relmse > twice.relmse > four_times.relmse

    scene.write_text(json.dumps({"camera": {"type": "pinhole", "resolution": [48, 33]}}))
    with pytest.raises(InputError, match="expected the resolution of room/n16, 48 x 32, got 48 x 33"):
        run_pareto([bench_set], plan, tmp_path / "bench")
    with pytest.raises(InputError, match="a scene for each of 1 sets, got 2"):
        run_pareto([bench_set], replace(plan, scenes=(scene, scene)), tmp_path / "bench")


def test_plans_that_cannot_be_followed_are_refused(bench_set, tmp_path, capfd, folder):
    with pytest.raises(InputError, match="expected some of presets, budgets"):
        Plan(("ours",))
    for name in ("repeats", "paper_iterations", "threads"):
        for value in (0, 0.5):
            with pytest.raises(InputError, match=f"{name}: expected a whole number from 1 to"):
                Plan(**{name: value})
    with pytest.raises(InputError, match="no such file"):
        run_pareto([bench_set], Plan(denoiser=tmp_path / "none"), tmp_path)
    command_line = ["bench", "pareto", str(folder), "-o", str(tmp_path / "out")]
    refused(capfd, [*command_line, "--methods", "magic"], "expected some of presets", "magic")
    refused(capfd, [*command_line, "--presets", "magic"], "expected some of draft", "magic")
    refused(capfd, [*command_line, "--budgets", "1s,soon"], "duration", "soon")
    refused(capfd, [*command_line, "--methods", "samples"], "nothing to compare", "--scene")
    assert not (tmp_path / "out").exists()
    file = tmp_path / "file"
    file.touch()
    refused(capfd, ["bench", "pareto", str(folder), "-o", str(file)], str(file), "choose another")


def test_the_command_prints_the_table_or_json(folder, fits, tmp_path, capfd):
    arguments = ["bench", "pareto", str(folder), "-o", str(tmp_path / "out"), "--methods", "presets"]
    arguments += ["--presets", "draft", "--repeats", "1"]
    assert command.main(arguments) == 0
    assert "| draft |" in capfd.readouterr().out.replace("**", "")
    assert command.main([*arguments, "--json"]) == 0
    rows = json.loads(capfd.readouterr().out)["room/n16"]
    assert [row["label"] for row in rows] == ["noisy", "draft"]
    assert rows[1]["flip"] > 0
    assert len(fits) == 1


def test_without_matplotlib_nothing_is_measured(bench_set, fits, tmp_path, monkeypatch):
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'tungsten-dip\[bench\]'"):
        run_pareto([bench_set], QUICK, tmp_path)
    assert fits == []


def test_settings_are_told_by_what_is_not_the_default():
    assert settings_text(FitSettings()) == ""
    assert settings_text(FitSettings("paper", channels=(1, 2), seed=3)) == "preset=paper channels=1,2 seed=3"


# --- NFOR -------------------------------------------------------------------------------------------


def command_of(tmp_path, body):
    path, program = tmp_path / "denoiser", tmp_path / "denoiser.py"
    program.write_text(f"import json, shutil, sys\nfrom pathlib import Path\n{body}\n")
    path.write_text(f'#!/bin/sh\nexec {shlex.join([sys.executable, str(program)])} "$@"\n')
    path.chmod(0o755)
    return path


def test_nfor_gets_a_scene_that_names_all_that_is_whole(tmp_path, render):
    told = tmp_path / "told.json"
    body = f"""scene = Path(sys.argv[1])
for output in json.loads(scene.read_text())["renderer"]["output_buffers"]:
    stem = output["hdr_output_file"][:-4]
    assert all((scene.parent / (stem + end + ".exr")).exists() for end in ("", "A", "B", "Variance"))
shutil.copy(scene, {str(told)!r})
shutil.copy(scene.with_name("colorA.exr"), sys.argv[2])"""
    buffers = render.buffers.with_quantities(normal=replace(render.buffers.normal, variance=None))
    image = nfor_image(buffers, command_of(tmp_path, body))
    np.testing.assert_array_equal(image, buffers.color.half_a)
    scene = json.loads(told.read_text())
    assert scene["camera"]["resolution"] == [56, 40]
    types = [output["type"] for output in scene["renderer"]["output_buffers"]]
    assert types == ["color", "albedo", "depth"]


def test_nfor_that_fails_is_one_line(tmp_path, render):
    failing = command_of(tmp_path, "print('of no use', file=sys.stderr); sys.exit(3)")
    with pytest.raises(InputError, match=r"failed with status 3 \(of no use\)"):
        nfor_image(render.buffers, failing)
    with pytest.raises(InputError, match="failed with status 0"):
        nfor_image(render.buffers, command_of(tmp_path, "pass"))
    failing.write_bytes(b"\x7fELF of another machine")
    with pytest.raises(InputError, match="cannot be run"):
        nfor_image(render.buffers, failing)
    alone = RenderBuffers(replace(render.buffers.color, variance=None))
    with pytest.raises(InputError, match="halves A and B and its variance"):
        nfor_image(alone, failing)


@pytest.mark.skipif(DENOISER not in os.environ, reason=f"{DENOISER} names no denoiser of Tungsten")
def test_nfor_of_tungsten_denoises(render):
    image = nfor_image(render.buffers, Path(os.environ[DENOISER]))
    noisy = render.buffers.color.mean
    assert np.mean((image - render.reference) ** 2) < 0.5 * np.mean((noisy - render.reference) ** 2)


def test_sets_whose_names_look_alike_keep_their_own_images(tmp_path, fits):
    folders = []
    for name, seed in (("a_b", 1), ("a-b", 2)):
        render = synthetic_render(seed=seed)
        write_tungsten_folder(tmp_path / name, render.buffers)
        write_image(tmp_path / name / "reference.exr", render.reference)
        folders.append(str(tmp_path / name))
    plan = replace(QUICK, kinds=("presets",), repeats=1)
    one, other = run_pareto(read_sets(folders), plan, tmp_path / "out")
    for found in (one, other):
        row = next(row for row in found.rows if row.label == "draft")
        assert compare(row.image, found.bench_set.reference).psnr == pytest.approx(row.median.psnr, abs=1e-3)
