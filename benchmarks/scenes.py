"""Seven scenes of what denoisers find hard, for Tungsten: made by rules, so that nobody needs to own them.

    python benchmarks/scenes.py FOLDER
    cd FOLDER/fur && tungsten -s 1 noisy.json && tungsten -s 2 reference.json
    tungsten-dip bench pareto FOLDER/*/noisy --methods presets,oidn

writes two scene files for each: ``noisy.json`` renders buffers into ``noisy/``, ``reference.json`` the truth
beside it. A Tungsten without OpenEXR needs ``--format pfm``, and the bench the names of the references then:
``FOLDER/fur/noisy=FOLDER/fur/reference.pfm``. With ``--frames 4`` the camera moves around each scene:
``noisy-0000.json``, ``reference-0000.json`` and so on, for

    cd FOLDER/fur && tungsten-dip sequence 'noisy-####' -o '####.exr' --cameras 'noisy-####.json'
    python benchmarks/frames.py 'FOLDER/fur/reference-####.exr' 'FOLDER/fur/####.exr'
"""

import argparse
import json
import math
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

Json = dict[str, Any]
Vector = Sequence[float]

RESOLUTION = (512, 288)
DEGREES_PER_FRAME = 2.5
RISE_PER_FRAME = 0.02


def surface(kind: str, bsdf: str, at: Vector, scale: Vector | float = 1, turned: Vector = (0, 0, 0)) -> Json:
    """Return a primitive; ``turned`` are Tungsten's Euler angles in degrees."""
    size = scale if isinstance(scale, int | float) else list(scale)
    return {
        "type": kind,
        "bsdf": bsdf,
        "transform": {"position": list(at), "scale": size, "rotation": list(turned)},
    }


def lamp(kind: str, at: Vector, scale: Vector | float, emission: Vector, turned: Vector = (0, 0, 0)) -> Json:
    """Return a primitive that shines; there must be a BSDF called wall."""
    return {**surface(kind, "wall", at, scale, turned), "emission": list(emission)}


def lambert(name: str, albedo: Vector) -> Json:
    """Return a diffuse BSDF."""
    return {"name": name, "type": "lambert", "albedo": list(albedo)}


def checker(on: Vector, off: Vector, squares: int) -> Json:
    """Return a texture of so many squares each way."""
    return {
        "type": "checker",
        "on_color": list(on),
        "off_color": list(off),
        "res_u": squares,
        "res_v": squares,
    }


def camera(at: Vector, look_at: Vector, fov: float, **more: Any) -> Json:
    """Return a camera, a pinhole unless ``more`` says otherwise."""
    pose = {"position": list(at), "look_at": list(look_at), "up": [0, 1, 0]}
    return {"type": "pinhole", "fov": fov, "transform": pose, **more}


def daylight(sun: float, cap_angle: float, turned: Vector) -> list[Json]:
    """Return a sun and the sky around it."""
    pose = {"rotation": list(turned)}
    return [
        {
            "type": "infinite_sphere_cap",
            "emission": sun,
            "cap_angle": cap_angle,
            "sample": True,
            "transform": pose,
        },
        {"type": "skydome", "turbidity": 3, "intensity": 4, "sample": False, "transform": pose},
    ]


def room(wall: str, floor: str, back: str) -> list[Json]:
    """Return the six sides of a room of 6 x 3 x 8, by their BSDFs; the camera stands towards +z."""
    return [
        surface("quad", floor, (0, 0, 0), (6, 1, 8)),
        surface("quad", wall, (0, 3, 0), (6, 1, 8), (180, 0, 0)),
        surface("quad", back, (0, 1.5, -4), (6, 1, 3), (90, 0, 0)),
        surface("quad", wall, (0, 1.5, 4), (6, 1, 3), (-90, 0, 0)),
        surface("quad", wall, (3, 1.5, 0), (3, 1, 8), (0, 0, 90)),
        surface("quad", wall, (-3, 1.5, 0), (3, 1, 8), (0, 0, -90)),
    ]


def depth_of_field(_: Path) -> Json:
    """A large aperture before many things, which blurs the features as well."""
    random = Random(1)
    bsdfs = [
        {"name": "floor", "type": "lambert", "albedo": checker((0.8, 0.8, 0.75), (0.1, 0.12, 0.2), 40)},
        lambert("red", (0.7, 0.1, 0.08)),
        lambert("blue", (0.1, 0.2, 0.6)),
        {
            "name": "copper",
            "type": "rough_conductor",
            "material": "Cu",
            "distribution": "ggx",
            "roughness": 0.15,
        },
        {"name": "plastic", "type": "plastic", "albedo": [0.2, 0.5, 0.2], "ior": 1.5},
    ]
    things = []
    for _thing in range(60):
        size = random.uniform(0.15, 0.45)
        kind, bsdf = random.choice(["sphere", "cube"]), random.choice(["red", "blue", "copper", "plastic"])
        at = (random.uniform(-4, 4), size, random.uniform(-6, 3))
        things.append(surface(kind, bsdf, at, size, (0, random.uniform(0, 90), 0)))
    lens = {"type": "thinlens", "aperture_size": 0.12, "focus_distance": 5.5}
    return {
        "bsdfs": bsdfs,
        "primitives": [surface("quad", "floor", (0, 0, 0), 20), *things, *daylight(60, 10, (40, 20, 30))],
        "camera": camera((0, 1.5, 5.5), (0, 0.3, 0), 45, **lens),
    }


def outdoors(_: Path) -> Json:
    """Hard shadows of a small sun, thin posts, a mirror and glass on a checkered ground."""
    random = Random(2)
    bsdfs = [
        {"name": "floor", "type": "lambert", "albedo": checker((0.6, 0.55, 0.4), (0.25, 0.3, 0.2), 60)},
        lambert("wood", (0.45, 0.3, 0.18)),
        lambert("white", (0.8, 0.8, 0.8)),
        {"name": "mirror", "type": "mirror", "albedo": 0.95},
        {"name": "glass", "type": "dielectric", "ior": 1.5},
    ]
    posts = [
        surface("cube", "wood", (-6 + 0.2 * i, 0.5, -1 - 0.02 * (i % 2)), (0.05, 1, 0.05)) for i in range(60)
    ]
    stones = [
        surface(
            "cube",
            "white",
            (random.uniform(-5, 5), 0.4, random.uniform(-5, -1.5)),
            (0.3, 0.8, 0.3),
            (0, random.uniform(0, 90), 0),
        )
        for _stone in range(20)
    ]
    spheres = [
        surface("sphere", "mirror", (-1.4, 0.5, 0.6), 0.5),
        surface("sphere", "glass", (0.2, 0.4, 1.0), 0.4),
        surface("sphere", "white", (1.5, 0.45, 0.5), 0.45),
    ]
    ground = surface("quad", "floor", (0, 0, 0), 30)
    return {
        "bsdfs": bsdfs,
        "primitives": [ground, *posts, *stones, *spheres, *daylight(400, 3, (40, 20, 30))],
        "camera": camera((0, 1.2, 4.5), (0, 0.4, 0), 50),
    }


def meadow(_: Path) -> Json:
    """Six thousand blades of grass, most of them a pixel wide."""
    random = Random(3)
    greens = [
        lambert(
            f"green{i}", [random.uniform(0.05, 0.3), random.uniform(0.25, 0.6), random.uniform(0.02, 0.15)]
        )
        for i in range(8)
    ]
    blades = [
        surface(
            "quad",
            f"green{random.randrange(8)}",
            (random.uniform(-4, 4), 0.1, random.uniform(-4, 3)),
            (0.03, 1, 0.35),
            (80 + random.uniform(-25, 25), random.uniform(0, 360), 0),
        )
        for _blade in range(6000)
    ]
    return {
        "bsdfs": [*greens, lambert("soil", (0.2, 0.13, 0.08)), lambert("ball", (0.8, 0.7, 0.6))],
        "primitives": [
            surface("quad", "soil", (0, 0, 0), 12),
            surface("sphere", "ball", (0, 0.5, 0), 0.5),
            *blades,
            *daylight(60, 10, (40, 20, 30)),
        ],
        "camera": camera((0, 0.9, 4), (0, 0.25, 0), 40),
    }


def plates(_: Path) -> Json:
    """Metal plates of four roughnesses under lights of four sizes, after Veach and Guibas 1995."""
    bsdfs = [lambert("wall", (0.5, 0.5, 0.5))]
    primitives = [
        surface("quad", "wall", (0, 0, 0), 20),
        surface("quad", "wall", (0, 5, -3), 20, (90, 0, 0)),
    ]
    for i, roughness in enumerate((0.02, 0.08, 0.2, 0.4)):
        metal = {"type": "rough_conductor", "material": "Al", "distribution": "ggx", "roughness": roughness}
        bsdfs.append({"name": f"plate{i}", **metal})
        at = (0, 0.3 + 0.55 * i, 1.5 - i)
        primitives.append(surface("cube", f"plate{i}", at, (4, 0.05, 0.8), (20 + 12 * i, 0, 0)))
    for i, (radius, radiance) in enumerate(((0.02, 2000), (0.08, 130), (0.25, 14), (0.5, 3.5))):
        emission = (radiance, 0.9 * radiance, 0.8 * radiance)
        primitives.append(lamp("sphere", (-1.6 + 1.1 * i, 3, -1.2), radius, emission))
    return {"bsdfs": bsdfs, "primitives": primitives, "camera": camera((0, 2.2, 7.5), (0, 1.2, 0), 38)}


def bathroom(_: Path) -> Json:
    """Tiles, chrome, glass and a mirror under three small lamps that the picture shows."""
    tiles = checker((0.8, 0.8, 0.8), (0.15, 0.25, 0.35), 24)
    bsdfs = [
        lambert("wall", (0.75, 0.75, 0.7)),
        {
            "name": "floor",
            "type": "rough_plastic",
            "albedo": tiles,
            "ior": 1.5,
            "distribution": "ggx",
            "roughness": 0.05,
        },
        {"name": "tiles", "type": "lambert", "albedo": checker((0.7, 0.75, 0.8), (0.5, 0.2, 0.15), 30)},
        {"name": "mirror", "type": "mirror", "albedo": 0.9},
        {"name": "glass", "type": "dielectric", "ior": 1.5},
        {"name": "chrome", "type": "conductor", "material": "Cr"},
        {"name": "ceramic", "type": "plastic", "albedo": [0.85, 0.85, 0.85], "ior": 1.5},
        lambert("towel", (0.7, 0.2, 0.3)),
    ]
    things = [
        surface("quad", "mirror", (1, 1.7, -3.95), (1.8, 1, 1.4), (90, 0, 0)),
        surface("cube", "ceramic", (1, 0.5, -3.2), (1.6, 0.9, 0.9)),
        surface("sphere", "glass", (0.6, 1.1, -3), 0.15),
        surface("sphere", "chrome", (1.3, 1.08, -3.1), 0.13),
        surface("cube", "towel", (-2.2, 0.6, -1.5), (0.8, 1.2, 0.5), (0, 30, 0)),
        surface("sphere", "ceramic", (-0.9, 0.4, -1.8), 0.4),
        surface("cube", "glass", (-0.3, 0.25, -0.6), (0.4, 0.5, 0.4), (0, 20, 0)),
    ]
    lamps = [lamp("sphere", (x, 2.6, -3.8), 0.08, (30, 26, 20)) for x in (0.2, 1, 1.8)]
    return {
        "bsdfs": bsdfs,
        "primitives": [*room("wall", "floor", "tiles"), *things, *lamps],
        "camera": camera((-0.6, 1.5, 3.6), (0.2, 1, -2), 55),
    }


def door_ajar(_: Path) -> Json:
    """A room lit by what comes through the gap of a door, after Veach 1997."""
    gloss = {"ior": 1.5, "distribution": "ggx", "roughness": 0.15}
    bsdfs = [
        lambert("wall", (0.7, 0.68, 0.6)),
        {"name": "wood", "type": "rough_plastic", "albedo": [0.4, 0.25, 0.12], **gloss},
        {
            "name": "silver",
            "type": "rough_conductor",
            "material": "Ag",
            "distribution": "ggx",
            "roughness": 0.1,
        },
        lambert("clay", (0.6, 0.3, 0.2)),
        {"name": "picture", "type": "lambert", "albedo": checker((0.9, 0.6, 0.1), (0.1, 0.1, 0.3), 8)},
    ]
    # The side towards the next room has a gap, which the door leaves half open.
    side = [
        surface("quad", "wall", (-3, 1.5, -2.4), (3, 1, 3.2), (0, 0, -90)),
        surface("quad", "wall", (-3, 1.5, 2.2), (3, 1, 3.6), (0, 0, -90)),
        surface("quad", "wall", (-3, 2.6, 0), (0.8, 1, 8), (0, 0, -90)),
        surface("cube", "wood", (-2.75, 1.1, -0.55), (0.06, 2.2, 0.95), (0, 38, 0)),
    ]
    next_room = [
        surface("quad", "wood", (-5, 0, 0), (4, 1, 8)),
        surface("quad", "wall", (-7, 1.5, 0), (3, 1, 8), (0, 0, -90)),
        surface("quad", "wall", (-5, 1.5, -4), (4, 1, 3), (90, 0, 0)),
        surface("quad", "wall", (-5, 1.5, 4), (4, 1, 3), (-90, 0, 0)),
        surface("quad", "wall", (-5, 3, 0), (4, 1, 8), (180, 0, 0)),
        lamp("quad", (-5, 2.5, -0.6), (1.5, 1, 1.5), (600, 520, 400), (180, 0, 0)),
    ]
    things = [
        surface("cube", "wood", (0.5, 0.6, -1.2), (2.2, 0.08, 1.2)),
        surface("sphere", "silver", (0.1, 0.86, -1.2), 0.22),
        surface("sphere", "clay", (0.8, 0.82, -1), 0.18),
        surface("cube", "clay", (1.1, 0.79, -1.5), (0.2, 0.3, 0.2)),
        surface("quad", "picture", (1, 1.8, -3.98), (1, 1, 0.7), (90, 0, 0)),
    ]
    closed_sides = room("wall", "wood", "wall")[:-1]
    return {
        "bsdfs": bsdfs,
        "primitives": [*closed_sides, *side, *next_room, *things],
        "camera": camera((0.3, 1.6, 3.5), (0, 0.9, -1.5), 50),
    }


def fur(folder: Path) -> Json:
    """Four thousand hairs around a ball, in a file in Cem Yuksel's format."""
    count, nodes = 4000, 4
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(count, 1, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    along = np.arange(nodes).reshape(1, nodes, 1)
    bent = 0.14 * rng.normal(size=(count, 1, 3)) * (along / (nodes - 1)) ** 2
    points = direction * (0.6 + 0.16 * along) + bent + (0, 1.05, 0)
    widths = np.broadcast_to(0.006 * (1 - 0.2 * along[..., 0]), (count, nodes))
    # The header says: segments, points and widths follow.
    header = b"HAIR" + struct.pack("<3I I f f 3f", count, count * nodes, 7, 0, 0, 0, 1, 1, 1) + bytes(88)
    segments = np.full(count, nodes - 1, "<u2")
    parts = (segments, points.astype("<f4"), widths.astype("<f4"))
    (folder / "fur.hair").write_bytes(header + b"".join(part.tobytes() for part in parts))
    hairs = {"type": "curves", "file": "fur.hair", "mode": "bcsdf_cylinder", "bsdf": "hair", "transform": {}}
    return {
        "bsdfs": [
            {
                "name": "hair",
                "type": "hair",
                "scale_angle": 2.5,
                "melanin_ratio": 0.5,
                "melanin_concentration": 0.6,
                "roughness": 0.3,
            },
            lambert("skin", (0.4, 0.25, 0.2)),
            {"name": "floor", "type": "lambert", "albedo": checker((0.5, 0.5, 0.5), (0.2, 0.2, 0.25), 16)},
        ],
        "primitives": [
            {**hairs, "curve_thickness": 0.006, "curve_taper": True},
            surface("sphere", "skin", (0, 1.05, 0), 0.6),
            surface("quad", "floor", (0, 0, 0), 12),
            *daylight(100, 8, (34, -2, 23)),
        ],
        "camera": camera((0, 1.3, 3.6), (0, 0.9, 0), 42),
    }


SCENES: dict[str, tuple[Callable[[Path], Json], int, int]] = {
    "depth-of-field": (depth_of_field, 16, 1024),
    "outdoors": (outdoors, 8, 1024),
    "meadow": (meadow, 16, 1024),
    "plates": (plates, 16, 1024),
    "bathroom": (bathroom, 16, 1024),
    "door-ajar": (door_ajar, 32, 1024),
    "fur": (fur, 16, 256),
}
"""What makes each scene, and the samples per pixel of the noisy buffers and of the reference."""


def with_output(scene: Json, spp: int, output: Json) -> Json:
    """Return the whole scene file."""
    look = {"resolution": RESOLUTION, "tonemap": "gamma", "reconstruction_filter": "box"}
    sampling = {"spp": spp, "spp_step": spp, "stratified_sampler": False, "adaptive_sampling": False}
    return {
        "media": [],
        **scene,
        "camera": {**look, **scene["camera"]},
        "integrator": {"type": "path_tracer", "max_bounces": 32, "enable_two_sided_shading": True},
        "renderer": {**sampling, "overwrite_output_files": True, **output},
    }


def moved_on(camera: Json, frame: int) -> Json:
    """Return the camera as it stands at a frame: further around what it looks at, and higher."""
    if frame == 0:
        return camera
    (x, y, z), (center_x, _, center_z) = camera["transform"]["position"], camera["transform"]["look_at"]
    x, z = x - center_x, z - center_z
    angle = math.radians(DEGREES_PER_FRAME * frame)
    position = (
        center_x + x * math.cos(angle) + z * math.sin(angle),
        y + RISE_PER_FRAME * frame,
        center_z - x * math.sin(angle) + z * math.cos(angle),
    )
    return {**camera, "transform": {**camera["transform"], "position": position}}


def main() -> None:
    """Write every scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    parser.add_argument(
        "--format", default="exr", choices=["exr", "pfm"], help="of the images that are rendered"
    )
    parser.add_argument("--frames", type=int, default=1, help="of a camera that moves (default: 1)")
    options = parser.parse_args()
    if options.frames < 1:
        sys.exit(f"{sys.argv[0]}: --frames: expected a number above 0, got {options.frames}")
    for name, (make, spp, reference_spp) in SCENES.items():
        folder = options.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        scene = make(folder)
        for frame in range(options.frames):
            number = f"-{frame:04d}" if options.frames > 1 else ""
            seen = {**scene, "camera": moved_on(scene["camera"], frame)}
            write_frame(folder, number, seen, (spp, reference_spp), options.format)


def write_frame(folder: Path, number: str, scene: Json, spp: tuple[int, int], image_format: str) -> None:
    """Write the scene files of the noisy buffers and of the reference."""
    (folder / f"noisy{number}").mkdir(exist_ok=True)
    planes = {"sample_variance": True, "two_buffer_variance": True}
    buffers = [
        {"type": each, "hdr_output_file": f"noisy{number}/{each}.{image_format}", **planes}
        for each in ("color", "albedo", "normal", "depth")
    ]
    outputs: dict[str, Json] = {
        "noisy": {"output_buffers": buffers},
        "reference": {"hdr_output_file": f"reference{number}.{image_format}"},
    }
    for samples, (which, output) in zip(spp, outputs.items(), strict=True):
        whole = with_output(scene, samples, output)
        (folder / f"{which}{number}.json").write_text(json.dumps(whole, indent=1))


if __name__ == "__main__":
    main()
