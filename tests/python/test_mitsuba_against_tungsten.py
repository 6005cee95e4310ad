"""The embedded renderer against the real one: same pictures, same features, same noise.

Runs where the environment variable Tungsten_BUILD names the build folder of a Tungsten.
"""

from __future__ import annotations

import copy
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
import pytest

from tungsten_dip.buffers.read import read_buffers
from tungsten_dip.buffers.render_buffers import Buffer
from tungsten_dip.hosts.mitsuba.render import render
from tungsten_dip.scene.parse import load_scene

BUILD = os.environ.get("Tungsten_BUILD")  # noqa: SIM112
pytestmark = pytest.mark.skipif(not BUILD, reason="Tungsten_BUILD names no build of Tungsten")

QUANTITIES = ("color", "albedo", "normal", "depth")
HALF_PRECISION = 1e-3
"""Tungsten writes half floats; pixels without noise agree to this, relative."""

ROOM: dict[str, Any] = {
    "media": [],
    "bsdfs": [
        {"name": "mirror", "type": "mirror", "albedo": 0.9},
        {"name": "glass", "type": "dielectric", "ior": 1.5},
        {"name": "plastic", "type": "plastic", "ior": 1.5, "albedo": [0.2, 0.5, 0.7]},
        {"name": "sheet", "type": "thinsheet", "ior": 1.5},
        {"name": "red", "type": "lambert", "albedo": [0.8, 0.2, 0.2]},
        {"name": "veil", "type": "transparency", "alpha": 0.5, "base": "red"},
        {"name": "phong", "type": "phong", "albedo": 0.9, "exponent": 40},
        {"name": "mixed", "type": "mixed", "bsdf0": "phong", "bsdf1": "red", "ratio": 0.4},
        {"name": "light", "type": "null"},
        {"name": "forward", "type": "forward"},
        {
            "name": "floor",
            "type": "lambert",
            "albedo": {
                "type": "checker",
                "on_color": 0.8,
                "off_color": [0.2, 0.3, 0.2],
                "res_u": 8,
                "res_v": 8,
            },
        },
    ],
    "primitives": [
        {"type": "quad", "bsdf": "floor", "transform": {"scale": [8, 1, 8]}},
        {"type": "sphere", "bsdf": "mirror", "transform": {"position": [-1.5, 0.5, 0], "scale": 0.5}},
        {"type": "sphere", "bsdf": "glass", "transform": {"position": [-0.5, 0.5, 0.5], "scale": 0.5}},
        {"type": "sphere", "bsdf": "plastic", "transform": {"position": [0.5, 0.5, 0], "scale": 0.5}},
        {"type": "sphere", "bsdf": "veil", "transform": {"position": [1.6, 0.5, -0.6], "scale": 0.5}},
        {"type": "sphere", "bsdf": "mixed", "transform": {"position": [0, 0.3, 1.4], "scale": 0.3}},
        {
            "type": "quad",
            "bsdf": "sheet",
            "transform": {"position": [1.6, 0.6, 0.4], "scale": [0.8, 1, 0.8], "rotation": [70, 20, 0]},
        },
        {
            "type": "quad",
            "bsdf": "light",
            "emission": 10,
            "transform": {"position": [0, 3, 0], "scale": [1.5, 1, 1.5], "rotation": [180, 0, 0]},
        },
        {"type": "infinite_sphere", "emission": 0.3},
    ],
    "camera": {
        "type": "pinhole",
        "fov": 45,
        "resolution": [80, 45],
        "transform": {"position": [0, 1.6, 5], "look_at": [0, 0.6, 0], "up": [0, 1, 0]},
    },
    "integrator": {"type": "path_tracer", "max_bounces": 16},
    "renderer": {
        "output_file": "",
        "adaptive_sampling": False,
        "stratified_sampler": False,
        "enable_resume_render": False,
        "spp": 256,
        "spp_step": 256,
        "output_buffers": [
            {
                "type": name,
                "hdr_output_file": f"{name}.exr",
                "two_buffer_variance": True,
                "sample_variance": True,
            }
            for name in QUANTITIES
        ],
    },
}


def changed(section: str, **values: Any) -> dict[str, Any]:
    scene = copy.deepcopy(ROOM)
    scene[section].update(values)
    return scene


def foggy(**integrator: Any) -> dict[str, Any]:
    scene = changed("integrator", **integrator)
    scene["media"].append(
        {
            "name": "fog",
            "type": "homogeneous",
            "sigma_a": [0.05, 0.1, 0.2],
            "sigma_s": [0.3, 0.25, 0.2],
            "phase_function": {"type": "henyey_greenstein", "g": 0.4},
        }
    )
    del scene["primitives"][4:7]
    for ball in scene["primitives"][1:4]:
        ball["ext_medium"] = "fog"
    scene["primitives"].append(
        {
            "type": "cube",
            "bsdf": "forward",
            "int_medium": "fog",
            "transform": {"position": [0, 1.5, 0], "scale": [4, 2.98, 3]},
        }
    )
    return scene


def bumpy() -> dict[str, Any]:
    """The room with a height map on its floor and on a cube."""
    scene = copy.deepcopy(ROOM)
    bump = {"type": "bitmap", "file": "heights.png", "scale": 3}
    for bsdf in scene["bsdfs"]:
        if bsdf["name"] in ("floor", "plastic"):
            bsdf["bump"] = bump
    scene["primitives"][3] |= {
        "type": "cube",
        "transform": {"position": [0.5, 0.5, 0], "rotation": [150, 30, 200]},
    }
    return scene


def bent_veils() -> dict[str, Any]:
    """The room with height maps on what light passes straight through and on a smooth mesh."""
    scene = changed("integrator", enable_consistency_checks=True)
    for bsdf in scene["bsdfs"]:
        if bsdf["name"] in ("veil", "sheet", "red"):
            bsdf["bump"] = {"type": "bitmap", "file": "heights.png", "scale": 12}
    place = {"position": [1.6, 0.5, -0.6], "rotation": [30, 40, 10]}
    scene["primitives"][4] |= {"type": "cube", "transform": place}
    bowl = {"type": "mesh", "file": "bowl.obj", "smooth": True, "bsdf": "red"}
    scene["primitives"].append({**bowl, "transform": {"position": [-1.2, 1.2, 0], "scale": 0.5}})
    return scene


def bump_below_0() -> dict[str, Any]:
    """The room with a height map on a wall whose UV begin below 0 and end above 1."""
    scene = copy.deepcopy(ROOM)
    wall = {"type": "lambert", "bump": {"type": "bitmap", "file": "coarse.png", "scale": 3}}
    scene["primitives"].append({"type": "mesh", "file": "wall.obj", "bsdf": wall})
    return scene


def one_sided() -> dict[str, Any]:
    """The room with metal and glass that reflects alone, seen from behind, which are not turned."""
    scene = changed("integrator", enable_two_sided_shading=False)
    scene["bsdfs"] += [
        {"name": "copper", "type": "conductor", "material": "Cu"},
        {"name": "hard", "type": "dielectric", "ior": 1.5, "enable_refraction": False},
        {"name": "frosted", "type": "rough_dielectric", "roughness": 0.2, "enable_refraction": False},
        {"name": "both", "type": "mixed", "bsdf0": "frosted", "bsdf1": "red"},
    ]
    surfaces = ("copper", "hard", "frosted", "both")
    for number, (primitive, surface) in enumerate(zip(scene["primitives"][1:5], surfaces, strict=True)):
        place = {"position": [0.9 * number - 1.5, 0.7, 0], "rotation": [-110, 20, 10], "scale": 0.8}
        primitive |= {"type": "quad", "bsdf": surface, "transform": place}
    return scene


def in_haze() -> dict[str, Any]:
    """The room within a medium that only absorbs, through which some rays escape."""
    scene = changed("camera", medium="haze")
    scene["media"] = [{"name": "haze", "type": "homogeneous", "sigma_a": [0.1, 0.2, 0.3]}]
    return scene


def outdoors() -> dict[str, Any]:
    """The room without its lamp, under a sky with two suns."""
    scene = copy.deepcopy(ROOM)
    sun = {"type": "infinite_sphere_cap", "cap_angle": 3, "emission": 60}
    faint = {**sun, "cap_angle": 15, "emission": 2, "transform": {"rotation": [-30, 0, 40]}}
    scene["primitives"][-2:] = [{"type": "infinite_sphere", "emission": 0.5}, sun, faint]
    return scene


def under(*lights: dict[str, Any]) -> dict[str, Any]:
    """The room without its lamp, lit from around alone."""
    scene = copy.deepcopy(ROOM)
    scene["primitives"][-2:] = lights
    return scene


def lit_by_a_bowl() -> dict[str, Any]:
    """The room under a shining mesh, smooth, whose vertex normals differ much from those of its faces."""
    scene = copy.deepcopy(ROOM)
    scene["primitives"][-2:] = [
        {
            "type": "mesh",
            "file": "bowl.obj",
            "smooth": True,
            "bsdf": "red",
            "emission": "heights.png",
            "transform": {"position": [0, 1.2, 0]},
        }
    ]
    return scene


BOWL = """v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
v 0 0.5 0
vt 0 0
vt 1 0
vt 1 1
vn -0.6 -0.8 0
vn 0.6 -0.8 0
vn 0 1 0
f 1/1/1 2/2/2 5/3/3
f 2/1/2 3/2/2 5/3/3
f 3/1/2 4/2/1 5/3/3
f 4/1/1 1/2/1 5/3/3
"""

WALL = """v -2 0 -1
v 2 0 -1
v 2 2 -1
v -2 2 -1
vt -1.4 -0.6
vt 1.2 -0.6
vt 1.2 1.8
vt -1.4 1.8
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""


def glazed() -> dict[str, Any]:
    """The room with rough coats over metal and a mirror, and glass that reflects alone."""
    scene = copy.deepcopy(ROOM)
    scene["bsdfs"] += [
        {"name": "gold", "type": "conductor", "material": "Au"},
        {"name": "coat", "type": "rough_coat", "ior": 1.5, "roughness": 0.1, "substrate": "gold"},
        {"name": "varnish", "type": "rough_coat", "ior": 1.5, "roughness": 0.05, "substrate": "mirror"},
        {"name": "hard", "type": "dielectric", "ior": 1.5, "enable_refraction": False},
        {"name": "frosted", "type": "rough_dielectric", "roughness": 0.2, "enable_refraction": False},
    ]
    surfaces = ("coat", "varnish", "hard", "frosted")
    for primitive, surface in zip(scene["primitives"][1:5], surfaces, strict=True):
        primitive["bsdf"] = surface
    return scene


CASES = {
    "tent": ROOM,
    "coats and glass that reflects": glazed(),
    "bump, consistency checks": {
        **bumpy(),
        "integrator": {"type": "path_tracer", "max_bounces": 16, "enable_consistency_checks": True},
    },
    "bump on veils and a smooth mesh, consistency checks": bent_veils(),
    "bump beyond UV of 0 to 1": bump_below_0(),
    "metal and glass that are not turned": one_sided(),
    "camera in haze": in_haze(),
    "unsampled sun behind a sky": under(
        {"type": "infinite_sphere_cap", "cap_angle": 20, "emission": 9, "sample": False},
        {"type": "infinite_sphere", "emission": 0.5},
    ),
    "unsampled sky behind a sun": under(
        {"type": "infinite_sphere", "emission": 0.5, "sample": False},
        {"type": "infinite_sphere_cap", "cap_angle": 40, "emission": 2},
    ),
    "sun of a texture": under(
        {"type": "infinite_sphere", "emission": 0.1},
        {"type": "infinite_sphere_cap", "cap_angle": 20, "emission": "heights.png"},
    ),
    "smooth mesh that shines": lit_by_a_bowl(),
    "bump": bumpy(),
    "sky and suns": outdoors(),
    "sky map": under(
        {"type": "infinite_sphere", "emission": "heights.png", "transform": {"rotation": [20, 30, 0]}}
    ),
    "skydome": under({"type": "skydome", "transform": {"rotation": [30, 0, 20]}}),
    "skydome and sun": under(
        {"name": "sky", "type": "skydome", "transform": {"rotation": [30, 0, 20]}},
        {"type": "infinite_sphere_cap", "skydome": "sky", "cap_angle": 0.27, "emission": 2e4},
    ),
    **{
        name: changed("camera", reconstruction_filter=name)
        for name in ("dirac", "box", "gaussian", "mitchell_netravali", "catmull_rom", "lanczos")
    },
    "thinlens": changed("camera", type="thinlens", aperture_size=0.1, focus_distance=4.5),
    "blades": changed(
        "camera",
        type="thinlens",
        aperture_size=0.3,
        focus_distance=2,
        aperture={"type": "blade", "blades": 3, "angle": 0.2},
    ),
    "cat's eye": changed("camera", type="thinlens", aperture_size=0.3, focus_distance=4, cateye=0.2),
    "bounces": changed("integrator", min_bounces=2, max_bounces=4),
    "no light sampling": changed("integrator", enable_light_sampling=False),
    "consistency checks": changed("integrator", enable_consistency_checks=True),
    "fog": foggy(),
    "fog, no low orders": foggy(low_order_scattering=False),
    "fog, no surfaces": foggy(include_surfaces=False),
    "fog, no light sampling": foggy(enable_volume_light_sampling=False),
}


@pytest.mark.parametrize("name", CASES)
def test_same_picture_up_to_noise(name: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(CASES[name]))
    (tmp_path / "bowl.obj").write_text(BOWL)
    (tmp_path / "wall.obj").write_text(WALL)
    rows, columns = np.indices((24, 32))
    heights = 128 + 60 * (np.sin(columns * 6 * np.pi / 32) + np.cos(rows * 4 * np.pi / 24))
    write_heights(tmp_path / "heights.png", heights)
    write_heights(tmp_path / "coarse.png", np.random.default_rng(1).integers(0, 256, (3, 4)))
    subprocess.run([Path(str(BUILD)) / "tungsten", path.name], cwd=tmp_path, check=True, capture_output=True)
    theirs = read_buffers(tmp_path)
    ours = render(load_scene(path))
    for quantity in QUANTITIES:
        agree(getattr(ours, quantity), getattr(theirs, quantity), f"{name}: {quantity}")


def write_heights(path: Path, heights: np.ndarray) -> None:
    height, width = heights.shape
    image = OpenImageIO.ImageOutput.create(str(path))
    image.open(str(path), OpenImageIO.ImageSpec(width, height, 1, "uint8"))
    image.write_image(np.ascontiguousarray(heights[:, :, None], np.uint8))
    image.close()


def agree(ours: Buffer, theirs: Buffer, what: str) -> None:
    """Assert that the difference is noise of the variance that both claim.

    Over the pixels, its root mean square in standard deviations is about 1 (less where half floats round more
    than samples scatter), its mean is 0 within 5 standard deviations, and silhouettes apart no pixel stands
    out. The variances agree in the median; those of colour roughly, as lights are chosen otherwise.
    """
    assert ours.variance is not None
    assert theirs.variance is not None
    # A pixel that no sample was recorded for has a variance of 0 / 0 in Tungsten.
    known = np.isfinite(theirs.variance) & np.isfinite(theirs.mean)
    difference = (ours.mean - theirs.mean)[known].astype(np.float64)
    variance = (ours.variance + theirs.variance)[known].astype(np.float64)
    rounding = HALF_PRECISION * (np.abs(theirs.mean[known]) + 0.1)
    deviations = difference / np.sqrt(variance + rounding**2)
    assert (np.abs(deviations) > 5).mean() < 0.01, what
    noise_of_mean = np.sqrt(variance.sum() + (rounding**2).sum()) + 0.01 * rounding.sum()
    assert abs(difference[np.abs(deviations) < 5].sum()) < 5 * noise_of_mean, what
    assert np.sqrt((deviations[np.abs(deviations) < 5] ** 2).mean()) < 1.15, what
    noisy = known & (np.minimum(ours.variance, theirs.variance) > (10 * HALF_PRECISION) ** 2 * 0.1)
    if noisy.sum() > 100:
        tolerance = 0.5 if what.endswith("color") else 0.15
        assert np.median(ours.variance[noisy] / theirs.variance[noisy]) == pytest.approx(1, abs=tolerance), (
            what
        )
