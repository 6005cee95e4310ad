"""Runs over files: what is skipped and what is done again, kills, breakage, the page, several processes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fitted_models import paper_model
from moving_camera import true_frame, write_frames
from tungsten_dip.buffers.image_file import read_parts, write_exr, write_image
from tungsten_dip.buffers.read import read_buffers, read_image
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.cli.tungsten_dip import main
from tungsten_dip.errors import InputError
from tungsten_dip.fit.model import source_sha256
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.onnx import load_model, save_model
from tungsten_dip.sequence import work
from tungsten_dip.sequence.frames import find_frames

COUNT = 4
PROGRAM = [
    sys.executable,
    "-c",
    "import sys; from tungsten_dip.cli.tungsten_dip import main; sys.exit(main())",
]


@pytest.fixture
def frames(tmp_path, monkeypatch):
    write_frames(tmp_path, COUNT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def arguments(*more: str) -> list[str]:
    return [
        *("sequence", "noisy/f####", "-o", "out/f####.exr", "--cameras", "cameras/f####.json"),
        *("--preset", "draft", "--threads", "1", *more),
    ]


def outputs(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "out").glob("f*.exr"))}


def told(capfd) -> dict:
    return json.loads(capfd.readouterr().out)


def test_every_frame_is_written_and_told(frames, capfd):
    assert main(arguments("--json", "--report", "page.html")) == 0
    records = told(capfd)["frames"]
    assert [record["how"] for record in records] == ["fitted"] + ["followed"] * (COUNT - 1)
    assert all(record["estimated_relmse"] > 0 and record["seconds"] > 0 for record in records)
    assert list(outputs(frames)) == [f"f{number:04d}.exr" for number in range(COUNT)]
    # A result reads like the input that it was made from.
    again = read_buffers("out/f0002.exr")
    np.testing.assert_array_equal(again.color.mean, read_buffers("noisy/f0002").color.mean)
    assert np.isfinite(read_image("out/f0002.exr")).all()


def test_one_step_is_told_as_one(frames, capfd):
    assert main(arguments("--frames", "0", "--target-error", "10")) == 0
    assert "frame 0: fitted, 1 step, " in capfd.readouterr().err


def test_the_page_shows_frames_and_curves(frames):
    assert main(arguments("--report", "page.html", "--frames", "0-2,7")) == 2
    page = (frames / "page.html").read_text()
    assert len(re.findall(r'<img alt="frame \d" src="data:image/png', page)) == 3
    assert page.count("<polyline") == 3
    assert "frame 0: " in page
    assert "without a result" in page
    assert "noisy/f0007" in page
    assert not re.search(r'(src|href)="(?!data:)', page)


def test_finished_frames_are_skipped_and_changed_ones_are_not(frames, capsys):
    assert main(arguments()) == 0
    first = outputs(frames)
    capsys.readouterr()
    assert main(arguments()) == 0
    assert outputs(frames) == first
    told = capsys.readouterr()
    assert told.out.startswith("0 frames, denoised in 0.0 s in all; ")
    assert told.err.count("finished already") == len(first)
    os.utime(frames / "noisy/f0001/color.exr", ns=(1, 1))
    (frames / "out/f0002.exr").write_bytes(first["f0002.exr"][:1000])
    (frames / "out/f0003.exr").write_bytes(first["f0003.exr"][:-1])
    assert main(arguments()) == 0
    second = outputs(frames)
    changed = [name for name in first if first[name] != second[name]]
    assert changed == ["f0001.exr", "f0002.exr", "f0003.exr"]
    assert main(arguments("--refit", "0")) == 0
    assert all(second[name] != content for name, content in outputs(frames).items())


RUN = work.Run(FitSettings("draft", iterations=1, threads=1))


def other_version(monkeypatch):
    monkeypatch.setattr(work.metadata, "version", lambda _: "0.0.0")
    return RUN


def touched(path):
    os.utime(path, ns=(1, 1))
    return RUN


@pytest.mark.parametrize(
    "changed",
    [
        lambda _: touched("noisy/f0000/normalB.exr"),
        lambda _: touched("cameras/f0000.json"),
        other_version,
        lambda _: replace(RUN, settings=replace(RUN.settings, seed=1)),
        lambda _: replace(RUN, refit=np.int64(2)),
        lambda _: replace(RUN, mapping={"visibility": "none"}),
        lambda _: replace(RUN, float16=True),
        lambda _: replace(RUN, warm_start_sha256="0123abcd"),
    ],
)
def test_a_frame_is_done_again_where_anything_that_made_it_has_changed(frames, monkeypatch, changed):
    (frame,) = find_frames("noisy/f####", "out/f####.exr", (0,), "cameras/f####.json")
    work.denoise_frames([frame], RUN)
    assert work.finished(frame, RUN) is not None
    assert work.finished(frame, changed(monkeypatch)) is None


def test_a_frame_is_done_again_where_its_input_is_that_of_another_take(frames):
    shutil.copytree("noisy", "other")  # times as well
    known, other = (find_frames(f"{take}/f####", "out/f####.exr", (0,))[0] for take in ("noisy", "other"))
    work.denoise_frames([known], RUN)
    assert work.finished(known, RUN) is not None
    assert work.finished(other, RUN) is None


def test_a_frame_that_was_skipped_is_none_to_flicker_against(frames):
    several = find_frames("noisy/f####", "out/f####.exr", (0, 1, 2), "cameras/f####.json")
    first, _ = work.denoise_frames(several, RUN)
    assert [record.flicker is not None for record in first] == [False, True, True]
    for frame in (several[0], several[2]):
        frame.output.unlink()
    again, _ = work.denoise_frames(several, RUN)
    assert [record.skipped for record in again] == [False, True, False]
    assert again[2].flicker is None


def test_a_frame_whose_record_is_damaged_is_done_again(frames):
    (frame,) = find_frames("noisy/f####", "out/f####.exr", (0,))
    work.denoise_frames([frame], RUN)
    for record in ("[" * 100_000, "[]", "{"):
        (part,) = read_parts(frame.output)
        write_exr(frame.output, [replace(part, attributes={**part.attributes, work.RECORD: record})])
        assert work.finished(frame, RUN) is None


def test_other_threads_are_no_reason_to_do_it_again(frames):
    assert main(arguments()) == 0
    before = outputs(frames)
    assert main(arguments("--threads", "2")) == 0
    assert outputs(frames) == before


def test_a_result_never_takes_the_place_of_an_input(frames, capsys):
    before = {path: path.read_bytes() for path in Path("noisy").rglob("*.exr")}
    for output in ("noisy/f####/color.exr", "./noisy/f####/albedoB.exr"):
        assert main([*arguments()[:2], "-o", output, "--preset", "draft"]) == 2
        assert "is one of the files that are read" in capsys.readouterr().err
    # Another frame's input is an input as well.
    color = frames / "noisy/f0000/color.exr"
    color.symlink_to(color.rename(frames / "color2.exr"))
    assert main([*arguments()[:2], "-o", "color#.exr", "--preset", "draft", "--frames", "0-2"]) == 2
    assert {path: path.read_bytes() for path in before} == before


def test_a_result_never_takes_the_name_of_an_input_of_another_format(frames, capsys):
    for color in list(Path("noisy").glob("f*/color.exr")):
        write_image(color.with_suffix(".pfm"), read_image(color))
        color.unlink()
    for output in ("noisy/f####/color.exr", "noisy/f%04d/depth.EXR"):
        assert main([*arguments()[:2], "-o", output, "--preset", "draft"]) == 2
        assert "is one of the files that are read" in capsys.readouterr().err
    assert not list(Path("noisy").glob("f*/color.exr"))


def test_flicker_is_that_against_the_frame_before(frames, capfd):
    (frames / "noisy/f0001/color.exr").write_bytes(b"no image")
    assert main(arguments("--json")) == 2
    known = {record["number"]: record["flicker"] is not None for record in told(capfd)["frames"]}
    assert known == {0: False, 1: False, 2: False, 3: True}


def test_flicker_is_not_told_across_a_gap_but_of_every_other_frame(frames, capfd):
    shutil.rmtree("noisy/f0001")
    for more, expected in (((), [False, False, True]), (("--frames", "0,2", "--refit", "0"), [False, True])):
        assert main(arguments("--json", *more)) == 0
        assert [record["flicker"] is not None for record in told(capfd)["frames"]] == expected


def test_cameras_need_no_files_of_their_scenes(frames, capfd):
    for path in Path("cameras").glob("*.json"):
        scene = json.loads(path.read_text())
        scene["primitives"] = [{"type": "mesh", "file": "none.wo3", "bsdf": {"type": "null"}}]
        path.write_text(json.dumps(scene))
    assert main(arguments("--json", "--frames", "0-1", "--refit", "0")) == 0
    assert [record["error"] for record in told(capfd)["frames"]] == [None, None]


def test_missing_and_broken_frames_are_told_and_the_others_done(frames, capsys):
    (frames / "noisy/f0001/color.exr").write_bytes(b"no image")
    (frames / "cameras/f0002.json").unlink()
    assert main(arguments("--frames", "0-4")) == 2
    error = capsys.readouterr().err
    assert "3 of 5 frames without a result: 1-2, 4; the others are done" in error
    assert "Traceback" not in error
    assert list(outputs(frames)) == ["f0000.exr", "f0003.exr"]


def test_an_earlier_result_of_a_frame_that_fails_is_told(frames, capsys):
    assert main(arguments("--frames", "0-1")) == 0
    capsys.readouterr()
    (frames / "noisy/f0001/color.exr").write_bytes(b"no image")
    assert main(arguments("--frames", "0-1")) == 2
    [line] = [line for line in capsys.readouterr().err.splitlines() if "frame 1: " in line]
    assert line.endswith("f0001.exr is an earlier result")


@pytest.mark.parametrize("on_cluster", [False, True])
@pytest.mark.parametrize("error", [RuntimeError("a bug\nin two lines"), MemoryError()])
def test_a_frame_that_fails_for_whatever_reason_is_told_and_the_others_done(
    frames, capsys, monkeypatch, error, on_cluster
):
    real = work.read_buffers

    def broken(path, mapping):
        if path.name == "f0000":
            raise error
        return real(path, mapping)

    monkeypatch.setattr(work, "read_buffers", broken)
    if on_cluster:
        distributed = pytest.importorskip("distributed")
        with distributed.LocalCluster(
            n_workers=1, processes=False, dashboard_address=None, protocol="tcp"
        ) as local:
            assert main(arguments("--scheduler", local.scheduler_address)) == 2
    else:
        assert main(arguments()) == 2
    lines = capsys.readouterr().err.splitlines()
    told = "RuntimeError: a bug in two lines" if str(error) else "not enough memory (none left); free some"
    assert [line for line in lines if line.startswith(f"tungsten-dip: frame 0: {told}")]
    assert lines[-1].endswith("1 of 4 frames without a result: 0; the others are done")
    assert len(outputs(frames)) == COUNT - 1


def test_the_traceback_of_a_frame_that_failed_is_told_on_demand(frames, capsys, monkeypatch):
    def broken(path, mapping):
        raise RuntimeError("a bug")

    monkeypatch.setattr(work, "read_buffers", broken)
    assert main(arguments("--frames", "0")) == 2
    assert "Traceback" not in capsys.readouterr().err
    monkeypatch.setenv("TUNGSTEN_DIP_DEBUG", "1")
    with pytest.raises(InputError, match="1 of 1 frames without a result"):
        main(arguments("--frames", "0"))
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "in broken" in err


@pytest.mark.parametrize("more", [(), ("--workers", "2")])
def test_what_frames_were_taken_for_is_told_once(frames, capsys, more):
    if more:
        pytest.importorskip("distributed")
    for number in range(COUNT):
        write_image(f"noisy/f{number:04d}/nfor.exr", np.ones((2, 3, 3), np.float32))
    Path("noisy/f0002/normalB.exr").unlink()
    hole = read_image("noisy/f0003/color.exr").copy()
    hole[1, 2] = np.nan
    write_image("noisy/f0003/color.exr", hole)
    assert main(arguments(*more)) == 0
    lines = [re.sub(r"^tungsten-dip: ", "", line) for line in capsys.readouterr().err.splitlines()]
    assert sum(line.endswith(" pixels") for line in lines) == 1
    for told in (
        "ignored: nfor.exr",
        "color: mean color.RGB, half_a colorA.RGB, half_b colorB.RGB, variance colorVariance.RGB",
        "normal: mean normal.RGB, half_a normalA.RGB, half_b normalB.RGB, variance normalVariance.RGB",
        "normal: mean normal.RGB, half_a normalA.RGB, variance normalVariance.RGB",
        "repaired color 3 NaN",
    ):
        assert lines.count(told) == 1, told
    assert sum(line.startswith("frame ") for line in lines) == COUNT


def test_bad_options_are_one_line(frames, capsys):
    for more, message in (
        (("--workers", "0"), "--workers: expected a whole number from 1 to 1024, got 0"),
        (("--workers", "100000"), "--workers: expected a whole number from 1 to 1024, got 100000"),
        (("--workers", "1", "--scheduler", "tcp://host:1"), "a scheduler has its own; omit one of the two"),
        (("-o", "out/f####.png"), "ends in .exr"),
        (("--refit", "some"), "expected auto, 0 or a number"),
        (("--refit", "\N{SUPERSCRIPT TWO}"), "expected auto, 0 or a number"),
        (("--refit", "-1"), "refit, unless auto: expected a whole number from 0 to"),
        (("--scheduler", "host"), "expected local or an address"),
        (("--frames", "x"), "expected numbers"),
        (("--preset", "paper"), "invalid choice: 'paper'"),
        (("--map", "depth=z", "--map", "depth=none"), "--map depth: expected one layer, got z and none"),
        (("--report", "page.txt"), "page.txt"),
    ):
        assert main(arguments(*more)) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert message in lines[0]
    assert not outputs(frames)


def test_a_pattern_that_the_shell_has_expanded_is_to_be_quoted(frames, capsys):
    inputs = sorted(map(str, Path("noisy").iterdir()))
    assert main(["sequence", *inputs, "-o", "out/f####.exr"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{inputs[1]}: expected one pattern for all frames, got {COUNT} names; quote it" in line


@pytest.mark.parametrize(
    "more",
    [
        ("-o", "out/f####.png"),
        ("--report", "page.txt"),
        ("--save-model", "missing/model.onnx"),
        ("-o", "out/deep/f####.exr", "--report", "missing/page.html"),
        ("-o", f"out/{300 * 'a'}/f####.exr"),
    ],
)
def test_a_refused_run_leaves_no_folder(frames, capsys, more):
    assert main(arguments(*more)) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (frames / "out").exists()


def test_page_and_network_may_lie_in_the_new_folder_of_the_frames(frames):
    assert main(arguments("--report", "out/page.html", "--save-model", "out/model.onnx")) == 0
    assert {"page.html", "model.onnx"} <= {file.name for file in (frames / "out").iterdir()}


def test_a_killed_run_loses_the_frame_in_hand_alone(frames):
    (frames / "out").mkdir()
    (frames / "out/.f0003-0123abcd.exr").write_bytes(b"left by an earlier kill")
    process = subprocess.Popen([*PROGRAM, *arguments()], cwd=frames)
    try:
        wait_for(lambda: len(outputs(frames)) >= 2 or process.poll() is not None)
        process.kill()
    finally:
        process.wait()
    finished = outputs(frames)
    assert len(finished) >= 2
    assert main(arguments()) == 0
    now = outputs(frames)
    assert len(now) == COUNT
    assert {name: now[name] for name in finished} == finished


def test_ctrl_c_keeps_what_is_finished_and_nothing_else(frames, capsys, monkeypatch):
    real, calls = work.read_buffers, []

    def interrupted_at_the_third(*given):
        calls.append(given)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(work, "read_buffers", interrupted_at_the_third)
    assert main(arguments()) == 130
    assert list(outputs(frames)) == ["f0000.exr", "f0001.exr"]
    assert "interrupted" in capsys.readouterr().err


def test_a_fit_cut_short_by_ctrl_c_is_not_saved(frames, monkeypatch):
    import tungsten_dip.fit.network.training as training

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "estimate_error", interrupted)
    assert main(arguments()) == 130
    assert not outputs(frames)


def test_the_first_network_is_saved_and_used(frames, capfd):
    assert main(arguments("--frames", "0", "--save-model", "m.onnx")) == 0
    assert capfd.readouterr().out.startswith("1 frame, ")
    assert load_model("m.onnx").source_sha256 == source_sha256(read_buffers("noisy/f0000"))
    assert main(arguments("--frames", "1", "--warm-start", "m.onnx", "--refit", "0", "--json")) == 0
    (frame,) = told(capfd)["frames"]
    assert (frame["how"], frame["iterations"]) == ("followed", 0)


def test_the_first_network_is_saved_before_the_next_frame(frames, monkeypatch):
    denoise = work._denoise

    def interrupted_at_the_second(frame, *rest):
        if frame.number == 1:
            raise KeyboardInterrupt
        return denoise(frame, *rest)

    monkeypatch.setattr(work, "_denoise", interrupted_at_the_second)
    assert main(arguments("--save-model", "m.onnx")) == 130
    saved = Path("m.onnx").read_bytes()
    monkeypatch.undo()
    monkeypatch.chdir(frames)
    assert main(arguments("--save-model", "m.onnx")) == 0
    assert Path("m.onnx").read_bytes() == saved


@pytest.mark.parametrize("workers", [(), ("--workers", "2")])
@pytest.mark.parametrize("cameras", [True, False])
def test_the_saved_network_is_the_first_frames_whatever_comes_after(frames, capfd, cameras, workers):
    if workers:
        pytest.importorskip("distributed")
    # With cameras, frame 1 is a cut; without, it trains the first one's network further.
    cut = true_frame(frames, 30.0, seed=1)
    shutil.copy("camera.json", "cameras/f0001.json")
    if cameras:
        write_tungsten_folder(Path("noisy/f0001"), cut.buffers)
    command = arguments("--frames", "0-2", "--refit", "auto", "--save-model", "m.onnx", "--json", *workers)
    if not cameras:
        command = [word for word in command if "camera" not in word]
    assert main(command) == 0
    records = told(capfd)["frames"]
    assert (records[1]["how"] == "cut") == cameras
    assert load_model("m.onnx").source_sha256 == source_sha256(read_buffers("noisy/f0000"))


# --- Several processes ---


def wait_for(condition, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, each a process of its own; yields the scheduler's address."""
    pytest.importorskip("distributed")
    address_file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    scheduler = [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"]
    scheduler += ["--scheduler-file", str(address_file)]
    processes = [subprocess.Popen(scheduler, stderr=subprocess.DEVNULL, env=environment)]
    worker = [*dask, "worker", "--scheduler-file", str(address_file), "--nthreads", "1", "--no-dashboard"]
    worker += ["--no-nanny", "--local-directory", str(tmp_path / "dask")]
    try:
        for _ in range(2):
            processes.append(subprocess.Popen(worker, stderr=subprocess.DEVNULL, env=environment))
        wait_for(address_file.is_file)
        yield json.loads(address_file.read_text())["address"]
    finally:
        for process in processes[::-1]:
            process.send_signal(signal.SIGKILL)
            process.wait()


def test_a_worker_killed_within_a_frame_loses_nothing(frames, cluster):
    from distributed import Client

    with Client(cluster) as client:
        client.wait_for_workers(2, timeout=60)
        pids = client.run(os.getpid)
        process = subprocess.Popen(
            [*PROGRAM, *arguments("--scheduler", cluster, "--json")], stdout=subprocess.PIPE, text=True
        )
        # Frames 0 and 1 are the first task; whoever works after that does so on one of the others.
        wait_for(lambda: len(outputs(frames)) >= 2 or process.poll() is not None)
        busy: list[str] = []

        def someone_works() -> bool:
            busy[:] = [address for address, tasks in client.processing().items() if tasks]
            return bool(busy) or process.poll() is not None

        wait_for(someone_works)
        assert busy, "all frames were done before a worker could be killed"
        os.kill(pids[busy[0]], signal.SIGKILL)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    records = json.loads(output)["frames"]
    assert [record["number"] for record in records] == list(range(COUNT))
    assert all(record["error"] is None for record in records)
    assert len(outputs(frames)) == COUNT


def test_a_scheduler_that_is_lost_is_one_line_per_frame(frames, cluster):
    from distributed import Client

    with Client(cluster) as client:
        client.wait_for_workers(2, timeout=60)
        busy = [client.submit(time.sleep, 600, key=f"busy-{number}") for number in range(2)]
        command = [*PROGRAM, *arguments("--scheduler", cluster)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

        def frames_wait() -> bool:
            count = client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks))
            return count > len(busy) or process.poll() is not None

        wait_for(frames_wait)
        os.kill(client.run_on_scheduler(os.getpid), signal.SIGKILL)
        _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "Traceback" not in error
    for number in range(COUNT):
        assert f"frame {number}: the Dask scheduler that had it was lost; start one again and" in error
    assert f"{COUNT} of {COUNT} frames without a result" in error.splitlines()[-1]


def test_local_workers_do_what_one_does(frames, capsys):
    pytest.importorskip("distributed")
    (frames / "socket.py").write_text("open('foreign code', 'w'); raise ImportError")
    assert main(arguments("--workers", "2", "--json", "--frames", "0-3,9")) == 2
    assert not (frames / "foreign code").exists()
    err = capsys.readouterr().err
    assert "1 of 5 frames without a result: 9" in err
    assert "frame 9: " in err
    assert len(outputs(frames)) == COUNT
    # All are finished: no worker is needed, and what one process finds is the same.
    before = outputs(frames)
    assert main(arguments()) == 0
    assert outputs(frames) == before


@pytest.mark.parametrize(("more", "started"), [((), 2), (("--frames", "1-2"), 1), (("--cameras", ""), 4)])
def test_no_more_workers_start_than_have_something_to_do(frames, monkeypatch, more, started):
    distributed = pytest.importorskip("distributed")

    def local_cluster(n_workers, **_):
        asked.append(n_workers)
        raise RuntimeError

    asked = []
    monkeypatch.setattr(distributed, "LocalCluster", local_cluster)
    command = arguments("--workers", "24", *more)
    if "" in more:
        command = [word for word in command if "camera" not in word and word]
    assert main(command) == 2
    assert asked == [started]


_BLOCKED_SIGNALS = """
import signal
from tungsten_dip.sequence.cluster import _client

with _client("local", 2) as client:
    masks = client.run(lambda: signal.pthread_sigmask(signal.SIG_BLOCK, []))
    print([signal.SIGINT in mask for mask in masks.values()])
"""


def test_ctrl_c_in_a_terminal_reaches_no_local_worker():
    pytest.importorskip("distributed")
    # In a process of its own, that has started no other before.
    command = [sys.executable, "-c", _BLOCKED_SIGNALS]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "[True, True]\n"


def test_a_run_on_local_workers_that_is_terminated_ends_in_one_line(frames):
    pytest.importorskip("distributed")
    write_frames(frames / "many", 40)
    command = [*PROGRAM, "sequence", "many/noisy/f####", "-o", "out/f####.exr", "--workers", "2"]
    process = subprocess.Popen([*command, "--threads", "1"], stderr=subprocess.PIPE, text=True)
    wait_for(lambda: outputs(frames) or process.poll() is not None)
    process.terminate()
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error.splitlines()[-1] == "tungsten-dip: interrupted"
    assert len(outputs(frames)) < 40


def test_a_scheduler_that_does_not_answer_is_one_line(frames, capsys, monkeypatch):
    pytest.importorskip("distributed")
    from tungsten_dip.sequence import cluster as module

    monkeypatch.setattr(module, "_CONNECT_TIMEOUT_S", 1)
    assert main(arguments("--scheduler", "tcp://127.0.0.1:9")) == 2
    assert "no scheduler answers" in capsys.readouterr().err


def test_local_workers_that_do_not_start_are_one_line(frames, capsys, monkeypatch):
    distributed = pytest.importorskip("distributed")

    def local_cluster(**_):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(distributed, "LocalCluster", local_cluster)
    assert main(arguments("--workers", "2")) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert "--workers 2: they do not start (Nanny failed to start.); use fewer, or allow more" in last


def test_a_scheduler_without_workers_is_one_line(frames, capsys, monkeypatch):
    distributed = pytest.importorskip("distributed")
    from tungsten_dip.sequence import cluster as module

    monkeypatch.setattr(module, "_CONNECT_TIMEOUT_S", 1)
    with distributed.LocalCluster(
        n_workers=0, processes=False, dashboard_address=None, protocol="tcp"
    ) as local:
        assert main(arguments("--scheduler", local.scheduler_address)) == 2
    assert "has no worker; start one with: dask worker tcp://" in capsys.readouterr().err


def test_the_first_two_frames_fit_the_networks_of_all_others(frames, capfd):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as local:
        assert main(arguments("--scheduler", local.scheduler_address, "--refit", "0", "--json")) == 0
    iterations = [record["iterations"] for record in told(capfd)["frames"]]
    assert min(iterations[:2]) > 0
    assert iterations[2:] == [0, 0]


def test_workers_tell_no_flicker_against_a_frame_further_back(frames, capfd):
    distributed = pytest.importorskip("distributed")
    assert main(arguments("--frames", "1")) == 0
    capfd.readouterr()
    with distributed.LocalCluster(
        n_workers=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as local:
        assert main(arguments("--frames", "0-2", "--scheduler", local.scheduler_address, "--json")) == 0
    records = told(capfd)["frames"]
    assert [record["skipped"] for record in records] == [False, True, False]
    assert records[2]["flicker"] is None


@pytest.mark.parametrize("cameras", [True, False])
@pytest.mark.parametrize("killer", [0, 1, 2])
def test_a_frame_that_no_worker_survives_is_told_and_the_others_done(
    frames, capfd, monkeypatch, killer, cameras
):
    distributed = pytest.importorskip("distributed")
    from tungsten_dip.sequence import cluster as module

    def dying_at_one(frames, run, models):
        before = [frame for frame in frames if frame.number < killer]
        done = work.denoise_frames(before, run, models)
        if killer in (frame.number for frame in frames):
            raise RuntimeError("it died")
        rest = frames[len(before) :]
        return work.denoise_frames(rest, run, models) if rest else done

    monkeypatch.setattr(module, "denoise_frames", dying_at_one)
    command = arguments("--json", "--refit", "0")
    if not cameras:
        command = [word for word in command if "camera" not in word]
    with distributed.LocalCluster(
        n_workers=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as local:
        assert main([*command, "--scheduler", local.scheduler_address]) == 2
    out, err = capfd.readouterr()
    assert f"frame {killer}: RuntimeError: it died" in err
    assert f"1 of 4 frames without a result: {killer}; the others are done" in err
    done = [record["iterations"] for record in json.loads(out)["frames"] if record["error"] is None]
    assert len(done) == len(outputs(frames)) == COUNT - 1
    # They share the network of the first of them, with cameras that of the second as well.
    fits = 2 if cameras else 1
    assert min(done[:fits]) > 0
    if killer != 1 or not cameras:
        assert done[fits:] == [0] * (COUNT - 1 - fits)


def test_a_saved_model_is_that_of_the_first_frame_and_stays(frames, capsys):
    command = [*arguments("--save-model", "m.onnx")]
    assert main(command) == 0
    before = Path("m.onnx").read_bytes()
    assert main(command) == 0
    Path("out/f0003.exr").unlink()
    assert main(command) == 0
    assert "left as it is: frame 0 was finished before" in capsys.readouterr().err
    assert Path("m.onnx").read_bytes() == before
    Path("m.onnx").unlink()
    assert main(command) == 2
    assert "frame 0 was finished before" in capsys.readouterr().err
    assert main(arguments("--save-model", "m.txt")) == 2
    assert "ends in .onnx" in capsys.readouterr().err


@pytest.mark.parametrize("more", [(), ("--workers", "2")])
def test_no_other_network_is_saved_in_place_of_the_first_frames(frames, capfd, more):
    if more:
        pytest.importorskip("distributed")
    (frames / "noisy/f0000/color.exr").write_bytes(b"no image")
    assert main(arguments("--save-model", "m.onnx", "--json", *more)) == 2
    out, err = capfd.readouterr()
    assert len(json.loads(out)["frames"]) == COUNT
    assert err.splitlines()[-1].endswith(
        "1 of 4 frames without a result: 0; the others are done; m.onnx: not written: frame 0, whose network "
        "it is, has no result"
    )
    assert not Path("m.onnx").exists()


def test_json_tells_of_the_frames_that_are_done_where_others_are_not(frames, capfd):
    assert main(arguments("--frames", "0,9", "--json")) == 2
    out, err = capfd.readouterr()
    first, other = json.loads(out)["frames"]
    assert first["error"] is None
    assert "f0009" in other["error"]
    assert "frame 9: " in err
    assert err.splitlines()[-1].endswith("1 of 2 frames without a result: 9; the others are done")


def test_the_published_method_is_refused_before_a_worker_starts(frames, capsys):
    pytest.importorskip("distributed")
    save_model("paper.onnx", paper_model("resnet", read_buffers("noisy/f0000")))
    given = arguments("--workers", "2", "--warm-start", "paper.onnx")
    assert main([word for word in given if word not in ("--preset", "draft")]) == 2
    err = capsys.readouterr().err
    assert "preset paper" in err.splitlines()[-1]
    assert "Traceback" not in err
