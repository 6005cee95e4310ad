"""What a scene calls for, on and off, and what is decided from it."""

import json
import re
from pathlib import Path

import pytest

from tungsten_dip.scene.effects import decision_of, effects_of, inspect_facts, inspect_text
from tungsten_dip.scene.parse import load_scene

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def load(tmp_path):
    """``load(scene)``: write JSON beside a few files that scenes name, and read it."""
    for name in ("m.wo3", "c.fiber", "p.png"):
        (tmp_path / name).touch()

    def read(scene):
        (tmp_path / "scene.json").write_text(json.dumps(scene))
        return load_scene(tmp_path / "scene.json")

    return read


def cube(**fields):
    return {"primitives": [{"type": "cube", **fields}]}


def with_bsdf(kind, **fields):
    return cube(bsdf={"type": kind, **fields})


def thinlens(**fields):
    return {"camera": {"type": "thinlens", **fields}}


def filled_with(**fields):
    return cube(int_medium={"type": "homogeneous", **fields})


LAMBERT = {"type": "lambert"}
LAMP = {"type": "point", "power": 1}

# Effect, scenes that call for it, scenes that look much like it and do not.
EFFECTS = {
    "depth_of_field": (
        [thinlens(), thinlens(aperture_size=0.1)],
        [{"camera": {"type": "pinhole"}}, thinlens(aperture_size=0), {}],
    ),
    "glossy_reflection": (
        [
            with_bsdf(kind)
            for kind in ("phong", "rough_conductor", "rough_plastic", "rough_dielectric", "rough_coat")
        ]
        + [with_bsdf("mixed", bsdf0=LAMBERT, bsdf1={"type": "rough_conductor"}), with_bsdf("smooth_coat")],
        [with_bsdf("lambert"), with_bsdf("mirror"), {"bsdfs": [{"type": "phong"}]}],
    ),
    "specular_transport": (
        [
            with_bsdf(kind)
            for kind in ("mirror", "conductor", "dielectric", "plastic", "smooth_coat", "thinsheet")
        ]
        + [with_bsdf("transparency", base={"type": "mirror"})],
        [with_bsdf("lambert"), with_bsdf("rough_conductor"), {"bsdfs": [{"type": "mirror"}]}],
    ),
    "transmission": (
        [with_bsdf(kind) for kind in ("dielectric", "rough_dielectric", "diffuse_transmission")],
        [with_bsdf("dielectric", enable_refraction=False), with_bsdf("mirror"), with_bsdf("forward")],
    ),
    "transparency": (
        [
            with_bsdf("transparency", alpha=0.5),
            with_bsdf("transparency", alpha="p.png"),
            with_bsdf("forward"),
        ],
        [with_bsdf("transparency"), with_bsdf("dielectric"), with_bsdf("null")],
    ),
    "participating_media": (
        [
            filled_with(sigma_s=1),
            filled_with(sigma_a=[0, 0, 0.1]),
            {"camera": {"type": "pinhole", "medium": {"type": "homogeneous", "sigma_s": 1}}},
            cube(ext_medium={"type": "exponential", "sigma_s": 1}),
        ],
        [
            filled_with(),
            filled_with(sigma_s=1, density=0),
            {"media": [{"type": "homogeneous", "sigma_s": 1}]},
            cube(),
        ],
    ),
    "hair": (
        [{"primitives": [{"type": "curves", "file": "c.fiber"}]}],
        [with_bsdf("hair")],
    ),
    "textures": (
        [
            with_bsdf("lambert", albedo="p.png"),
            with_bsdf("lambert", albedo={"type": "checker"}),
            with_bsdf("rough_plastic", roughness="p.png"),
            with_bsdf("smooth_coat", substrate={"type": "lambert", "bump": "p.png"}),
            cube(emission="p.png"),
        ],
        [
            with_bsdf("lambert", albedo=[0.1, 0.2, 0.3]),
            with_bsdf("lambert", albedo={"type": "checker", "on_color": 0.5, "off_color": 0.5}),
            {"bsdfs": [{"type": "lambert", "albedo": "p.png"}]},
            thinlens(aperture={"type": "blade"}),
        ],
    ),
    "environment_light": (
        [
            {"primitives": [{"type": "infinite_sphere", "emission": 1}]},
            {"primitives": [{"type": "infinite_sphere_cap", "power": 1}]},
            {"primitives": [{"type": "skydome"}]},
            # Where nothing shines, Tungsten adds a white sky.
            {},
            cube(emission=0),
            {"primitives": [{"type": "infinite_sphere", "emission": 0}]},
            {"primitives": [{"type": "instances", "masters": [{"type": "cube", "emission": 1}]}]},
        ],
        [
            {"primitives": [{"type": "infinite_sphere", "emission": 0}, LAMP]},
            {"primitives": [{"type": "infinite_sphere"}, LAMP]},
            {"primitives": [{"type": "skydome", "intensity": 0}, LAMP]},
            {"primitives": [LAMP]},
            cube(emission=1),
        ],
    ),
}


@pytest.mark.parametrize("effect", EFFECTS)
def test_every_effect_is_found_where_it_is_and_nowhere_else(load, effect):
    on, off = EFFECTS[effect]
    for scene in on:
        assert getattr(effects_of(load(scene)), effect), scene
    for scene in off:
        assert getattr(effects_of(load(scene)), effect) == (), scene


def test_a_scene_of_nothing_but_a_lamp_calls_for_nothing(load):
    effects = effects_of(load({"primitives": [LAMP]}))
    assert all(getattr(effects, effect) == () for effect in EFFECTS)


def test_effects_name_what_calls_for_them(load):
    scene = load({"bsdfs": [{"name": "pane", "type": "dielectric"}], **cube(bsdf="pane")})
    assert effects_of(scene).transmission == ("pane (dielectric)",)
    assert effects_of(load(with_bsdf("dielectric"))).transmission == ("dielectric",)


def test_masters_of_instances_count(load):
    masters = [{"type": "cube", "bsdf": {"type": "dielectric"}}]
    assert effects_of(load({"primitives": [{"type": "instances", "masters": masters}]})).transmission


def test_bounces_come_from_the_integrator(load):
    assert effects_of(load({"integrator": {"type": "path_tracer", "max_bounces": 3}})).max_bounces == 3
    assert effects_of(load({})).max_bounces == 64


def two(first, second, **fields):
    return {"primitives": [{"type": "cube", "bsdf": first}, {"type": "sphere", "bsdf": second, **fields}]}


GREY, RED = {"type": "lambert", "albedo": 0.5}, {"type": "lambert", "albedo": [0.8, 0.1, 0.1]}


@pytest.mark.parametrize(
    "scene",
    [
        two(GREY, RED),
        two(GREY, GREY, emission=1),
        two(GREY, {"type": "lambert", "albedo": "p.png"}),
        {"primitives": [*two(GREY, GREY)["primitives"], {"type": "skydome"}]},
        two(GREY, GREY),  # under Tungsten's white sky
        two(GREY, {"type": "transparency", "base": RED}),
        {"primitives": [{"type": "mesh", "file": "m.wo3", "bsdf": [GREY, RED]}]},
    ],
)
def test_albedo_that_varies_is_asked_for(load, scene):
    assert decision_of(load(scene)).buffers == ("color", "albedo", "normal", "depth")


@pytest.mark.parametrize(
    "other",
    [
        GREY,
        {"type": "oren_nayar", "albedo": 0.5},
        # Mirrors and glass show what is behind them; Tungsten writes no albedo of theirs.
        {"type": "mirror", "albedo": 0.9},
        {"type": "transparency", "albedo": 0.3, "base": GREY},
    ],
)
def test_albedo_of_one_colour_is_left_out(load, other):
    decision = decision_of(load({"primitives": [*two(GREY, other)["primitives"], LAMP]}))
    assert decision.buffers == ("color", "normal", "depth")
    assert decision.reasons["albedo"] == "one colour on every surface"


def test_without_surfaces_only_the_sky_is_learned_from(load):
    assert decision_of(load({"primitives": [{"type": "skydome"}]})).buffers == ("color", "albedo")
    assert decision_of(load({})).buffers == ("color", "albedo")
    assert decision_of(load({"primitives": [LAMP]})).buffers == ("color",)


@pytest.mark.parametrize("scene", [two(GREY, RED), {"primitives": [LAMP]}])
def test_every_buffer_is_decided_on_with_a_reason(load, scene):
    assert list(decision_of(load(scene)).reasons) == ["color", "albedo", "normal", "depth", "visibility"]


def test_inspect_says_what_becomes_of_another_integrator(load):
    assert "path_tracer" not in inspect_text(load({}))
    text = inspect_text(load({"integrator": {"type": "bidirectional_path_tracer"}}))
    assert "bidirectional_path_tracer: Tungsten writes only colour" in text


@pytest.mark.parametrize(
    ("example", "expected"),
    [
        ("cornell-box", {"glossy_reflection", "specular_transport"}),
        (
            "glass",
            {
                *("depth_of_field", "glossy_reflection", "specular_transport", "transmission"),
                *("textures", "environment_light"),
            },
        ),
        ("fog", {"transparency", "participating_media", "environment_light"}),
        (
            "textures",
            {"glossy_reflection", "specular_transport", "transparency", "textures", "environment_light"},
        ),
    ],
)
def test_examples(example, expected):
    effects = effects_of(load_scene(EXAMPLES / example / "scene.json"))
    assert {effect for effect in EFFECTS if getattr(effects, effect)} == expected


def test_inspect_says_it_all():
    scene = load_scene(EXAMPLES / "fog" / "scene.json")
    text = inspect_text(scene)
    assert "384 x 216 pixels" in text
    assert "participating media  fog (homogeneous)" in text
    assert re.search("albedo +learned from +distinguishes surfaces", text)
    assert re.search("visibility +left out +one random", text)
    facts = json.loads(json.dumps(inspect_facts(scene)))
    assert facts["effects"]["participating_media"] == ["fog (homogeneous)"]
    assert facts["decision"]["buffers"] == ["color", "albedo", "normal", "depth"]
    assert (facts["width"], facts["height"], facts["spp"]) == (384, 216, 32)
