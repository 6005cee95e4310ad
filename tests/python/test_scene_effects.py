"""What a scene calls for, on and off, and what is decided from it."""

import json
from pathlib import Path

import pytest

from tungsten_dip.scene import decision_of, effects_of, inspect_facts, inspect_text, load_scene

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
    assert decision_of(load({})).max_bounces == 64


@pytest.mark.parametrize("scene", EFFECTS["participating_media"][0])
def test_media_call_for_the_volume_integrator(load, scene):
    assert decision_of(load(scene)).integrator == "volpath"


@pytest.mark.parametrize("scene", EFFECTS["participating_media"][1])
def test_no_volume_integrator_without_media(load, scene):
    assert decision_of(load(scene)).integrator == "path"


def test_lens_samples_only_with_an_open_lens(load):
    assert decision_of(load(thinlens(aperture_size=0.1))).lens_samples
    assert not decision_of(load(thinlens(aperture_size=0))).lens_samples
    assert not decision_of(load({})).lens_samples


def test_environment_samples_only_with_an_environment(load):
    assert decision_of(load({"primitives": [{"type": "skydome"}]})).environment_samples
    assert not decision_of(load(cube(emission=1))).environment_samples


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
    decision = decision_of(load(scene))
    assert decision.features == ("albedo", "normal", "depth")
    assert decision.buffers == ("color", "albedo", "normal", "depth")


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
    assert decision.features == ("normal", "depth")
    assert decision.buffers == ("color", "normal", "depth")
    assert decision.reasons["albedo"] == "one colour on every surface"


def test_without_surfaces_only_the_sky_is_learned_from(load):
    assert decision_of(load({"primitives": [{"type": "skydome"}]})).features == ("albedo",)
    assert decision_of(load({})).features == ("albedo",)
    assert decision_of(load({"primitives": [LAMP]})).features == ()


def test_the_decision_is_json_and_has_a_reason_for_everything(load):
    decision = decision_of(load(two(GREY, RED)))
    facts = json.loads(json.dumps(decision.to_json()))
    assert facts["buffers"] == ["color", "albedo", "normal", "depth"]
    assert set(facts["reasons"]) == {
        *("integrator", "lens_samples", "environment_samples"),
        *("color", "albedo", "normal", "depth", "visibility"),
    }


def test_another_integrator_is_said_to_be_replaced(load):
    decision = decision_of(load({"integrator": {"type": "bidirectional_path_tracer"}}))
    assert "in place of bidirectional_path_tracer" in decision.reasons["integrator"]


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
    assert "volpath" in text
    facts = json.loads(json.dumps(inspect_facts(scene)))
    assert facts["effects"]["participating_media"] == ["fog (homogeneous)"]
    assert facts["decision"]["integrator"] == "volpath"
    assert (facts["width"], facts["height"], facts["spp"]) == (384, 216, 32)
