"""Scenes for the commands, and what their tests have in common."""

import json

SCENE = {
    "bsdfs": [{"name": "grey", "type": "lambert", "albedo": 0.5}],
    "primitives": [
        {"type": "quad", "bsdf": "grey", "transform": {"scale": 4}},
        {"type": "infinite_sphere", "emission": [0.5, 0.7, 1.0]},
    ],
    "camera": {
        "type": "pinhole",
        "tonemap": "filmic",
        "resolution": [17, 9],
        "fov": 45,
        "transform": {"position": [0, 2, 5], "look_at": [0, 0, 0], "up": [0, 1, 0]},
    },
    "integrator": {"type": "path_tracer", "max_bounces": 2},
    "renderer": {
        "output_file": "picture.png",
        "hdr_output_file": "picture.exr",
        "spp": 4,
        "output_buffers": [
            {
                "type": "normal",
                "hdr_output_file": "n.exr",
                "ldr_output_file": "n.png",
                "two_buffer_variance": True,
                "sample_variance": True,
            },
            {"type": "depth", "hdr_output_file": "z.pfm"},
        ],
    },
}
"""A small scene of Tungsten's, for every test that renders by the commands."""

MAIN = "import sys; from tungsten_dip.cli.{} import main; sys.exit(main())"
"""What the installed commands do."""


def write_scene(path, **renderer):
    scene = {**SCENE, "renderer": {**SCENE["renderer"], **renderer}}
    path.write_text(json.dumps(scene))
    return path


def write_frames(folder, *names):
    """Write scenes that make pictures alone, each of its own name; return their paths."""
    files = {"hdr_output_file": "", "output_buffers": []}
    return [write_scene(folder / f"{name}.json", output_file=f"{name}.png", **files) for name in names]


def fails(capfd, status, *words):
    """Assert that the command ended with one line that holds the words, and that stdout stayed empty."""
    out, err = capfd.readouterr()
    assert status == 2
    assert out == ""
    assert "Traceback" not in err
    last = err.splitlines()[-1]
    assert last.startswith(("tungsten-dip: ", "tungsten: "))
    assert all(str(word) in last for word in words), last
