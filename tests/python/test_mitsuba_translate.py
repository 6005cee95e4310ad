"""The translator: all that it supports renders as Tungsten's formulas say, and the rest is refused."""

from __future__ import annotations

import json
import logging
import math
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

mitsuba = pytest.importorskip("mitsuba", reason="the embedded host needs the package mitsuba")

import OpenImageIO  # noqa: E402

from tungsten_dip.buffers.render_buffers import RenderBuffers  # noqa: E402
from tungsten_dip.errors import InputError  # noqa: E402
from tungsten_dip.hosts.mitsuba import textures  # noqa: E402
from tungsten_dip.hosts.mitsuba.curves import cubic_from_quadratic  # noqa: E402
from tungsten_dip.hosts.mitsuba.render import render as render_scene  # noqa: E402
from tungsten_dip.hosts.mitsuba.render import render_translated  # noqa: E402
from tungsten_dip.hosts.mitsuba.runtime import mitsuba_variant  # noqa: E402
from tungsten_dip.hosts.mitsuba.scene_builder import SceneBuilder  # noqa: E402
from tungsten_dip.hosts.mitsuba.sky import sky_pixels  # noqa: E402
from tungsten_dip.hosts.mitsuba.translate import translate  # noqa: E402
from tungsten_dip.scene.parse import load_scene  # noqa: E402
from tungsten_dip.scene.types import Skydome  # noqa: E402

Json = dict[str, Any]

WHITE_SKY = {"type": "infinite_sphere", "emission": 1.0}
WHITE = {"type": "lambert", "albedo": 1.0}
GREY = {"type": "lambert", "albedo": 0.5}
FLOOR = {"type": "quad", "transform": {"scale": [8, 1, 8]}, "bsdf": GREY}
LAMP = {
    "type": "quad",
    "transform": {"position": [0, 3, 0], "rotation": [0, 0, 180]},
    "emission": 5.0,
    "bsdf": {"type": "null"},
}


def ball(bsdf: Json | None = None, **fields: Any) -> Json:
    return {
        "type": "sphere",
        "transform": {"position": [0, 0.8, 0], "scale": 0.8},
        "bsdf": bsdf or GREY,
        **fields,
    }


def render(
    folder: Path,
    primitives: list[Json],
    camera: Json | None = None,
    media: list[Json] | None = None,
    spp: int = 4,
    resolution: tuple[int, int] = (16, 12),
    **sections: Any,
) -> Any:
    """Write the scene, translate it and return its buffers."""
    scene = {
        "primitives": primitives,
        "media": media or [],
        "camera": {
            "type": "pinhole",
            "fov": 45,
            "resolution": list(resolution),
            "reconstruction_filter": "box",
            "transform": {"position": [0, 1.2, 4.5], "look_at": [0, 0.7, 0], "up": [0, 1, 0]},
            **(camera or {}),
        },
        **sections,
    }
    path = folder / "scene.json"
    path.write_text(json.dumps(scene))
    with mitsuba_variant():
        return render_translated(translate(load_scene(path)), spp=spp, threads=1)


def write_image(path: Path, pixels: np.ndarray) -> None:
    height, width, channels = pixels.shape
    image = OpenImageIO.ImageOutput.create(str(path))
    kind = "uint8" if pixels.dtype == np.uint8 else "float"
    assert image.open(str(path), OpenImageIO.ImageSpec(width, height, channels, kind))
    assert image.write_image(np.ascontiguousarray(pixels))
    image.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    write_image(tmp_path / "colour.png", rng.integers(0, 256, (3, 5, 3), dtype=np.uint8))
    write_image(tmp_path / "alpha.png", rng.integers(0, 256, (3, 5, 4), dtype=np.uint8))
    write_image(tmp_path / "sky.hdr", rng.random((5, 8, 3)).astype(np.float32))
    (tmp_path / "mesh.obj").write_text("v -1 0 0\nv 1 0 0\nv 1 1 0\nv -1 1 0.3\nf 1 2 3\nf 1 3 4\n")
    strands = np.array([[x, y, 0.1 * y * y] for x in (-0.5, 0.0, 0.5) for y in (0, 0.4, 0.9, 1.5)], "<f4")
    header = struct.pack("<4sIIIIff3f88x", b"HAIR", 3, len(strands), 2, 3, 0.05, 0.0, 1.0, 1.0, 1.0)
    (tmp_path / "strands.hair").write_bytes(header + strands.tobytes())
    return tmp_path


BSDFS: dict[str, Json] = {
    "lambert": {"type": "lambert", "albedo": "colour.png"},
    "oren_nayar": {"type": "oren_nayar", "albedo": 0.8, "roughness": 0.7},
    "phong": {"type": "phong", "albedo": 0.8, "exponent": 32, "diffuse_ratio": 0.3},
    "mirror": {"type": "mirror", "albedo": [0.9, 0.8, 0.7]},
    "conductor": {"type": "conductor", "material": "Au"},
    "rough_conductor": {"type": "rough_conductor", "material": "AlSb", "roughness": 0.2},
    "rough_conductor, beckmann, texture": {
        "type": "rough_conductor",
        "eta": [1, 1, 1],
        "k": [2, 2, 2],
        "distribution": "beckmann",
        "roughness": "colour.png",
    },
    "dielectric": {"type": "dielectric", "ior": 1.5},
    "dielectric without refraction": {"type": "dielectric", "enable_refraction": False},
    "rough_dielectric": {"type": "rough_dielectric", "roughness": 0.2, "albedo": [0.9, 0.5, 0.9]},
    "rough_dielectric without refraction": {
        "type": "rough_dielectric",
        "albedo": [0.9, 0.8, 0.7],
        "distribution": "beckmann",
        "enable_refraction": False,
    },
    "plastic": {"type": "plastic", "albedo": 0.5, "sigma_a": [0.1, 0.2, 0.3]},
    "rough_plastic": {
        "type": "rough_plastic",
        "albedo": 0.5,
        "roughness": "colour.png",
        "distribution": "phong",
    },
    "smooth_coat": {"type": "smooth_coat", "sigma_a": 0.1},
    "smooth_coat over metal": {"type": "smooth_coat", "substrate": {"type": "conductor", "material": "Ag"}},
    "rough_coat": {"type": "rough_coat", "roughness": 0.1, "substrate": GREY},
    "thinsheet": {"type": "thinsheet", "sigma_a": 0.5},
    "thinsheet with interference": {"type": "thinsheet", "enable_interference": True, "thickness": 0.6},
    "diffuse_transmission": {"type": "diffuse_transmission", "albedo": 0.8},
    "transparency": {"type": "transparency", "alpha": "alpha.png", "base": GREY},
    "mixed": {"type": "mixed", "ratio": "colour.png", "bsdf0": GREY, "bsdf1": {"type": "rough_conductor"}},
    "mixed with plastic": {"type": "mixed", "albedo": 0.7, "bsdf0": {"type": "smooth_coat"}, "bsdf1": GREY},
    "mixed with a mirror": {"type": "mixed", "bsdf0": {"type": "mirror"}, "bsdf1": GREY},
    "mixed with glass": {"type": "mixed", "bsdf0": GREY, "bsdf1": {"type": "dielectric"}},
    "null": {"type": "null"},
    "forward": {"type": "forward"},
}

CURVES = {"type": "curves", "file": "strands.hair", "curve_thickness": 0.05}
TURNED = {"position": [0, 0.8, 0], "rotation": [30, 40, 20], "scale": [0.9, 0.5, 0.7]}
PRIMITIVES: dict[str, list[Json]] = {
    "quad": [{"type": "quad", "transform": TURNED, "bsdf": {"type": "lambert", "albedo": "colour.png"}}],
    "cube": [{"type": "cube", "transform": TURNED, "bsdf": GREY, "power": 3.0}],
    "sphere": [ball()],
    "disk": [{"type": "disk", "transform": TURNED, "bsdf": GREY, "emission": "colour.png"}],
    "cylinder": [{"type": "cylinder", "transform": TURNED, "bsdf": GREY, "emission": 1.0}],
    "open cylinder": [
        {
            "type": "cylinder",
            "capped": False,
            "transform": TURNED,
            "bsdf": {"type": "lambert", "albedo": "colour.png"},
        }
    ],
    "mesh": [{"type": "mesh", "file": "mesh.obj", "bsdf": [GREY, WHITE], "emission": 0.5}],
    "smooth mesh": [
        {"type": "mesh", "file": "mesh.obj", "smooth": True, "recompute_normals": True, "bsdf": GREY}
    ],
    "curves": [{**CURVES, "bsdf": GREY, "subsample": 0.3, "curve_taper": True}],
    "hair": [{**CURVES, "mode": "bcsdf_cylinder", "bsdf": {"type": "hair", "roughness": 0.3}}],
    "hair on half cylinders": [{**CURVES, "bsdf": {"type": "hair", "sigma_a": [0.5, 1, 2]}}],
    "skydome": [{"type": "skydome", "transform": {"rotation": [40, 30, 0]}}],
    "point": [{"type": "point", "transform": {"position": [1, 2, 1]}, "power": 9.0}],
    "infinite_sphere": [{"type": "infinite_sphere", "emission": "sky.hdr"}],
    "infinite_sphere_cap": [{"type": "infinite_sphere_cap", "power": 3.0, "cap_angle": 5}],
    "instances": [
        {
            "type": "instances",
            "masters": [{"type": "quad", "bsdf": GREY}],
            "instances": [{"id": 0, "transform": {"position": [1, 1, 0]}}],
        }
    ],
}

TEXTURES: dict[str, Json] = {
    "checker": {"type": "checker", "res_u": 3, "res_v": 2},
    "disk": {"type": "disk", "value": 0.8},
    "blade": {"type": "blade", "blades": 5, "value": [0.8, 0.6, 0.4]},
    "constant": {"type": "constant", "value": 0.3},
    "bitmap": {
        "type": "bitmap",
        "file": "colour.png",
        "interpolate": False,
        "clamp": True,
        "gamma_correct": False,
    },
}


@pytest.mark.parametrize("bsdf", BSDFS.values(), ids=BSDFS.keys())
def test_every_bsdf_renders(folder: Path, bsdf: Json) -> None:
    buffers = render(folder, [FLOOR, LAMP, ball(bsdf), WHITE_SKY])
    for _, buffer in buffers.quantities():
        assert np.isfinite(buffer.mean).all()
    assert buffers.color.mean.max() > 0.1


@pytest.mark.parametrize("primitives", PRIMITIVES.values(), ids=PRIMITIVES.keys())
def test_every_primitive_renders(folder: Path, primitives: list[Json]) -> None:
    buffers = render(folder, [FLOOR, *primitives])
    for _, buffer in buffers.quantities():
        assert np.isfinite(buffer.mean).all()
    assert buffers.color.mean.max() > 0.0


@pytest.mark.parametrize("texture", TEXTURES.values(), ids=TEXTURES.keys())
@pytest.mark.parametrize("shape", ["quad", "disk", "sphere"])
def test_every_texture_renders(folder: Path, texture: Json, shape: str) -> None:
    surface = {"type": shape, "transform": {"scale": 2}, "bsdf": {"type": "lambert", "albedo": texture}}
    buffers = render(folder, [surface, WHITE_SKY])
    assert np.isfinite(buffers.albedo.mean).all()
    assert buffers.albedo.mean.max() > 0.1


# --- Analytic oracles -------------------------------------------------------------------------------

CONSERVING: dict[str, Json] = {
    "lambert": WHITE,
    "mirror": {"type": "mirror"},
    "dielectric": {"type": "dielectric", "ior": 1.4},
    "plastic": {"type": "plastic", "albedo": 1.0, "ior": 1.6},
    "thinsheet": {"type": "thinsheet"},
    "forward": {"type": "forward"},
    "transparency": {"type": "transparency", "alpha": 0.3, "base": WHITE},
    "mixed": {
        "type": "mixed",
        "ratio": 0.3,
        "bsdf0": WHITE,
        "bsdf1": {"type": "phong", "exponent": 0, "diffuse_ratio": 1},
    },
    "coat": {"type": "smooth_coat", "ior": 1.0, "substrate": WHITE},
}


@pytest.mark.parametrize("bsdf", CONSERVING.values(), ids=CONSERVING.keys())
def test_white_furnace(folder: Path, bsdf: Json) -> None:
    closeup = {"transform": {"position": [0, 0.8, 3], "look_at": [0, 0.8, 0]}, "fov": 25}
    buffers = render(folder, [ball(bsdf), WHITE_SKY], closeup, spp=64)
    np.testing.assert_allclose(buffers.color.mean.mean(axis=(0, 1)), 1.0, rtol=0.02)


@pytest.mark.parametrize(
    "name", ["phong", "rough_conductor", "rough_dielectric", "rough_plastic", "rough_coat", "oren_nayar"]
)
def test_no_bsdf_makes_light(folder: Path, name: str) -> None:
    bsdf = {**BSDFS[name], "albedo": 1.0}
    buffers = render(folder, [ball(bsdf), WHITE_SKY], {"fov": 15}, spp=64)
    assert (buffers.color.mean.mean(axis=(0, 1)) < 1.02).all()


DOWN = {"transform": {"position": [2, 2, 0], "look_at": [0, 0, 0]}, "fov": 1}
LIT = [
    # Irradiance over pi at the origin of a floor, for radiance or power 2.
    pytest.param(
        {
            "type": "disk",
            "transform": {"position": [0, 1.5, 0], "scale": 0.5, "rotation": [180, 0, 0]},
            "emission": 2,
        },
        2 * 0.25 / (0.25 + 2.25),
        id="disk",
    ),
    pytest.param(
        {
            "type": "disk",
            "transform": {"position": [0, 1.5, 0], "scale": 0.5, "rotation": [180, 0, 0]},
            "power": 2,
        },
        2 / (math.pi**2 * 0.25) * 0.25 / (0.25 + 2.25),
        id="disk power",
    ),
    pytest.param(
        {"type": "sphere", "transform": {"position": [0, 1.5, 0], "scale": 0.5}, "emission": 2},
        2 * (0.5 / 1.5) ** 2,
        id="sphere",
    ),
    pytest.param(
        {"type": "sphere", "transform": {"position": [0, 1.5, 0], "scale": 0.5}, "power": 2},
        2 / (4 * math.pi**2 * 0.25) * (0.5 / 1.5) ** 2,
        id="sphere power",
    ),
    pytest.param(
        {"type": "point", "transform": {"position": [0, 1.5, 0]}, "emission": 2},
        2 / 1.5**2 / math.pi,
        id="point",
    ),
    pytest.param(
        {"type": "point", "transform": {"position": [0, 1.5, 0]}, "power": 2},
        2 / (4 * math.pi) / 1.5**2 / math.pi,
        id="point power",
    ),
    pytest.param({"type": "infinite_sphere", "emission": 2}, 2.0, id="sky"),
    pytest.param({"type": "infinite_sphere", "power": 2}, 2 / (4 * math.pi), id="sky power"),
    pytest.param(
        {"type": "infinite_sphere_cap", "cap_angle": 30, "emission": 2},
        2 * math.sin(math.radians(30)) ** 2,
        id="cap",
    ),
    pytest.param(
        {"type": "infinite_sphere_cap", "cap_angle": 30, "power": 2},
        2 / (2 * math.pi * (1 - math.cos(math.radians(30)))) * 0.25,
        id="cap power",
    ),
    pytest.param(
        {
            "type": "quad",
            "transform": {"position": [0, 3, 0], "scale": [1e-2, 1, 1e-2], "rotation": [0, 0, 180]},
            "power": 2,
        },
        2 / math.pi / 9 / math.pi,
        id="small quad power",
    ),
    pytest.param(
        {"type": "quad", "transform": {"position": [0, 3, 0]}, "emission": 2}, 0.0, id="back of a quad"
    ),
]


@pytest.mark.parametrize(("light", "irradiance_over_pi"), LIT)
def test_irradiance(folder: Path, light: Json, irradiance_over_pi: float) -> None:
    if light["type"] in ("disk", "sphere", "quad"):
        light = {**light, "bsdf": {"type": "null"}}
    buffers = render(folder, [FLOOR, light], DOWN, spp=64)
    expected = 0.5 * irradiance_over_pi
    np.testing.assert_allclose(buffers.color.mean.mean(), expected, rtol=0.02, atol=1e-7)


def lamps_of_all_kinds(at: float, scale: float) -> list[Json]:
    """Lamps that rays find, around the y axis and as far above the floor."""
    kinds = ("quad", "sphere", "cube", "disk", "mesh", "mesh")
    turns = np.linspace(0, 2 * math.pi, len(kinds), endpoint=False)
    return [
        {
            **({"type": "mesh", "file": "roof.obj"} if kind == "mesh" else {"type": kind}),
            "bsdf": {"type": "null"},
            "emission": 1.0 + 0.2 * number,
            "transform": {
                "position": [at * math.sin(turn), at, at * math.cos(turn)],
                "scale": scale,
                "rotation": [0, 30 * number, 160],
            },
        }
        for number, (kind, turn) in enumerate(zip(kinds, turns, strict=True))
    ]


def test_lamps_that_bring_little_light_bring_little_noise(folder: Path) -> None:
    """Each is sampled about as often as its light counts. Sampled alike, they had 30 times this variance."""
    (folder / "roof.obj").write_text(ROOF)
    far = [*lamps_of_all_kinds(at=40, scale=1), {"type": "point", "transform": {"position": [0, 40, 9]}}]
    far[-1]["emission"] = 1
    color = render(folder, [FLOOR, LAMP, *far], DOWN, spp=256).color
    assert 256 * color.variance.mean() < 0.2 * color.mean.mean() ** 2


def test_a_flattened_lamp_keeps_no_light_from_being_sampled(folder: Path) -> None:
    """Its normals are not finite."""
    lamp = {
        "type": "cylinder",
        "transform": {"position": [0, 0.5, 0], "scale": [1, 0, 1]},
        "emission": 1e-3,
        "bsdf": GREY,
    }
    integrators = [
        {"type": "path_tracer", "enable_light_sampling": samples_lights} for samples_lights in (True, False)
    ]
    sampled, found = (
        render(folder, [FLOOR, WHITE_SKY, lamp], spp=256, integrator=integrator) for integrator in integrators
    )
    np.testing.assert_allclose(sampled.color.mean.mean(), found.color.mean.mean(), rtol=0.01)


def test_texels_that_are_not_finite_are_dark_and_told(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    pixels = np.full((8, 16, 3), 0.5, np.float32)
    pixels[2, 3, 1] = np.nan
    pixels[4, 5, 0] = np.inf
    write_image(folder / "map.pfm", pixels)
    sky = {"type": "infinite_sphere", "emission": "map.pfm"}
    lit = render(folder, [FLOOR, sky], DOWN, spp=64).color.mean
    np.testing.assert_allclose(lit.mean(axis=(0, 1)), 0.25, rtol=0.05)
    assert f"{folder / 'map.pfm'}: 2 values are not finite, and taken for 0" in caplog.messages


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("R", "G", "B", "Z"), (0.1, 0.2, 0.3)),
        (("R", "G"), (0.1, 0.2, 0.0)),
        (("BY", "RY", "Y"), (0.3, 0.3, 0.3)),
        (("depth", "height", "Z"), None),
    ],
)
def test_an_exr_texture_has_the_channels_of_its_names(
    folder: Path, names: tuple[str, ...], expected: tuple[float, ...] | None
) -> None:
    spec = OpenImageIO.ImageSpec(8, 4, len(names), "float")
    spec.channelnames = names
    image = OpenImageIO.ImageOutput.create("map.exr")
    assert image.open(str(folder / "map.exr"), spec)
    values = dict(zip(names, (0.1, 0.2, 0.3, 9.0), strict=False))
    texel = np.array([values[name] for name in names], np.float32)
    assert image.write_image(np.ascontiguousarray(np.broadcast_to(texel, (4, 8, len(names)))))
    image.close()
    sky = {"type": "infinite_sphere", "emission": "map.exr"}
    if expected is None:
        with pytest.raises(InputError, match=r"map\.exr: expected a texture with channels R, G, B or Y, got"):
            render(folder, [FLOOR, sky], DOWN)
        return
    up = {"transform": {"position": [0, 1, 0], "look_at": [0, 2, 0], "up": [0, 0, 1]}, "fov": 4}
    np.testing.assert_allclose(render(folder, [sky], up).color.mean.mean(axis=(0, 1)), expected, rtol=1e-3)


def test_all_lights_around_a_scene_light_it_and_the_last_is_seen(folder: Path) -> None:
    sun = {"type": "infinite_sphere_cap", "cap_angle": 5, "emission": 40}
    other = {**sun, "cap_angle": 20, "emission": 3, "transform": {"rotation": [0, 0, 30]}}
    irradiance_over_pi = 1 + 40 * math.sin(math.radians(5)) ** 2
    irradiance_over_pi += 3 * math.sin(math.radians(20)) ** 2 * math.cos(math.radians(30))
    up = {"transform": {"position": [0, 1, 0], "look_at": [0, 2, 0], "up": [0, 0, 1]}, "fov": 4}
    down = {"transform": {"position": [0, 3, 0], "look_at": [0, 0, 0], "up": [0, 0, 1]}, "fov": 4}
    mirror = {**FLOOR, "bsdf": {"type": "mirror"}}
    for lights, seen in (
        ([WHITE_SKY, other, sun], 40),
        ([sun, WHITE_SKY, other], 1),
        ([other, sun, WHITE_SKY], 1),
    ):
        lit = render(folder, [FLOOR, *lights], DOWN, spp=64).color.mean
        np.testing.assert_allclose(lit.mean(), 0.5 * irradiance_over_pi, rtol=0.01)
        np.testing.assert_allclose(render(folder, lights, up).color.mean, seen, rtol=1e-4)
        np.testing.assert_allclose(render(folder, [mirror, *lights], down).color.mean, seen, rtol=1e-4)


@pytest.mark.parametrize(
    "kind", ["bitmap", "skydome", "cap", "together", "ball", "smooth mesh", "several lamps"]
)
def test_light_samples_change_no_mean(folder: Path, kind: str) -> None:
    """What paths find by themselves and what they are shown must be the same light."""
    pixels = np.full((8, 16, 3), 0.1, np.float32)
    pixels[1:3, 3:6] = [20.0, 10.0, 5.0]
    write_image(folder / "map.pfm", pixels)
    bitmap = {"type": "infinite_sphere", "emission": "map.pfm", "transform": {"rotation": [0, 50, 0]}}
    cap = {
        "type": "infinite_sphere_cap",
        "cap_angle": 25,
        "emission": 5,
        "transform": {"rotation": [0, 0, 40]},
    }
    lights: dict[str, list[Json]] = {
        "bitmap": [bitmap],
        "skydome": [{"type": "skydome", "transform": {"rotation": [40, 0, 0]}}],
        "cap": [cap],
        "together": [bitmap, WHITE_SKY],
        "ball": [{**ball(GREY), "emission": 3.0}],
        "smooth mesh": [{"type": "mesh", "file": "roof.obj", "smooth": True, "bsdf": GREY, "emission": 3.0}],
        "several lamps": [*lamps_of_all_kinds(at=1.5, scale=0.5), cap],
    }
    (folder / "roof.obj").write_text(ROOF)
    means = []
    for samples_lights in (True, False):
        integrator = {"type": "path_tracer", "enable_light_sampling": samples_lights}
        lit = render(folder, [FLOOR, *lights[kind]], DOWN, spp=2048, integrator=integrator)
        means.append(lit.color.mean.mean(axis=(0, 1)))
    if kind == "together":  # without light samples, what a ray sees is all that there is
        assert (means[0] > 1.5 * means[1]).all()
        return
    np.testing.assert_allclose(means[0], means[1], rtol=0.02)


def test_a_cap_has_the_one_colour_of_its_texture_at_the_origin_of_uv(folder: Path) -> None:
    rng = np.random.default_rng(3)
    pixels = rng.random((3, 4, 3)).astype(np.float32)
    write_image(folder / "sun.pfm", pixels)
    colours: list[tuple[Json | str, Any]] = [
        # Between the texels at all four corners of the image, which repeats.
        ("sun.pfm", pixels[[0, 0, -1, -1], [0, -1, 0, -1]].mean(axis=0)),
        ({"type": "bitmap", "file": "sun.pfm", "clamp": True, "scale": 2}, 2 * pixels[-1, 0]),
        ({"type": "bitmap", "file": "sun.pfm", "interpolate": False}, pixels[0, 0]),
        ({"type": "checker", "on_color": 3, "off_color": 2}, [2, 2, 2]),
        ({"type": "disk", "value": 2}, [0, 0, 0]),
        ({"type": "blade", "value": 2}, [2, 2, 2]),
    ]
    up = {"transform": {"position": [0, 1, 0], "look_at": [0, 2, 0], "up": [0, 0, 1]}, "fov": 4}
    for texture, colour in colours:
        sun = {"type": "infinite_sphere_cap", "cap_angle": 10, "emission": texture}
        seen = render(folder, [WHITE_SKY, sun], up).color.mean
        np.testing.assert_allclose(seen, np.broadcast_to(colour, seen.shape), rtol=1e-4)
        lit = render(folder, [FLOOR, sun], DOWN, spp=64).color.mean.mean(axis=(0, 1))
        expected = 0.5 * np.asarray(colour) * math.sin(math.radians(10)) ** 2
        np.testing.assert_allclose(lit, expected, rtol=0.02)


def test_a_sun_as_small_as_the_real_one_beside_a_sky(folder: Path) -> None:
    sun = {"type": "infinite_sphere_cap", "cap_angle": 0.27, "emission": 5e4}
    lit = render(folder, [FLOOR, WHITE_SKY, sun], DOWN, spp=64).color.mean
    expected = 0.5 * (1 + 5e4 * math.sin(math.radians(0.27)) ** 2)
    np.testing.assert_allclose(lit, expected, rtol=0.5)  # no fireflies
    np.testing.assert_allclose(lit.mean(), expected, rtol=0.02)


def test_a_mirrored_sphere_is_seen_from_without(folder: Path) -> None:
    mirrored = {"type": "sphere", "transform": {"scale": [-1, 1, 1]}, "bsdf": GREY, "emission": 2.0}
    view = {"position": [0, 0, 5], "look_at": [0, 0, 0], "up": [0, 1, 0]}
    buffers = render(folder, [mirrored], {"transform": view, "fov": 2})
    np.testing.assert_allclose(buffers.color.mean, 2.0, rtol=1e-5)
    np.testing.assert_allclose(buffers.normal.mean[:, :, 2], 1.0, atol=0.02)


@pytest.mark.parametrize("kind", ["quad", "cube", "mesh"])
@pytest.mark.parametrize("place", [{"scale": 1e-20}, {"scale": 1e-6, "position": [99, 99, 99]}])
def test_a_light_without_area_lights_nothing(kind: str, place: Json, folder: Path) -> None:
    light = {"type": kind, "bsdf": GREY, "emission": 1.0, "transform": place}
    files = {"file": "mesh.obj", "smooth": True} if kind == "mesh" else {}
    picture = render(folder, [FLOOR, {**light, **files}]).color.mean
    assert not picture.any()


def test_a_light_whose_area_is_beyond_floats_is_no_warning(folder: Path) -> None:
    render(folder, [{"type": "cube", "bsdf": GREY, "emission": 1.0, "transform": {"scale": 1e20}}])


def test_a_smooth_mesh_shines_on_the_side_of_its_faces(folder: Path) -> None:
    # The vertex normals point against the winding.
    (folder / "lamp.obj").write_text(
        "v -1 3 -1\nv 1 3 -1\nv 1 3 1\nv -1 3 1\nvn 0 1 0\nf 1//1 2//1 3//1\nf 1//1 3//1 4//1\n"
    )
    lamp = {"type": "mesh", "file": "lamp.obj", "emission": 5.0, "bsdf": {"type": "null"}}
    smooth, flat = (
        render(folder, [FLOOR, {**lamp, "smooth": smooth}], DOWN, spp=64).color.mean.mean()
        for smooth in (True, False)
    )
    assert flat > 0.1
    assert smooth == pytest.approx(flat, rel=0.02)


def test_a_flattened_mesh_has_the_normals_of_its_faces(folder: Path) -> None:
    wall = {"type": "mesh", "file": "mesh.obj", "smooth": True, "recompute_normals": True, "bsdf": GREY}
    flat = {**wall, "transform": {"scale": [1, 1, 0]}}
    seen = render(folder, [flat], {"fov": 2, "transform": {"position": [0, 0.5, 3], "look_at": [0, 0.5, 0]}})
    np.testing.assert_allclose(np.abs(seen.normal.mean), np.broadcast_to([0, 0, 1], (12, 16, 3)), atol=1e-6)


ROOF = """v -1 2 -1
v 1 2 -1
v 1 2 1
v -1 2 1
vn -0.6 0.8 0
vn 0.6 0.8 0
f 1//1 2//2 3//2
f 1//1 3//2 4//1
"""
"""A plate that shines downwards and bulges by its vertex normals alone, which point the other way."""


def test_a_smooth_mesh_that_shines_stays_smooth(folder: Path) -> None:
    (folder / "roof.obj").write_text(ROOF)
    roof = {"type": "mesh", "file": "roof.obj", "smooth": True, "bsdf": GREY}
    above = {"transform": {"position": [0, 9, 0], "look_at": [0, 2, 0], "up": [0, 0, 1]}, "fov": 10}
    dark, shining = (
        render(folder, [{**roof, "emission": emission}, FLOOR], above).normal.mean for emission in (0.0, 5.0)
    )
    assert np.ptp(dark[..., 0]) > 0.5
    np.testing.assert_array_equal(shining, dark)


@pytest.mark.parametrize(("name", "opaque"), [("colour.png", True), ("alpha.png", False), ("sky.hdr", False)])
def test_what_tungsten_decodes_to_four_channels_is_opaque(folder: Path, name: str, opaque: bool) -> None:
    veil = {"type": "transparency", "alpha": name, "base": {"type": "lambert", "albedo": 0.0}}
    sheet = {**FLOOR, "bsdf": veil, "transform": {"position": [0, 1, 0], "scale": [8, 1, 8]}}
    seen = render(folder, [sheet, WHITE_SKY], {**DOWN, "fov": 20}, spp=16).color.mean
    assert (seen.max() == 0) == opaque


DARK_LIGHTS: dict[str, Json] = {
    "skydome": {"type": "skydome", "intensity": 0.0},
    "cap of no angle": {"type": "infinite_sphere_cap", "power": 3.0, "cap_angle": 0.0},
    "point": {"type": "point", "emission": 0.0},
    "curves": {**CURVES, "bsdf": WHITE, "emission": 0.0, "transform": {"position": [0, 9, 0]}},
    "quad of no size": {"type": "quad", "bsdf": WHITE, "power": 0.0, "transform": {"scale": 0.0}},
}


@pytest.mark.parametrize("light", DARK_LIGHTS.values(), ids=DARK_LIGHTS.keys())
def test_without_lights_the_sky_is_white(folder: Path, light: Json) -> None:
    buffers = render(folder, [{**ball(WHITE), "emission": 0.0}, light], {"fov": 15})
    np.testing.assert_allclose(buffers.color.mean.mean(), 1.0, rtol=0.02)


@pytest.mark.parametrize("sun_is_sampled", [True, False])
def test_a_light_that_is_not_sampled_lights_nothing_where_a_later_one_hides_it(
    folder: Path, sun_is_sampled: bool
) -> None:
    sun = {"type": "infinite_sphere_cap", "cap_angle": 40, "emission": 3.0, "sample": sun_is_sampled}
    behind = math.sin(math.radians(40)) ** 2
    for lights, irradiance_over_pi in (
        ([{**WHITE_SKY, "sample": False}, sun], 1 - behind + 3 * behind),
        ([WHITE_SKY, sun], 1 + 3 * behind),
        ([sun, WHITE_SKY], 1 + (3 * behind if sun_is_sampled else 0)),
        ([sun], 3 * behind),
    ):
        lit = render(folder, [FLOOR, *lights], DOWN, spp=256).color.mean
        np.testing.assert_allclose(lit.mean(), 0.5 * irradiance_over_pi, rtol=0.02)


def test_what_escapes_within_endless_haze_is_not_seen(folder: Path) -> None:
    haze = {"name": "haze", "type": "homogeneous", "sigma_a": 0.1}
    buffers = render(folder, [ball(), WHITE_SKY], {"medium": "haze"}, [haze], spp=16)
    sky = buffers.depth.mean[..., 0] == 0
    assert 0 < sky.sum() < sky.size
    for _, buffer in buffers.quantities():
        np.testing.assert_array_equal(buffer.mean[sky], 0)
    assert buffers.albedo.mean[~sky].all()


def test_no_light_comes_through_endless_fog(folder: Path) -> None:
    fog = {"name": "fog", "type": "homogeneous", "sigma_s": 0.01}
    for camera, expected in (({"medium": "fog"}, 0.0), ({}, 0.5)):
        buffers = render(folder, [FLOOR, WHITE_SKY], camera, [fog], spp=64)
        assert buffers.color.mean[-1].mean() == pytest.approx(expected, abs=0.02)


def reflected(folder: Path, bsdf: Json, side: int, angle_deg: float = 0.0, **integrator: Any) -> float:
    """How much of a white sky a wall reflects on its front (1) or back (-1), seen at this angle."""
    wall = {"type": "quad", "transform": {"rotation": [side * 90, 0, 0], "scale": 3}, "bsdf": bsdf}
    angle = math.radians(angle_deg)
    eye = {"position": [2 * math.sin(angle), 0, 2 * math.cos(angle)], "look_at": [0, 0, 0]}
    path_tracer = {"type": "path_tracer", **integrator}
    seen = render(folder, [wall, WHITE_SKY], {"fov": 1, "transform": eye}, spp=64, integrator=path_tracer)
    return float(seen.color.mean.mean())


@pytest.mark.parametrize("kind", ["dielectric", "rough_dielectric"])
@pytest.mark.parametrize("turned", [True, False])
def test_glass_that_does_not_refract_reflects_on_both_sides(folder: Path, kind: str, turned: bool) -> None:
    glass = {"type": kind, "ior": 1.5, "roughness": 0.01, "enable_refraction": False, "albedo": 0.5}
    for side in (1, -1):
        seen = reflected(folder, glass, side, enable_two_sided_shading=turned)
        assert seen == pytest.approx(0.5 * 0.04, rel=0.01)
    # From within the glass, and beyond its critical angle.
    seen = reflected(folder, glass, -1, 60.0, enable_two_sided_shading=turned)
    assert seen == pytest.approx(0.5 * 0.0892 if turned else 0.5, rel=0.02)


@pytest.mark.parametrize("turned", [True, False])
def test_metal_reflects_more_than_it_gets_behind_it_unless_it_is_turned(folder: Path, turned: bool) -> None:
    metal = {"type": "conductor", "eta": [0.5, 0.5, 0.5], "k": [2, 2, 2], "albedo": 0.5}
    reflectance = (0.5**2 + 2**2) / (1.5**2 + 2**2)
    for side, expected in ((1, reflectance), (-1, reflectance if turned else 1 / reflectance)):
        seen = reflected(folder, metal, side, enable_two_sided_shading=turned)
        assert seen == pytest.approx(0.5 * expected, rel=1e-3)
    mirror = {"type": "mirror", "albedo": 0.5}
    assert reflected(folder, mirror, -1, enable_two_sided_shading=turned) == pytest.approx(0.5, rel=1e-5)


def test_a_bitmap_of_several_bsdfs_is_loaded_once(folder: Path) -> None:
    walls = [
        {"type": "quad", "bsdf": {"type": kind, "albedo": "colour.png"}}
        for kind in ("lambert", "plastic", "oren_nayar")
    ]
    path = folder / "scene.json"
    path.write_text(json.dumps({"primitives": walls, "camera": {"type": "pinhole", "resolution": [4, 4]}}))
    with mitsuba_variant():
        albedos = list(translate(load_scene(path)).albedo.values())
    assert len(albedos) == 3
    assert all(albedo is albedos[0] for albedo in albedos)


def rendered(folder: Path, *primitives: Json, **camera: Any) -> RenderBuffers:
    path = folder / "scene.json"
    camera = {"type": "pinhole", "resolution": [4, 4], **camera}
    path.write_text(json.dumps({"primitives": [*primitives, WHITE_SKY], "camera": camera}))
    return render_scene(load_scene(path), spp=1, threads=1)


def test_glass_that_does_not_bend_shows_what_is_behind(folder: Path) -> None:
    pane = {**FLOOR, "bsdf": {"type": "rough_dielectric", "ior": 1.0, "roughness": 0.01}}
    through, free = rendered(folder, pane), rendered(folder)
    np.testing.assert_allclose(through.color.mean, free.color.mean, rtol=0.05)
    assert through.color.mean.mean() == pytest.approx(free.color.mean.mean(), rel=0.01)


def test_matrices_rounded_by_hand(folder: Path) -> None:
    def picture(diagonal: float, cosine: float, skew: float) -> RenderBuffers:
        turned = [diagonal, 0, diagonal, -1, 0, 1, 0, 0.4, -diagonal, 0, diagonal, -1, 0, 0, 0, 1]
        wall = [cosine, 0.5, skew, 0, -0.5, cosine, 0, 0, 0, 0, 1.2, 0, 0, 0, 0, 1]
        return rendered(folder, {**FLOOR, "transform": wall}, transform=turned, resolution=[16, 16])

    rounded, exact = picture(0.707, 0.866, 0.001), picture(np.sqrt(0.5), np.sqrt(0.75), 0)
    for name in ("color", "normal", "depth"):
        of_rounded, of_exact = (getattr(buffers, name).mean for buffers in (rounded, exact))
        np.testing.assert_allclose(of_rounded, of_exact, rtol=0.01, atol=0.01)
    assert exact.depth is not None
    assert np.count_nonzero(exact.depth.mean) > 10


def test_a_sphere_without_one_axis_is_a_sphere(folder: Path) -> None:
    flat, whole = (
        rendered(
            folder, {"type": "sphere", "transform": {"scale": scale, "position": [0, 0, 6]}, "bsdf": GREY}
        )
        for scale in ([1, 0, 1], 1)
    )
    assert whole.depth is not None
    assert whole.depth.mean.any()
    np.testing.assert_array_equal(flat.depth.mean, whole.depth.mean)


def test_what_mitsuba_does_not_take_is_one_line(folder: Path) -> None:
    endless = {"type": "homogeneous", "phase_function": {"type": "henyey_greenstein", "g": 1}}
    with pytest.raises(InputError) as error:
        rendered(folder, {**FLOOR, "name": "pond", "ext_medium": endless})
    place, _, reason = str(error.value).partition(": Mitsuba cannot load this (")
    assert place == f'{folder}/scene.json: primitives[0] "pond", medium of type homogeneous'
    assert "asymmetry" in reason
    assert "\n" not in reason


def test_hair_without_absorption_makes_and_loses_no_light(folder: Path) -> None:
    hair = {"type": "hair", "roughness": 0.3, "sigma_a": 0.0}
    strands = {**CURVES, "curve_thickness": 0.3, "mode": "bcsdf_cylinder", "bsdf": hair}
    buffers = render(folder, [strands, WHITE_SKY], {"fov": 2}, spp=64)
    np.testing.assert_allclose(buffers.color.mean.mean(axis=(0, 1)), 1.0, rtol=0.03)


def test_a_segment_of_a_curve_stays_the_same_curve() -> None:
    points = np.random.default_rng(2).normal(size=(3, 5, 4))
    cubic = cubic_from_quadratic(*points)
    time = np.linspace(0.0, 1.0, 7)[:, None, None]
    p0, p1, p2 = points
    quadratic = 0.5 * ((1 - time) ** 2 * p0 + (1 + 2 * time - 2 * time**2) * p1 + time**2 * p2)
    weights = [
        (1 - time) ** 3,
        3 * time**3 - 6 * time**2 + 4,
        -3 * time**3 + 3 * time**2 + 3 * time + 1,
        time**3,
    ]
    evaluated = sum(weight * cubic[:, i] for i, weight in enumerate(weights)) / 6
    np.testing.assert_allclose(evaluated, quadratic, atol=1e-12)


def test_every_segment_of_every_curve_is_there(folder: Path) -> None:
    nodes = np.array([[x, y, 0.1 * y * y] for x in (-0.5, 0.0, 0.5) for y in (0, 0.4, 0.9, 1.5)])
    segments = np.concatenate([nodes[first : first + 3, None] for first in (0, 1, 4, 5, 8, 9)], axis=1)
    (strands,) = (shape for shape in loaded(folder, [{**CURVES, "bsdf": GREY}]).shapes())
    parameters = mitsuba.traverse(strands)
    np.testing.assert_array_equal(parameters["segment_indices"], np.arange(0, 24, 4))
    points = np.array(parameters["control_points"]).reshape(6, 4, 4)
    np.testing.assert_allclose(points[..., :3], cubic_from_quadratic(*segments), atol=1e-6)


def test_the_sky_has_the_spectrum_and_the_symmetry_of_the_model(folder: Path) -> None:
    path = folder / "scene.json"
    path.write_text(json.dumps({"primitives": [{"type": "skydome", "intensity": 3}, {"type": "skydome"}]}))
    bright, dim = load_scene(path).primitives
    assert isinstance(bright, Skydome)
    assert isinstance(dim, Skydome)
    with mitsuba_variant():
        pixels, half = (sky_pixels(SceneBuilder(load_scene(path)), sky) for sky in (bright, dim))
    np.testing.assert_allclose(pixels, 1.5 * half)
    np.testing.assert_allclose(pixels[:128], np.broadcast_to(pixels[:128, :1], (128, 512, 3)), rtol=1e-6)
    assert (pixels[64, 0, 2] > pixels[64, 0, 0]).all()  # blue
    assert not pixels[130:].any()


@pytest.mark.parametrize("kind", ["pinhole", "thinlens"])
def test_a_point_projects_where_tungsten_puts_it(folder: Path, kind: str) -> None:
    position, target = np.array([1.0, 2.0, 3.0]), np.array([0.2, 0.5, -1.0])
    up = np.array([0.3, 1.0, -0.2])
    point = np.array([0.9, 0.7, 0.4])
    width, height, fov = 60, 44, 50.0
    camera = {
        "type": kind,
        "fov": fov,
        "aperture_size": 1e-4,
        "transform": {"position": position.tolist(), "look_at": target.tolist(), "up": up.tolist()},
    }
    light = {
        "type": "sphere",
        "transform": {"position": point.tolist(), "scale": 0.1},
        "emission": 1.0,
        "bsdf": {"type": "null"},
    }
    color = render(folder, [light], camera, spp=16, resolution=(width, height)).color.mean[:, :, 0]

    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    local = np.array([right, np.cross(right, forward), forward]) @ (point - position)
    per_pixel = math.tan(math.radians(fov / 2)) * 2.0 / width
    expected = np.array([width / 2, height / 2]) + local[:2] * [1, -1] / local[2] / per_pixel
    if kind == "thinlens":
        expected = expected + 0.5  # its pixels are sampled about their upper left corner
    y, x = np.mgrid[:height, :width] + 0.5
    found = np.array([(x * color).sum(), (y * color).sum()]) / color.sum()
    np.testing.assert_allclose(found, expected, atol=0.15)


BLURRED = {"type": "thinlens", "fov": 60, "aperture_size": 0.5, "focus_distance": 1.5}


def blur(folder: Path, x: float, **lens: Any) -> np.ndarray:
    """Which of 64x64 pixels a small light on the horizon, out of focus, fills."""
    light = {
        "type": "sphere",
        "transform": {"position": [x, 0, 4], "scale": 0.08},
        "emission": 1e3,
        "bsdf": {"type": "null"},
    }
    view = {"position": [0, 0, 0], "look_at": [0, 0, 1], "up": [0, 1, 0]}
    camera = {**BLURRED, "reconstruction_filter": "box", "transform": view, **lens}
    color = render(folder, [light], camera, spp=1024, resolution=(64, 64)).color.mean[:, :, 0]
    filled: np.ndarray = color > 0.5 * np.median(color[color > 0])
    return filled


@pytest.mark.parametrize("blades", [3, 5])
def test_blades_bound_what_is_out_of_focus(folder: Path, blades: int) -> None:
    angle = 0.4
    disk = blur(folder, 0)
    polygon = blur(folder, 0, aperture={"type": "blade", "blades": blades, "angle": angle})
    area = blades / 2 * math.sin(2 * math.pi / blades) / math.pi
    assert polygon.sum() / disk.sum() == pytest.approx(area, rel=0.15)
    # Behind the plane in focus the picture of the lens is upright: x to the right, y up.
    row, column = np.nonzero(polygon)
    phi = np.arctan2(31.5 - row, column - 31.5)
    far = np.hypot(31.5 - row, column - 31.5) > 0.85 * math.sqrt(disk.sum() / math.pi)
    toward_corners = np.exp(1j * blades * (phi[far] - angle)).mean()
    assert toward_corners.real > 0.3
    assert abs(toward_corners.imag) < 0.25


def test_a_second_diaphragm_makes_cat_s_eyes(folder: Path) -> None:
    y, x = np.mgrid[-1:1:401j, -1:1:401j] * 0.5
    on_lens = x**2 + y**2 <= 0.5**2
    behind = 1.0 / math.tan(math.radians(30))
    for light in (0.0, 0.8):
        whole, cut = blur(folder, light), blur(folder, light, cateye=1.0)
        # Where the way from the light to a point of the lens goes on to.
        through = (x + (x - light) / 4 * behind) ** 2 + (y + y / 4 * behind) ** 2 <= 0.5**2
        assert cut.sum() / whole.sum() == pytest.approx(through[on_lens].mean(), rel=0.08)


def test_the_environment_is_where_tungsten_puts_it(folder: Path) -> None:
    height, width, row, column = 8, 16, 2, 5
    pixels = np.zeros((height, width, 3), np.float32)
    pixels[row, column] = [3.0, 2.0, 1.0]
    write_image(folder / "spot.pfm", pixels)
    phi = ((column + 0.5) / width - 0.5) * 2 * math.pi
    theta = (1 - (row + 0.5) / height) * math.pi
    direction = [math.cos(phi) * math.sin(theta), -math.cos(theta), math.sin(phi) * math.sin(theta)]
    camera = {"fov": 0.1, "transform": {"position": [0, 0, 0], "look_at": direction}}
    sky = {"type": "infinite_sphere", "emission": {"type": "bitmap", "file": "spot.pfm", "scale": 2}}
    buffers = render(folder, [sky], camera)
    np.testing.assert_allclose(buffers.color.mean.mean(axis=(0, 1)), [6.0, 4.0, 2.0], rtol=0.01)


def test_a_bitmap_lies_where_tungsten_puts_it(folder: Path) -> None:
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0, 1] = [255, 128, 20]
    write_image(folder / "corner.png", pixels)
    texture = {"type": "bitmap", "file": "corner.png", "interpolate": False}
    # From above with +z up in the picture u grows to the left and v upwards; row 0 of the image is at v = 1.
    camera = {"transform": {"position": [0, 2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1]}, "fov": 20}
    albedo = render(
        folder, [{"type": "quad", "bsdf": {"type": "lambert", "albedo": texture}}], camera, resolution=(4, 4)
    ).albedo.mean
    expected = np.zeros((4, 4, 3))
    expected[:2, :2] = np.floor(255 * (np.array([255, 128, 20]) / 255) ** 2.2) / 255
    np.testing.assert_allclose(albedo, expected, atol=1e-6)


@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_an_absorbing_medium_dims_by_beer_and_lambert(folder: Path, shape: str) -> None:
    gas = {"name": "gas", "type": "homogeneous", "sigma_a": [0.2, 0.5, 1.0], "density": 2.0}
    boundary = {"type": shape, "bsdf": {"type": "forward"}, "int_medium": "gas"}
    camera = {"transform": {"position": [0, 0, 5], "look_at": [0, 0, 0]}, "fov": 0.5}
    buffers = render(folder, [boundary, WHITE_SKY], camera, [gas], spp=256)
    thickness = 1.0 if shape == "cube" else 2.0
    expected = np.exp(-np.array([0.4, 1.0, 2.0]) * thickness)
    np.testing.assert_allclose(buffers.color.mean.mean(axis=(0, 1)), expected, rtol=0.02)


def test_two_sided_shading_can_be_switched_off(folder: Path) -> None:
    back = [{"type": "quad", "transform": {"rotation": [0, 0, 180]}, "bsdf": GREY}, WHITE_SKY]
    above = {"transform": {"position": [0, 2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1]}, "fov": 10}
    lit = render(folder, back, above, spp=64).color.mean
    black = render(
        folder, back, above, integrator={"type": "path_tracer", "enable_two_sided_shading": False}
    ).color.mean
    np.testing.assert_allclose(lit.mean(), 0.5, rtol=0.02)
    np.testing.assert_allclose(black, 0.0)


def test_a_path_tracer_stands_in_for_what_converges_to_the_same(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = folder / "scene.json"
    for kind, more in (
        ("bidirectional_path_tracer", {}),
        ("kelemen_mlt", {}),
        ("photon_map", {"include_surfaces": False, "low_order_scattering": False}),
    ):
        caplog.clear()
        integrator = {"type": kind, "max_bounces": 2, **more}
        path.write_text(json.dumps({"primitives": [FLOOR], "integrator": integrator}))
        with mitsuba_variant(), caplog.at_level(logging.INFO):
            translated = translate(load_scene(path))
        assert translated.integrator.kind == "path_tracer"
        assert translated.integrator.max_bounces == 2
        assert translated.integrator.include_surfaces == (not more)
        assert translated.integrator.low_order_scattering == (not more)
        assert f"a path_tracer renders in place of {kind}" in caplog.text


@pytest.mark.parametrize(
    ("integrator", "darker"),
    [
        ({"type": "bidirectional_path_tracer"}, True),
        ({"type": "reversible_jump_mlt"}, True),
        ({"type": "kelemen_mlt"}, True),
        ({"type": "kelemen_mlt", "bidirectional": False}, False),
        ({"type": "photon_map"}, False),
    ],
)
def test_integrators_that_tungsten_renders_darker_are_a_warning(
    folder: Path, caplog: pytest.LogCaptureFixture, integrator: dict[str, Any], darker: bool
) -> None:
    lamp = {"type": "quad", "bsdf": GREY, "emission": 1}
    path = folder / "scene.json"
    for primitives in ([FLOOR, WHITE_SKY], [FLOOR, WHITE_SKY, lamp]):
        caplog.clear()
        path.write_text(json.dumps({"primitives": primitives, "integrator": integrator}))
        with mitsuba_variant(), caplog.at_level(logging.INFO):
            translate(load_scene(path))
        assert caplog.text.count(f"in place of {integrator['type']}") == 1
        assert ("too dark" in caplog.text) == (darker and lamp in primitives)


def test_shared_objects_are_made_once(folder: Path) -> None:
    scene = {
        "bsdfs": [{"name": "grey", **GREY}],
        "primitives": [{"type": "quad", "bsdf": "grey"}, {"type": "cube", "bsdf": "grey"}, WHITE_SKY],
        "camera": {"type": "pinhole", "resolution": [4, 4]},
    }
    path = folder / "scene.json"
    path.write_text(json.dumps(scene))
    with mitsuba_variant():
        translated = translate(load_scene(path))
    assert list(translated.albedo) == [name for name in translated.scene if name.startswith("bsdf")]
    assert len(translated.albedo) == 1


def loaded(folder: Path, primitives: list[Json], **sections: Any) -> Any:
    """The scene as Mitsuba loads it, with Mitsuba's own integrator in place of ours."""
    path = folder / "scene.json"
    path.write_text(json.dumps({"primitives": primitives, **sections}))
    with mitsuba_variant() as mi:
        return mi.load_dict({**translate(load_scene(path)).scene, "integrator": {"type": "path"}})


@pytest.mark.parametrize("kind", ["constant", "bitmap", "cap of half the sky"])
def test_a_sky_weighs_its_irradiance_among_the_lights(folder: Path, kind: str) -> None:
    write_image(folder / "map.pfm", np.full((32, 64, 3), 2.0, np.float32))
    sky: Json = {"type": "infinite_sphere", "emission": "map.pfm" if kind == "bitmap" else 2}
    if kind == "cap of half the sky":
        sky = {"type": "infinite_sphere_cap", "cap_angle": 90, "emission": 2}
    (light,) = loaded(folder, [FLOOR, sky]).emitters()
    assert light.sampling_weight() == pytest.approx(2 * math.pi, rel=1e-3)


@pytest.mark.parametrize(("aperture_size", "samples_lens"), [(0.0, False), (0.1, True)])
def test_the_lens_is_sampled_only_where_it_is_open(
    folder: Path, aperture_size: float, samples_lens: bool
) -> None:
    camera = {"type": "thinlens", "aperture_size": aperture_size, "resolution": [4, 3]}
    sensor = loaded(folder, [FLOOR, WHITE_SKY], camera=camera).sensors()[0]
    assert sensor.needs_aperture_sample() == samples_lens


@pytest.mark.parametrize("kind", ["rough_conductor", "rough_dielectric"])
def test_no_texel_of_a_roughness_map_is_smoother_than_tungsten_allows(folder: Path, kind: str) -> None:
    write_image(folder / "smooth.png", np.zeros((2, 2, 3), np.uint8))
    smooth: list[Json | float | str] = [
        1e-3,
        0.0,
        "smooth.png",
        {"type": "checker", "on_color": 0, "off_color": 0},
        {"type": "disk", "value": 0},
    ]
    highlights = []
    for roughness in smooth:
        (quad,) = loaded(folder, [{"type": "quad", "bsdf": {"type": kind, "roughness": roughness}}]).shapes()
        hit = mitsuba.SurfaceInteraction3f()
        hit.uv, hit.wi = [0.5, 0.5], [0, 0, 1]
        highlights.append(quad.bsdf().eval(mitsuba.BSDFContext(), hit, [0, 0, 1])[0])
    assert highlights[0] > 0
    np.testing.assert_allclose(highlights, highlights[0], rtol=1e-4)


@pytest.mark.parametrize("used", [False, True])
def test_media_are_built_only_where_they_fill_something(folder: Path, used: bool) -> None:
    gas = {"name": "gas", "type": "homogeneous", "sigma_s": 1.0}
    box = {"type": "cube", "bsdf": {"type": "forward"}, **({"int_medium": "gas"} if used else {})}
    scene = loaded(folder, [FLOOR, box, WHITE_SKY], media=[gas])
    assert any(shape.is_medium_transition() for shape in scene.shapes()) == used


# --- Bump maps --------------------------------------------------------------------------------------

BUMPY = {**GREY, "bump": "colour.png"}
TEXEL_STEP = 4 / 255


def write_slope(folder: Path) -> None:
    """Write a height map that rises to the right, by the same step from texel to texel."""
    write_image(
        folder / "heights.png", np.tile(np.arange(0, 256, 4, dtype=np.uint8)[None, :, None], (8, 1, 3))
    )


@pytest.mark.parametrize(
    ("shape", "tangent"),
    [("quad", 8.0), ("cube", 1.0), ("mesh", 1.0)],
)
def test_height_map_turns_the_normal_by_differences_of_texels(
    shape: str, tangent: float, tmp_path: Path
) -> None:
    # A slope as high as the tangent is long turns the normal by 45 degrees away from a light overhead.
    write_slope(tmp_path)
    (tmp_path / "plate.obj").write_text(
        "v -4 0 -4\nv 4 0 -4\nv 4 0 4\nv -4 0 4\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "f 1/1 3/3 2/2\nf 1/1 4/4 3/3\n"
    )
    camera = {"transform": {"position": [1, 5, 0.01], "look_at": [1, 0, 0], "up": [0, 0, 1]}, "fov": 10}
    light = {"type": "point", "transform": {"position": [0, 9000, 0]}, "power": 1e8}
    height = tangent / (2 * TEXEL_STEP)
    # Beneath a bent normal light leaks into the cube, and out again.
    direct = {"type": "path_tracer", "max_bounces": 2}
    means = []
    for bump in ({"type": "checker"}, {"type": "bitmap", "file": "heights.png", "scale": height}):
        primitive = {
            "quad": {"type": "quad", "transform": {"scale": [8, 1, 8]}},
            "cube": {"type": "cube", "transform": {"scale": [8, 8, 8], "position": [0, -4, 0]}},
            "mesh": {"type": "mesh", "file": "plate.obj"},
        }[shape]
        thing = {**primitive, "bsdf": {**GREY, "bump": bump}}
        means.append(render(tmp_path, [thing, light], camera, integrator=direct).color.mean)
    assert means[0].min() > 0
    assert means[1] / means[0] == pytest.approx(math.sqrt(0.5), rel=1e-3)


@pytest.mark.parametrize("turn", [0, 180])
def test_height_map_bends_opposite_faces_of_a_cube_alike(turn: int, tmp_path: Path) -> None:
    # Heights rise along the cube's own z, so that normals lean towards -z on the faces of +y and -y.
    write_slope(tmp_path)
    camera = {"transform": {"position": [1, 5, 0.01], "look_at": [1, 0, 0], "up": [0, 0, 1]}, "fov": 10}
    direct = {"type": "path_tracer", "max_bounces": 2}
    bump = {"type": "bitmap", "file": "heights.png", "scale": 1 / (2 * TEXEL_STEP)}
    place = {"scale": [8, 8, 8], "position": [0, -4, 0], "rotation": [0, 0, turn]}
    cube = {"type": "cube", "transform": place, "bsdf": {**GREY, "bump": bump}}
    towards, away = (
        render(
            tmp_path,
            [cube, {"type": "point", "transform": {"position": [0, 9000, z]}, "power": 1e8}],
            camera,
            integrator=direct,
        ).color.mean
        for z in (-5000, 5000)
    )
    assert (towards > 2 * away).all()


def test_height_map_leaves_triangles_without_area_in_uv_flat(folder: Path) -> None:
    (folder / "plate.obj").write_text("v -4 0 -4\nv 4 0 -4\nv 4 0 4\nvt 0 0\nf 1/1 3/1 2/1\n")
    camera = {"transform": {"position": [1, 5, -1], "look_at": [1, 0, -1.01], "up": [0, 0, 1]}, "fov": 10}
    light = {"type": "point", "transform": {"position": [0, 9000, 0]}, "power": 1e8}
    plate = {"type": "mesh", "file": "plate.obj"}
    bumpy, flat = (
        render(folder, [{**plate, "bsdf": bsdf}, light], camera).color.mean for bsdf in (BUMPY, GREY)
    )
    assert flat.min() > 0
    assert bumpy == pytest.approx(flat, rel=1e-5)


@pytest.mark.parametrize("axis", [0, 1])
def test_height_map_left_of_its_first_texel_and_above_it_goes_on_as_behind_it(
    axis: int, tmp_path: Path
) -> None:
    """As in Tungsten: interpolation would flatten the first half texel, towards the last one's slope."""
    heights = np.array([0, 60, 60, 0], np.uint8)
    slope = 2 * 60 / 255  # of both the first and the second texel, per texel of 1 / 2
    rows = np.broadcast_to(heights[:, None, None], (4, 4, 3))
    write_image(tmp_path / "heights.png", np.ascontiguousarray(rows if axis else rows.swapaxes(0, 1)))
    near = (
        "vt 0 0.7\nvt 1 0.7\nvt 1 1.1\nvt 0 1.1\n" if axis else "vt -0.1 0\nvt 0.3 0\nvt 0.3 1\nvt -0.1 1\n"
    )
    (tmp_path / "plate.obj").write_text(
        f"v -4 0 -4\nv 4 0 -4\nv 4 0 4\nv -4 0 4\n{near}f 1/1 3/3 2/2\nf 1/1 4/4 3/3\n"
    )
    above = {"transform": {"position": [0, 9, 0.01], "look_at": [0, 0, 0]}, "fov": 40}
    light = {"type": "point", "transform": {"position": [0, 9000, 0]}, "power": 1e8}
    bump = {"type": "bitmap", "file": "heights.png", "scale": 2 / slope}
    flat, bent = (
        render(tmp_path, [{"type": "mesh", "file": "plate.obj", "bsdf": bsdf}, light], above).color.mean
        for bsdf in (GREY, {**GREY, "bump": bump})
    )
    np.testing.assert_allclose(bent, math.sqrt(0.5) * flat, rtol=1e-3)


def test_bent_surfaces_let_light_straight_through_whatever_is_consistent(folder: Path) -> None:
    write_slope(folder)
    bump = {"type": "bitmap", "file": "heights.png", "scale": 1000}
    box = {"type": "cube", "transform": {"position": [0, 0.8, 0]}, "bsdf": {"type": "forward", "bump": bump}}
    checks = {"type": "path_tracer", "enable_consistency_checks": True}
    seen = render(folder, [box, WHITE_SKY], {"fov": 15}, integrator=checks)
    np.testing.assert_allclose(seen.color.mean, 1.0, rtol=1e-6)


def test_the_shadow_of_a_bent_film_is_that_of_its_slope(folder: Path) -> None:
    write_slope(folder)
    bump = {"type": "bitmap", "file": "heights.png", "scale": 8 / (2 * TEXEL_STEP)}
    light = {"type": "point", "transform": {"position": [0, 9000, 0]}, "power": 1e8}
    film = {"type": "quad", "transform": {"position": [-1.5, 1, 0], "scale": [8, 1, 8]}}
    floor = {"transform": {"position": [0, 0.5, 1], "look_at": [0, 0, 0]}, "fov": 1}
    direct = {"type": "path_tracer", "max_bounces": 3}
    free, flat, bent = (
        render(folder, [FLOOR, *films, light], floor, integrator=direct).color.mean.mean()
        for films in (
            [],
            [{**film, "bsdf": {"type": "thinsheet"}}],
            [{**film, "bsdf": {"type": "thinsheet", "bump": bump}}],
        )
    )
    through = {}
    for angle in (0.0, math.pi / 4):
        cos_i, cos_t = math.cos(angle), math.sqrt(1 - (math.sin(angle) / 1.5) ** 2)
        r_s = ((cos_i - 1.5 * cos_t) / (cos_i + 1.5 * cos_t)) ** 2
        r_p = ((cos_t - 1.5 * cos_i) / (cos_t + 1.5 * cos_i)) ** 2
        through[angle] = 0.5 * ((1 - r_s) / (1 + r_s) + (1 - r_p) / (1 + r_p))
    assert flat / free == pytest.approx(through[0.0], rel=1e-3)
    assert bent / free == pytest.approx(through[math.pi / 4], rel=1e-3)


def test_a_smooth_mesh_with_a_height_map_is_checked_by_its_bent_normals(folder: Path) -> None:
    # The vertex normals lean away from the light, by 60 degrees; the slope turns them back, to 15.
    (folder / "plate.obj").write_text(
        "v -4 0 -4\nv 4 0 -4\nv 4 0 4\nv -4 0 4\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "vn -0.866025 0.5 0\nf 1/1/1 3/3/1 2/2/1\nf 1/1/1 4/4/1 3/3/1\n"
    )
    write_slope(folder)
    bump = {"type": "bitmap", "file": "heights.png", "scale": 0.5 / (2 * TEXEL_STEP)}
    plate = {"type": "mesh", "file": "plate.obj", "smooth": True, "bsdf": {**GREY, "bump": bump}}
    above = {"transform": {"position": [0, 5, 0.01], "look_at": [0, 0, 0]}, "fov": 10}
    light = {"type": "point", "transform": {"position": [9000, 9000, 0]}, "power": 1e9}
    intensity_over_distance2 = 1e9 / (4 * math.pi) / (2 * 9000**2)
    for checks in (False, True):
        integrator = {"type": "path_tracer", "enable_consistency_checks": checks}
        lit = render(folder, [plate, light], above, integrator=integrator).color.mean
        expected = 0.5 / math.pi * intensity_over_distance2 * math.cos(math.radians(60))
        np.testing.assert_allclose(lit, expected, rtol=0.01)


# --- Refusals ---------------------------------------------------------------------------------------


def surface(bsdf: Json, **fields: Any) -> Json:
    return {"primitives": [{"name": "thing", "type": "quad", "bsdf": bsdf, **fields}]}


def with_camera(**fields: Any) -> Json:
    return {"primitives": [FLOOR], "camera": {"resolution": [8, 8], **fields}}


def with_medium(**fields: Any) -> Json:
    gas = {"name": "gas", "type": "homogeneous", "sigma_s": 1.0, **fields}
    return {
        "media": [gas],
        "primitives": [{"type": "cube", "bsdf": {"type": "forward"}, "int_medium": "gas"}],
    }


SHEARED = [1, 0, 0.5, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]

REFUSED: dict[str, Json] = {
    "lambertian_fiber": surface({"type": "lambertian_fiber"}),
    "rough_wire": surface({"type": "rough_wire"}),
    "distribution phong": surface({"type": "rough_conductor", "distribution": "phong"}),
    "bump mapping of another shape": {"primitives": [{"type": "sphere", "bsdf": BUMPY}]},
    "texture of type ies": surface({"type": "lambert", "albedo": {"type": "ies", "file": "colour.png"}}),
    "smooth_coat over a BSDF that transmits": surface(
        {"type": "smooth_coat", "substrate": {"type": "dielectric"}}
    ),
    "transparency over a BSDF that lets light through": surface(
        {"type": "transparency", "alpha": 0.5, "base": {"type": "thinsheet"}}
    ),
    "mixed BSDF of a thinsheet": surface({"type": "mixed", "bsdf0": {"type": "thinsheet"}, "bsdf1": GREY}),
    "two smooth layers": surface(
        {"type": "mixed", "bsdf0": {"type": "plastic"}, "bsdf1": {"type": "plastic"}}
    ),
    "sheared transform": {"primitives": [{"type": "cube", "transform": SHEARED}]},
    "sheared quad": surface(GREY, transform=SHEARED),
    "cone_angle": {"primitives": [{"type": "disk", "emission": 1.0, "cone_angle": 30}]},
    "cylinder without caps": {"primitives": [{"type": "cylinder", "emission": 1.0, "capped": False}]},
    "texture on a cylinder": {
        "primitives": [{"type": "cylinder", "bsdf": {"type": "lambert", "albedo": "colour.png"}}]
    },
    "shining sphere with a texture": {"primitives": [ball(emission="colour.png")]},
    "point light with a texture": {"primitives": [{"type": "point", "emission": "colour.png"}]},
    "infinite_sphere with a texture": {
        "primitives": [{"type": "infinite_sphere", "emission": {"type": "checker"}}]
    },
    "sun is below the horizon": {"primitives": [{"type": "skydome", "transform": {"rotation": [120, 0, 0]}}]},
    "skydome of temperature": {"primitives": [{"type": "skydome", "temperature": 20}]},
    "skydome of turbidity": {"primitives": [{"type": "skydome", "turbidity": 11}]},
    "curves of mode ribbon": {"primitives": [{**CURVES, "mode": "ribbon"}]},
    "lambert on curves": {"primitives": [{**CURVES, "mode": "bcsdf_cylinder", "bsdf": GREY}]},
    "curves with a medium": {"primitives": [{**CURVES, "bsdf": GREY, "int_medium": {"type": "homogeneous"}}]},
    "shining curves": {"primitives": [{**CURVES, "emission": 1.0}]},
    "texture on curves": {"primitives": [{**CURVES, "bsdf": {"type": "lambert", "albedo": "colour.png"}}]},
    "file of instances": {"primitives": [{"type": "instances", "masters": [FLOOR], "instances": "many.bin"}]},
    "instances within instances": {
        "primitives": [{"type": "instances", "masters": [{"type": "instances", "masters": [FLOOR]}]}]
    },
    "cubemap": with_camera(type="cubemap"),
    "equirectangular": with_camera(type="equirectangular"),
    "aperture of type checker": with_camera(type="thinlens", aperture={"type": "checker"}),
    "scale in its transform": with_camera(type="pinhole", transform={"scale": 2}),
    "medium of type exponential": with_medium(type="exponential"),
    "medium of type atmosphere": with_medium(type="atmosphere"),
    "transmittance of type linear": with_medium(transmittance={"type": "linear"}),
    "fewer bounces": with_medium(max_bounces=3),
    "light_tracer": {"primitives": [FLOOR], "integrator": {"type": "light_tracer"}},
}


@pytest.mark.parametrize(("construct", "scene"), REFUSED.items(), ids=REFUSED.keys())
def test_what_has_no_counterpart_is_refused(folder: Path, construct: str, scene: Json) -> None:
    path = folder / "scene.json"
    (folder / "many.bin").write_bytes(b"")
    path.write_text(json.dumps({"camera": {"type": "pinhole", "resolution": [8, 8]}, **scene}))
    with mitsuba_variant(), pytest.raises(InputError) as error:
        translate(load_scene(path))
    message = str(error.value)
    assert construct in message
    assert "--host tungsten" in message
    assert str(path) in message
    assert "\n" not in message


def test_a_broken_image_is_one_line_that_names_it(folder: Path) -> None:
    (folder / "broken.png").write_bytes((folder / "colour.png").read_bytes()[:40])
    with pytest.raises(InputError, match=r"broken\.png") as error:
        render(folder, [{"type": "quad", "bsdf": {"type": "lambert", "albedo": "broken.png"}}])
    assert "\n" not in str(error.value)


def test_a_texture_whose_name_is_no_text_is_one_line(folder: Path) -> None:
    texture = os.fsdecode(b"bad\xff.png")
    (folder / "colour.png").rename(folder / texture)
    with pytest.raises(InputError, match=r"bad\udcff\.png: expected a name in UTF-8; rename it"):
        render(folder, [{"type": "quad", "bsdf": {"type": "lambert", "albedo": texture}}])


def test_an_image_too_large_for_memory_is_one_line_that_names_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = {"type": "quad", "bsdf": {"type": "lambert", "albedo": "colour.png"}}
    monkeypatch.setattr(textures, "MAX_PIXELS", 12)
    render(folder, [wall])
    monkeypatch.setattr(textures, "MAX_PIXELS", 11)
    with pytest.raises(InputError, match=r"colour\.png: [^\n]* at most 11 pixels [^\n]* 5 x 3 in 3; [^\n]*$"):
        render(folder, [wall])


def test_what_is_approximated_is_told(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = folder / "scene.json"
    scene = surface({"name": "varnish", "type": "mixed", "bsdf0": {"type": "mirror"}, "bsdf1": GREY})
    path.write_text(json.dumps({"camera": {"type": "pinhole", "resolution": [8, 8]}, **scene}))
    with mitsuba_variant():
        translate(load_scene(path))
    assert len(caplog.messages) == 1
    for part in (str(path), 'bsdf "varnish"', "(mirror)", "--host tungsten"):
        assert part in caplog.messages[0]


def test_a_mixed_bsdf_may_be_all_that_a_scene_has(tmp_path: Path) -> None:
    mixed = {"type": "mixed", "bsdf0": {"type": "mirror"}, "bsdf1": GREY}
    quad = {"type": "quad", "bsdf": mixed}
    scene = loaded(tmp_path, [quad], integrator={"type": "path_tracer", "enable_two_sided_shading": False})
    assert len(scene.shapes()) == 1
