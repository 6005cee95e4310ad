"""What each effect costs in time: examples/cornell-box in diffuse colours, rendered without and with it.

    python benchmarks/effect_costs.py [--repeats 5]

Prints the table in docs/scenes.md. Time is CPU time of the embedded host, all threads together, which other
work on the machine disturbs little; both renders of a pair follow one another, and medians are compared.
"""

from __future__ import annotations

import argparse
import json
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.buffers.render_buffers import Quantity
from tungsten_dip.errors import InputError
from tungsten_dip.hosts.mitsuba.render import QUANTITIES, render
from tungsten_dip.scene.parse import load_scene
from tungsten_dip.scene.types import Scene

Json = dict[str, Any]
Edit = Callable[[Json], None]

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
RESOLUTION = (256, 144)
SPP = 16
STRANDS = "strands.hair"


def diffuse_scene() -> Json:
    """The room with a lambert surface on everything."""
    scene: Json = json.loads((EXAMPLES / "cornell-box" / "scene.json").read_text(encoding="utf-8"))
    scene["camera"]["resolution"] = RESOLUTION
    for bsdf in scene["bsdfs"]:
        if bsdf["type"] not in ("lambert", "null"):
            name = bsdf["name"]
            bsdf.clear()
            bsdf.update(name=name, type="lambert", albedo=0.6)
    return scene


def on_spheres(**bsdf: Any) -> Edit:
    """Both spheres get this BSDF."""

    def edit(scene: Json) -> None:
        for primitive in scene["primitives"]:
            if primitive["type"] == "sphere":
                primitive["bsdf"] = bsdf

    return edit


def on_walls(albedo: Any) -> Edit:
    """Floor, ceiling and back wall get this albedo."""

    def edit(scene: Json) -> None:
        next(bsdf for bsdf in scene["bsdfs"] if bsdf["name"] == "plaster")["albedo"] = albedo

    return edit


def thin_lens(scene: Json) -> None:
    """The camera focuses on the middle of the room."""
    scene["camera"].update(type="thinlens", aperture_size=0.1, focus_distance=5.6)


def fog(scene: Json) -> None:
    """A box that holds the room is filled with fog: one mean free path is three times the room's width."""
    scene["media"] = [{"name": "fog", "type": "homogeneous", "sigma_s": 0.09}]
    box = {"type": "cube", "bsdf": {"type": "forward"}, "int_medium": "fog"}
    scene["primitives"].append({**box, "transform": {"position": [0, 1, 0], "scale": 4}})


def curves(**bsdf: Any) -> Edit:
    """Strands on the floor."""

    def edit(scene: Json) -> None:
        strands = {"type": "curves", "file": STRANDS, "curve_thickness": 0.004, "bsdf": bsdf}
        scene["primitives"].append({**strands, "mode": "cylinder"})

    return edit


def sky(scene: Json) -> None:
    """The open side of the room lets light in."""
    scene["primitives"].append(
        {"type": "infinite_sphere", "emission": str(EXAMPLES / "textures" / "sky.hdr")}
    )


def bounces(count: int) -> Edit:
    """Paths end after this many bounces."""
    return lambda scene: scene["integrator"].update(max_bounces=count)


def nothing(_: Json) -> None:
    """The scene stays as it is."""


PAIRS: dict[str, tuple[Edit, Edit]] = {
    "depth of field": (nothing, thin_lens),
    "glossy reflection": (nothing, on_spheres(type="rough_conductor", material="Au", roughness=0.15)),
    "specular transport: mirrors": (nothing, on_spheres(type="mirror", albedo=0.9)),
    "transmission: glass": (nothing, on_spheres(type="dielectric", ior=1.5)),
    "transparency: half of every sphere": (
        nothing,
        on_spheres(type="transparency", alpha=0.5, base={"type": "lambert", "albedo": 0.6}),
    ),
    "participating media: thin fog in the room": (nothing, fog),
    "hair: 2000 strands": (nothing, curves(type="hair", sigma_a=0.5)),
    "the same strands, lambert": (nothing, curves(type="lambert", albedo=0.6)),
    "textures: bitmap on three walls": (
        nothing,
        on_walls(str(EXAMPLES / "textures" / "tiles.png")),
    ),
    "environment light": (nothing, sky),
    "bounces: 16 in place of 2": (bounces(2), bounces(16)),
}


def write_strands(path: Path, count: int = 2000, points: int = 6) -> None:
    """Write strands on the floor, bent at random, in Cem Yuksel's format."""
    rng = np.random.default_rng(0)
    root = np.stack([rng.uniform(-1.7, 1.7, count), np.zeros(count), rng.uniform(-1.5, 1.5, count)], axis=-1)
    height = np.linspace(0.0, 1.0, points)[None, :, None]
    lean = rng.uniform(-0.2, 0.2, (count, 1, 3)) * [1, 0, 1]
    strands = root[:, None] + height * [0.0, 0.4, 0.0] + height**2 * lean
    header = struct.pack(
        "<4sIIIIff3f88x", b"HAIR", count, count * points, 2, points - 1, 0.004, 0.0, 1.0, 1.0, 1.0
    )
    path.write_bytes(header + strands.astype("<f4").tobytes())


def cpu_seconds(scene: Scene, quantities: tuple[Quantity, ...] = QUANTITIES) -> float:
    """Return the CPU time of one render."""
    start = time.process_time()
    render(scene, spp=SPP, quantities=quantities)
    return time.process_time() - start


def main() -> None:
    """Measure every pair and print the table."""
    parser = argparse.ArgumentParser(description="Measure what each effect costs in time.")
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    if repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, got {repeats}")

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_strands(folder / STRANDS)

        def scene_after(edit: Edit) -> Scene:
            described = diffuse_scene()
            edit(described)
            path = folder / "scene.json"
            path.write_text(json.dumps(described), encoding="utf-8")
            return load_scene(path)

        plain = scene_after(nothing)
        renders: dict[str, list[Callable[[], float]]] = {
            effect: [partial(cpu_seconds, scene_after(edit)) for edit in pair]
            for effect, pair in PAIRS.items()
        }
        renders["feature buffers: albedo, normal, depth"] = [
            partial(cpu_seconds, plain, ("color",)),
            partial(cpu_seconds, plain),
        ]
        cpu_seconds(plain)  # loads what is loaded once
        seconds: dict[str, list[tuple[float, ...]]] = {effect: [] for effect in renders}
        for _ in range(repeats):
            for effect, pair in renders.items():
                seconds[effect].append(tuple(timed() for timed in pair))

    print("| effect | off, CPU s | on, CPU s | on / off |\n|---|---|---|---|")
    for effect, measured in seconds.items():
        off, on = (statistics.median(column) for column in zip(*measured, strict=True))
        print(f"| {effect} | {off:.2f} | {on:.2f} | {on / off:.2f} |")


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        sys.exit(f"{sys.argv[0]}: {problem}")
