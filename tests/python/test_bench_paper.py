import csv
import logging

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from synthetic import synthetic_render  # noqa: E402
from tungsten_dip.bench import methods, paper_table  # noqa: E402
from tungsten_dip.bench.iteration import _convolutions, time_iterations, times_text  # noqa: E402
from tungsten_dip.bench.paper_curve import checkpoints_up_to, paper_curve  # noqa: E402
from tungsten_dip.bench.paper_table import SCENES, published_rows, run_paper_table  # noqa: E402
from tungsten_dip.bench.plain_skip import PlainFit, PlainSkip  # noqa: E402
from tungsten_dip.bench.sets import BenchSet  # noqa: E402
from tungsten_dip.cli import tungsten_dip as command  # noqa: E402
from tungsten_dip.errors import InputError  # noqa: E402
from tungsten_dip.fit import denoise  # noqa: E402
from tungsten_dip.fit.settings import FitSettings  # noqa: E402
from tungsten_dip.progress import silent  # noqa: E402


@pytest.fixture
def bench_set():
    render = synthetic_render(32, 48)
    return BenchSet("room/n16", render.buffers, render.reference, None, "digest")


# --- the curve --------------------------------------------------------------------------------------


def test_a_curve_passes_through_what_a_fit_ends_at(bench_set):
    settings = FitSettings("paper", threads=1)
    points = paper_curve(bench_set.buffers, settings, (1, 3), silent)
    assert [point.iteration for point in points] == [1, 3]
    assert 0 < points[0].seconds < points[1].seconds
    for point in points:
        alone = denoise(bench_set.buffers, FitSettings("paper", iterations=point.iteration, threads=1))
        np.testing.assert_array_equal(point.color, alone.color)


@pytest.mark.parametrize(
    ("iterations", "first", "counts"),
    [
        (1, 100, (1,)),
        (100, 100, (100,)),
        (3000, 100, (100, 300, 1000, 3000)),
        (10, 1, (1, 3, 10)),
        (3500, 1000, (1000, 3000, 3500)),
    ],
)
def test_checkpoints_grow_evenly_and_end_at_the_last(iterations, first, counts):
    assert checkpoints_up_to(iterations, first) == counts


# --- the table --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
def test_the_published_rows_are_thirteen_that_can_be_fitted(scene):
    rows = published_rows(scene)
    assert [row.number for row in rows] == list(range(1, 14))
    settings = [row.settings(3, None) for row in rows]
    assert len(set(settings)) == 13
    assert {each.network for each in settings} == {"skip", "resnet"}
    # What they call loss is the mean squared error to the noisy image, so one gives the other (but for IOC,
    # whose loss is over all channels).
    for row in rows:
        if row.scheme == "iic":
            assert row.psnr_noisy == pytest.approx(-10 * np.log10(row.loss), abs=0.05)


def test_a_published_figure_is_as_printed():
    row = published_rows("cornell-box")[6]
    assert (row.inputs, row.loss, row.psnr_noisy, row.psnr_truth) == (
        "all+random",
        0.000233,
        36.320069,
        26.101154,
    )


@pytest.fixture
def curves(monkeypatch):
    """Lists the settings of the fits that were begun."""
    begun = []

    def counted(buffers, settings, checkpoints, progress):
        begun.append(settings)
        return paper_curve(buffers, settings, checkpoints, progress)

    monkeypatch.setattr(methods, "paper_curve", counted)
    return begun


def paper_table_of(bench_set, folder, *, scene=SCENES[0], iterations=1, rows=None):
    return run_paper_table(bench_set, folder, scene=scene, iterations=iterations, rows=rows, threads=1)


def test_the_whole_table_is_written_and_not_measured_twice(bench_set, curves, tmp_path):
    text = paper_table_of(bench_set, tmp_path, iterations=3)
    assert len(curves) == 14
    assert text == (tmp_path / "paper.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert lines[0].count("|") == len(paper_table.COLUMNS) + 1 == lines[5].count("|")
    assert len(lines) == 2 + 13
    with (tmp_path / "paper.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["row"] for row in rows] == [str(number) for number in range(1, 14)]
    for row in rows:
        assert 0 < float(row["loss"]) < 1
        assert 0 < float(row["psnr_to_truth"]) < 60
        assert float(row["seconds"]) > 0
    assert float(rows[0]["published_psnr_to_truth"]) == 26.084307
    assert (tmp_path / "iterations.png").read_bytes().startswith(b"\x89PNG")
    assert "to reference" in (tmp_path / "iterations.svg").read_text()

    assert paper_table_of(bench_set, tmp_path, iterations=3) == text
    assert len(curves) == 14
    other = paper_table_of(bench_set, tmp_path, iterations=3, scene="lamp")
    assert "26.33" in other
    assert len(curves) == 14


def test_some_rows_can_be_chosen_and_go_on_after_an_interrupt(bench_set, curves, tmp_path, monkeypatch):
    def interrupted(buffers, settings, checkpoints, progress):
        if len(curves) == 1:
            raise KeyboardInterrupt
        curves.append(settings)
        return paper_curve(buffers, settings, checkpoints, progress)

    choice = {"iterations": 2, "rows": (2, 9)}
    with monkeypatch.context() as patch:
        patch.setattr(methods, "paper_curve", interrupted)
        with pytest.raises(KeyboardInterrupt):
            paper_table_of(bench_set, tmp_path, **choice)
    paper_table_of(bench_set, tmp_path, **choice)
    assert [settings.network for settings in curves] == ["skip", "resnet"]
    assert not (tmp_path / "iterations.png").exists()


def test_a_row_without_its_feature_is_left_out_and_that_is_said(bench_set, curves, tmp_path, caplog):
    buffers = bench_set.buffers.with_quantities(albedo=None)
    without = BenchSet("room", buffers, bench_set.reference, None, "other")
    with caplog.at_level(logging.WARNING):
        text = paper_table_of(without, tmp_path, iterations=1, rows=(3, 4))
    assert [settings.inputs for settings in curves] == ["depths"]
    assert "| 4 |" not in text
    assert "row 4 is left out: inputs albedos" in caplog.text


def test_rows_scenes_and_iterations_that_are_none_are_refused(bench_set, tmp_path):
    with pytest.raises(InputError, match="from 1 to 13, got 14"):
        paper_table_of(bench_set, tmp_path, rows=(1, 14))
    with pytest.raises(InputError, match="cornell-box, car2, lamp, got house"):
        paper_table_of(bench_set, tmp_path, scene="house")
    with pytest.raises(InputError, match="iterations: expected a whole number from 1"):
        paper_table_of(bench_set, tmp_path, iterations=0)
    assert list(tmp_path.iterdir()) == []


# --- the iteration ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("in_channels", "channels", "parameters"),
    [
        (3, (8, 16, 32, 64, 128), 572_827),
        (42, (8, 16, 32, 64, 128), 575_635),
        (3, (16, 32, 64, 128, 256), 2_268_683),
        (42, (16, 32, 64, 128, 256), 2_274_299),
    ],
)
def test_the_plain_network_has_as_many_parameters_as_published(in_channels, channels, parameters):
    assert sum(weight.numel() for weight in PlainSkip(in_channels, channels).parameters()) == parameters


def test_the_plain_fit_learns():
    torch.manual_seed(0)
    fixed, wanted = torch.rand(1, 5, 64, 64), torch.full((1, 3, 64, 64), 0.9)
    fit = PlainFit(PlainSkip(5), fixed, wanted)

    def error():
        with torch.no_grad():
            return torch.nn.functional.mse_loss(fit.network(fixed), wanted).item()

    before = error()
    for _ in range(20):
        fit.step()
    assert error() < 0.95 * before


def test_the_work_of_convolutions_is_counted_as_defined():
    network = torch.nn.Sequential(
        torch.nn.Conv2d(5, 7, 3, stride=2, padding=1),
        torch.nn.Conv2d(7, 2, 1),
        torch.nn.Conv2d(2, 2, 3, padding=1),
    )
    layers = _convolutions(network, torch.rand(1, 5, 16, 24))
    pixels = 8 * 12
    # Twice a multiplication and an addition for the image itself, which needs no gradient, else three times.
    assert [layer.flops for layer in layers] == [
        2 * 2 * 5 * 7 * 9 * pixels,
        3 * 2 * 7 * 2 * pixels,
        3 * 2 * 2 * 2 * 9 * pixels,
    ]
    for layer in layers:
        for run in layer.runs:
            run()


def test_iterations_are_timed_side_by_side():
    times = time_iterations(96, 64, iterations=1, repeats=2, threads=1)
    assert min(times.ours_s, times.plain_s, times.convolutions_s, times.peak_flops_per_s) > 0
    assert times.speedup == times.plain_s / times.ours_s
    text = times_text(times, 96, 64, 1)
    assert "it is not the published code" in text
    assert f"{times.speedup:.2f} times" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size", "500x288"], "multiples of 32"),
        (["--size", "512x32"], "from 64 on"),
        (["--size", "big"], "a size such as 512x288"),
        (["--repeats", "0"], "repeats: expected a whole number from 1"),
    ],
)
def test_what_cannot_be_timed_is_one_line(arguments, words, capfd):
    assert command.main(["bench", "iteration", *arguments]) == 2
    assert words in capfd.readouterr().err.splitlines()[-1]


def test_the_commands_print_tables(bench_set, tmp_path, capfd):
    from tungsten_dip.buffers.image_file import write_image
    from tungsten_dip.buffers.write import write_tungsten_folder

    write_tungsten_folder(tmp_path / "set", bench_set.buffers)
    write_image(tmp_path / "set" / "reference.exr", bench_set.reference)
    arguments = ["--iterations", "1", "--rows", "1,12", "--threads", "1", "-o", str(tmp_path / "out")]
    assert command.main(["bench", "paper", str(tmp_path / "set"), *arguments]) == 0
    out = capfd.readouterr().out
    assert "| 12 | skip | 8-16-32-64-128 | random | IOC |" in out
    assert "set, 48 x 32 pixels" in out
    assert command.main(["bench", "paper", str(tmp_path / "set"), *arguments, "--crop"]) == 0
    assert "set cropped, 32 x 32 pixels" in capfd.readouterr().out
    sizes = ["--size", "64x64", "--iterations", "1", "--repeats", "1", "--threads", "1", "--json"]
    assert command.main(["bench", "iteration", *sizes]) == 0
    assert '"speedup"' in capfd.readouterr().out
