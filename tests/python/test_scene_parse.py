"""Scene files: every type, every way to be wrong, and Tungsten's conventions."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from tungsten_dip.errors import InputError
from tungsten_dip.scene import types as t
from tungsten_dip.scene.parse import load_camera, load_scene

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*/scene.json"))


@pytest.fixture
def load(tmp_path):
    """``load(scene)``: write JSON (an object, or text) beside a few files that scenes name, and read it."""
    for name in ("m.wo3", "c.fiber", "p.png", "l.ies", "g.vdb", "i.bin"):
        (tmp_path / name).touch()

    def read(scene):
        path = tmp_path / "scene.json"
        path.write_text(scene if isinstance(scene, str) else json.dumps(scene), encoding="utf-8")
        return load_scene(path)

    return read


@pytest.fixture
def refused(load):
    """``refused(scene)``: the one line that says what is wrong."""

    def message(scene):
        with pytest.raises(InputError) as caught:
            load(scene)
        text = str(caught.value)
        assert "scene.json" in text
        assert "\n" not in text
        assert len(text) < 1000
        return text

    return message


def sphere(**fields):
    return {"primitives": [{"type": "sphere", **fields}]}


# --- The examples ---


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.parent.name)
def test_examples_are_read_without_a_warning(path, caplog):
    scene = load_scene(path)
    assert scene.primitives
    assert scene.path == path
    assert not scene.renderer.output_buffers
    assert not caplog.records


MISSING = {"name": "rug", "type": "lambert", "albedo": "rug.png"}


def test_a_missing_file_is_no_error_where_nothing_uses_it(load, caplog):
    coat = {"name": "coat", "type": "smooth_coat", "substrate": "rug"}
    grid = {"name": "smoke", "type": "voxel", "grid": {"type": "vdb", "file": "smoke.vdb"}}
    scene = load({"media": [grid], "bsdfs": [MISSING, coat, {"name": "wall", "type": "lambert"}]})
    assert [bsdf.name for bsdf in scene.bsdfs] == ["wall"]
    assert not scene.media
    assert len(caplog.messages) == 3
    assert all("found none at" in message and "nothing uses it" in message for message in caplog.messages)


def test_a_missing_file_is_an_error_where_it_is_used(load):
    second = {"name": "rug", "type": "lambert"}
    for bsdfs in ([MISSING], [MISSING, second]):
        with pytest.raises(InputError, match=r"bsdfs\[0\].albedo: expected a file, found none"):
            load({"bsdfs": bsdfs, "primitives": [{"type": "sphere", "bsdf": "rug"}]})
    with pytest.raises(InputError, match=r"name: expected a text"):
        load({"bsdfs": [{**MISSING, "name": []}]})


def test_there_are_examples():
    assert [path.parent.name for path in EXAMPLES] == ["cornell-box", "fog", "glass", "textures"]


def test_example_cornell_box():
    scene = load_scene(EXAMPLES[0])
    assert isinstance(scene.camera, t.PinholeCamera)
    assert scene.camera.resolution == (512, 288)
    assert scene.camera.fov == 40.0
    lamp = scene.primitives[-1]
    assert isinstance(lamp, t.Quad)
    assert isinstance(lamp.emission, t.ConstantTexture)
    assert lamp.emission.value == (14.0, 12.0, 9.0)
    # The walls share one BSDF object; the lamp shines downwards.
    assert scene.primitives[0].bsdf is scene.primitives[1].bsdf is scene.bsdfs[0]
    np.testing.assert_allclose(lamp.world_from_local[:3, :3] @ [0, 1, 0], [0, -1, 0], atol=1e-12)


# --- Every type ---

TYPES = [
    ("emission", {"type": "constant", "value": [1, 2, 3]}, t.ConstantTexture, {"value": (1.0, 2.0, 3.0)}),
    (
        "emission",
        {"type": "bitmap", "file": "p.png", "clamp": True},
        t.BitmapTexture,
        {"clamp": True, "scale": 1.0},
    ),
    (
        "emission",
        {"type": "checker", "res_u": 4},
        t.CheckerTexture,
        {"res_u": 4, "res_v": 20, "on_color": (0.8,) * 3},
    ),
    ("emission", {"type": "disk"}, t.DiskTexture, {"value": (1.0,) * 3}),
    ("emission", {"type": "blade", "blades": 5}, t.BladeTexture, {"blades": 5}),
    ("emission", {"type": "ies", "file": "l.ies"}, t.IesTexture, {"resolution": 256}),
    ("bsdf", {"type": "lambert", "albedo": 0.5}, t.LambertBsdf, {}),
    ("bsdf", {"type": "oren_nayar", "roughness": 0.3}, t.OrenNayarBsdf, {}),
    ("bsdf", {"type": "phong", "exponent": 8}, t.PhongBsdf, {"exponent": 8.0, "diffuse_ratio": 0.2}),
    ("bsdf", {"type": "mirror"}, t.MirrorBsdf, {}),
    ("bsdf", {"type": "conductor"}, t.ConductorBsdf, {"eta": (0.200438, 0.924033, 1.10221)}),
    (
        "bsdf",
        {"type": "rough_conductor", "material": "Ag"},
        t.RoughConductorBsdf,
        {"k": (4.828343, 3.122246, 2.14695)},
    ),
    ("bsdf", {"type": "dielectric"}, t.DielectricBsdf, {"ior": 1.5, "enable_refraction": True}),
    (
        "bsdf",
        {"type": "rough_dielectric", "distribution": "phong"},
        t.RoughDielectricBsdf,
        {"distribution": "phong"},
    ),
    ("bsdf", {"type": "plastic", "sigma_a": 0.5}, t.PlasticBsdf, {"sigma_a": (0.5,) * 3, "thickness": 1.0}),
    ("bsdf", {"type": "rough_plastic"}, t.RoughPlasticBsdf, {"distribution": "ggx"}),
    ("bsdf", {"type": "smooth_coat"}, t.SmoothCoatBsdf, {"ior": 1.3}),
    ("bsdf", {"type": "rough_coat"}, t.RoughCoatBsdf, {"ior": 1.3}),
    ("bsdf", {"type": "thinsheet"}, t.ThinSheetBsdf, {"enable_interference": False}),
    ("bsdf", {"type": "diffuse_transmission"}, t.DiffuseTransmissionBsdf, {}),
    ("bsdf", {"type": "transparency", "alpha": "p.png"}, t.TransparencyBsdf, {}),
    ("bsdf", {"type": "mixed", "bsdf0": {"type": "null"}, "bsdf1": {"type": "null"}}, t.MixedBsdf, {}),
    ("bsdf", {"type": "null"}, t.NullBsdf, {}),
    ("bsdf", {"type": "forward"}, t.ForwardBsdf, {}),
    ("bsdf", {"type": "hair"}, t.HairBsdf, {"sigma_a": None, "melanin_ratio": 0.5}),
    ("bsdf", {"type": "lambertian_fiber"}, t.LambertianFiberBsdf, {}),
    ("bsdf", {"type": "rough_wire", "eta": 1, "k": 2}, t.RoughWireBsdf, {"eta": (1.0,) * 3, "k": (2.0,) * 3}),
    ("int_medium", {"type": "homogeneous", "sigma_s": 2}, t.HomogeneousMedium, {"sigma_s": (2.0,) * 3}),
    ("int_medium", {"type": "atmosphere"}, t.AtmosphericMedium, {"radius": 1.0}),
    ("int_medium", {"type": "exponential"}, t.ExponentialMedium, {"falloff_direction": (0.0, 1.0, 0.0)}),
    (
        "int_medium",
        {"type": "voxel", "grid": {"type": "vdb", "file": "g.vdb"}},
        t.VoxelMedium,
        {"max_bounces": 1024},
    ),
]


@pytest.mark.parametrize(
    ("field", "value", "expected", "parts"), TYPES, ids=[case[1]["type"] for case in TYPES]
)
def test_textures_bsdfs_and_media(load, field, value, expected, parts):
    found = getattr(load(sphere(**{field: value})).primitives[0], field)
    assert type(found) is expected
    assert {name: getattr(found, name) for name in parts} == parts


PRIMITIVES = [
    ({"type": "mesh", "file": "m.wo3", "smooth": True}, t.Mesh, {"smooth": True, "recompute_normals": False}),
    ({"type": "cube"}, t.Cube, {}),
    ({"type": "sphere"}, t.Sphere, {}),
    ({"type": "quad"}, t.Quad, {}),
    ({"type": "disk"}, t.Disk, {"cone_angle": 90.0}),
    ({"type": "cylinder"}, t.Cylinder, {"capped": True}),
    ({"type": "curves", "file": "c.fiber"}, t.Curves, {"mode": "half_cylinder", "curve_thickness": None}),
    ({"type": "point", "power": 5}, t.Point, {}),
    ({"type": "infinite_sphere", "emission": "p.png"}, t.InfiniteSphere, {"sample": True}),
    ({"type": "infinite_sphere_cap", "power": 1}, t.InfiniteSphereCap, {"cap_angle": 10.0}),
    ({"type": "skydome"}, t.Skydome, {"turbidity": 3.0, "intensity": 2.0}),
    (
        {"type": "instances", "masters": [{"type": "cube"}], "instances": "i.bin"},
        t.Instances,
        {"instances": ()},
    ),
    ({"type": "minecraft_map", "map_path": "i.bin", "resource_packs": "i.bin"}, t.MinecraftMap, {}),
]


@pytest.mark.parametrize(
    ("value", "expected", "parts"), PRIMITIVES, ids=[case[0]["type"] for case in PRIMITIVES]
)
def test_primitives(load, value, expected, parts):
    found = load({"primitives": [value]}).primitives[0]
    assert type(found) is expected
    assert {name: getattr(found, name) for name in parts} == parts
    np.testing.assert_array_equal(found.world_from_local, np.eye(4))


@pytest.mark.parametrize("name", ["isotropic", "henyey_greenstein", "rayleigh"])
def test_phase_functions(load, name):
    medium = {"type": "homogeneous", "phase_function": {"type": name}}
    assert load({"media": [medium]}).media[0].phase_function.kind == name


@pytest.mark.parametrize(
    "name",
    [
        *("exponential", "double_exponential", "linear", "quadratic", "erlang"),
        *("davis", "davis_weinstein", "pulse", "interpolated"),
    ],
)
def test_transmittances(load, name):
    medium = {"type": "homogeneous", "transmittance": {"type": name}}
    assert load({"media": [medium]}).media[0].transmittance.kind == name


@pytest.mark.parametrize(
    "name",
    [
        *("path_tracer", "light_tracer", "bidirectional_path_tracer", "photon_map", "progressive_photon_map"),
        *("kelemen_mlt", "multiplexed_mlt", "reversible_jump_mlt"),
    ],
)
def test_integrators(load, name):
    integrator = load({"integrator": {"type": name, "max_bounces": 7}}).integrator
    assert (integrator.kind, integrator.max_bounces, integrator.min_bounces) == (name, 7, 0)


@pytest.mark.parametrize("name", ["pinhole", "thinlens", "equirectangular", "cubemap"])
def test_cameras(load, name):
    camera = load({"camera": {"type": name, "tonemap": "filmic", "resolution": [30, 20]}}).camera
    assert (camera.kind, camera.tonemap, camera.resolution) == (name, "filmic", (30, 20))
    assert camera.reconstruction_filter == "tent"


def test_an_empty_scene_is_all_defaults(load):
    scene = load({})
    assert isinstance(scene.camera, t.PinholeCamera)
    assert scene.camera.resolution == (1000, 563)
    assert isinstance(scene.integrator, t.PathTracer)
    assert (scene.renderer.spp, scene.renderer.stratified_sampler) == (32, True)
    assert scene.primitives == ()


def test_renderer_and_output_buffers(load):
    buffers = [{"type": "albedo", "hdr_output_file": "a.exr", "sample_variance": True}, {"type": "depth"}]
    renderer = load({"renderer": {"spp": 8.9, "output_buffers": buffers}}).renderer
    assert renderer.spp == 8
    assert [buffer.type for buffer in renderer.output_buffers] == ["albedo", "depth"]
    assert renderer.output_buffers[0].hdr_output_file == "a.exr"
    assert renderer.output_buffers[0].sample_variance
    assert not renderer.output_buffers[1].two_buffer_variance


# --- Shorthands, references, conventions ---


@pytest.mark.parametrize(
    ("value", "expected"),
    [(2, (2.0, 2.0, 2.0)), ([1, 2, 3], (1.0, 2.0, 3.0)), ({"type": "constant"}, (0.0,) * 3)],
)
def test_colours(load, value, expected):
    assert load(sphere(emission=value)).primitives[0].emission.value == expected


def test_a_bare_file_name_is_a_bitmap_beside_the_scene(load, tmp_path):
    texture = load(sphere(emission="p.png")).primitives[0].emission
    assert isinstance(texture, t.BitmapTexture)
    assert texture.file == tmp_path / "p.png"


def test_files_are_looked_for_in_the_input_directory(load, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "q.png").touch()
    (tmp_path / "scene.json").write_text(json.dumps(sphere(emission="q.png")))
    scene = load_scene(tmp_path / "scene.json", input_directory=other)
    assert scene.primitives[0].emission.file == other / "q.png"


def test_a_camera_is_read_without_the_files_of_its_scene(tmp_path):
    place = {"position": [0, 0, 5]}
    scene = {
        "bsdfs": [{"name": "wood", "type": "lambert", "albedo": "none.png"}],
        "primitives": [
            {"name": "it", "type": "mesh", "file": "none.wo3", "bsdf": "wood", "transform": place}
        ],
        "camera": {
            "type": "thinlens",
            "fov": 40,
            "focus_pivot": "it",
            "aperture": {"type": "bitmap", "file": "none.png"},
        },
    }
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(scene))
    camera = load_camera(path)
    assert isinstance(camera, t.ThinlensCamera)
    distance = np.linalg.norm(camera.world_from_local[:3, 3] - (0, 0, 5))
    assert (camera.fov, camera.focus_distance) == (40, pytest.approx(distance))
    with pytest.raises(InputError, match="found none"):
        load_scene(path)
    scene["primitives"][0]["bsdf"] = "stone"
    path.write_text(json.dumps(scene))
    with pytest.raises(InputError, match="the name of a BSDF"):
        load_camera(path)


def test_references_lead_to_the_same_object(load):
    scene = load(
        {
            "media": [{"name": "air", "type": "homogeneous"}],
            "bsdfs": [
                {"name": "base", "type": "lambert"},
                {"name": "coat", "type": "smooth_coat", "substrate": "base"},
            ],
            "primitives": [
                {"type": "cube", "bsdf": "coat", "int_medium": "air"},
                {
                    "type": "mesh",
                    "file": "m.wo3",
                    "bsdf": ["base", {"type": "null"}, "coat"],
                    "ext_medium": "air",
                },
                {"type": "mesh", "file": "m.wo3", "bsdf": "base"},
            ],
            "camera": {"type": "pinhole", "medium": "air"},
        }
    )
    base, coat = scene.bsdfs
    assert coat.substrate is base
    assert scene.primitives[0].bsdf is coat
    assert [bsdf.kind for bsdf in scene.primitives[1].bsdf] == ["lambert", "null", "smooth_coat"]
    assert scene.primitives[2].bsdf == (base,)
    assert (
        scene.media[0]
        is scene.primitives[0].int_medium
        is scene.primitives[1].ext_medium
        is scene.camera.medium
    )


def test_of_two_equal_names_the_first_is_used_and_said(load, caplog):
    bsdfs = [{"name": "a", "type": "lambert"}, {"name": "a", "type": "mirror"}]
    scene = load({"bsdfs": bsdfs, **sphere(bsdf="a")})
    assert scene.primitives[0].bsdf is scene.bsdfs[0]
    assert '"a" is taken' in caplog.text


def test_of_two_equal_keys_the_first_is_used_and_said(load, caplog):
    assert load('{"renderer": {"spp": 4, "spp": 9}}').renderer.spp == 4
    assert 'appear twice in one object, the first is used: "spp"' in caplog.text


def test_comments_and_trailing_commas_are_allowed(load):
    text = '{ // with "quotes"\n "camera": {"type": /* here */ "pinhole", "fov": 30,},\n "name": "//", }'
    assert load(text).camera.fov == 30.0


def test_unknown_fields_are_ignored_and_said_once(load, caplog):
    caplog.set_level(logging.WARNING)
    light = {"type": "infinite_sphere", "emission": 1, "bsdf": {"type": "null"}, "bump_strength": 1}
    load({"primitives": [light, {"type": "cube", "colour": 1}, {"type": "cube", "colour": 1}], "extra": 0})
    assert len(caplog.records) == 1
    assert "primitives[].colour (2 times), extra" in caplog.text
    assert "bump_strength" not in caplog.text


def test_the_camera_sees_x_to_the_right(load):
    transform = {"position": [0, 0, 5], "look_at": [0, 0, 0], "up": [0, 1, 0]}
    matrix = load({"camera": {"type": "pinhole", "transform": transform}}).camera.world_from_local
    # Looking along -z, with y up, right is +x.
    np.testing.assert_allclose(matrix[:3, :3], [[1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-12)
    np.testing.assert_array_equal(matrix[:3, 3], [0, 0, 5])
    assert not matrix.flags.writeable


def test_a_matrix_is_read_row_by_row(load):
    rows = [1, 0, 0, 7, 0, 2, 0, 8, 0, 0, 3, 9, 0, 0, 0, 1]
    np.testing.assert_array_equal(
        load(sphere(transform=rows)).primitives[0].world_from_local @ [1, 1, 1, 1], [8, 10, 12, 1]
    )


def test_a_pivot_sets_the_focus(load, caplog):
    camera = {"type": "thinlens", "focus_pivot": "ball", "transform": {"position": [0, 0, 5]}}
    ball = sphere(name="ball", transform={"position": [3, 0, 1]})
    assert load({**ball, "camera": camera}).camera.focus_distance == pytest.approx(5.0)
    assert not caplog.records
    assert load({**ball, "camera": camera | {"focus_pivot": "none"}}).camera.focus_distance == 1.0
    assert "no primitive is named" in caplog.text


def test_a_sun_takes_the_transform_of_its_sky(load):
    sky = {"type": "skydome", "name": "sky", "transform": {"rotation": [40, 0, 0]}}
    sun, dome = load({"primitives": [{"type": "infinite_sphere_cap", "skydome": "sky"}, sky]}).primitives
    np.testing.assert_array_equal(sun.world_from_local, dome.world_from_local)


def test_explicit_eta_and_k_against_a_named_metal(load):
    assert load(sphere(bsdf={"type": "conductor", "eta": 1, "k": 2})).primitives[0].bsdf.eta == (1.0,) * 3
    named = load(sphere(bsdf={"type": "conductor", "eta": 1, "k": 2, "material": "Au"})).primitives[0].bsdf
    assert named.eta == (0.143119, 0.374957, 1.442479)


def test_instances(load):
    value = {
        "type": "instances",
        "masters": [{"type": "cube"}, {"type": "sphere", "bsdf": {"type": "mirror"}}],
        "instances": [{"id": 1, "transform": {"position": [1, 2, 3]}}, {}],
    }
    found = load({"primitives": [value]}).primitives[0]
    assert [master.kind for master in found.masters] == ["cube", "sphere"]
    assert [placement.id for placement in found.instances] == [1, 0]
    np.testing.assert_array_equal(found.instances[0].world_from_local[:3, 3], [1, 2, 3])


# --- Everything that can be wrong ---

WRONG = [
    ([], "JSON object"),
    ("", "JSON"),
    ("{", ":1:2: expected JSON"),
    ('{"primitives": [}\n', "syntax error"),
    ('{"a": 1} x', "syntax error"),
    ({"primitives": {}}, "primitives: expected an array"),
    ({"primitives": [3]}, "primitives[0]: expected a primitive object"),
    ({"primitives": [{}]}, 'primitives[0]: the primitive has no "type"'),
    (
        {"primitives": [{"type": "teapot"}]},
        'primitives[0]: expected a known primitive type, got "teapot"; use one of cube',
    ),
    ({"primitives": [{"type": 3}]}, "expected a known primitive type, got 3"),
    ({"primitives": [{"type": "mesh"}]}, 'primitives[0]: the field "file" is missing'),
    (
        {"primitives": [{"type": "mesh", "file": "none.wo3"}]},
        "primitives[0].file: expected a file, found none",
    ),
    ({"primitives": [{"type": "mesh", "file": ""}]}, "the name of a file"),
    ({"primitives": [{"type": "mesh", "file": "a\0b"}]}, "found none"),
    ({"primitives": [{"type": "mesh", "file": "x" * 5000}]}, "found none"),
    ({"primitives": [{"type": "mesh", "file": "m.wo3", "bsdf": []}]}, "at least one BSDF"),
    (sphere(bsdf="none"), 'primitives[0].bsdf: expected the name of a BSDF, got "none"; declare it in bsdfs'),
    (sphere(bsdf={"type": "velvet"}), "primitives[0].bsdf: expected a known BSDF type"),
    (sphere(bsdf=None), "primitives[0].bsdf: expected a BSDF object, got null"),
    (
        sphere(bsdf={"type": "mixed", "bsdf0": {"type": "null"}}),
        'primitives[0].bsdf: the field "bsdf1" is missing',
    ),
    (sphere(bsdf={"type": "conductor", "material": "Unobtainium"}), "primitives[0].bsdf.material"),
    (sphere(bsdf={"type": "rough_conductor", "distribution": "ward"}), "one of beckmann, phong, ggx"),
    (sphere(bsdf={"type": "dielectric", "ior": 0}), "ior: expected a number above 0, got 0"),
    (sphere(bsdf={"type": "dielectric", "ior": "glass"}), 'ior: expected a finite number, got "glass"'),
    (sphere(bsdf={"type": "dielectric", "enable_refraction": 1}), "expected true or false"),
    (sphere(bsdf={"type": "lambert", "albedo": [1, 2]}), "albedo: expected 3 numbers, got an array of 2"),
    (sphere(bsdf={"type": "lambert", "albedo": [1, 2, None]}), "albedo: expected a finite number, got null"),
    (sphere(bsdf={"type": "lambert", "albedo": True}), "expected a finite number, got true"),
    (sphere(bsdf={"type": "lambert", "albedo": {"type": "bitmap"}}), 'the field "file" is missing'),
    (sphere(emission={"type": "marble"}), "primitives[0].emission: expected a known texture type"),
    (sphere(int_medium="none"), "declare it in media"),
    (sphere(int_medium={"type": "homogeneous", "sigma_s": -1}), "sigma_s: expected at least 0, got -1"),
    (sphere(transform=[1, 2]), "transform: expected 16 numbers"),
    (sphere(transform="here"), "transform: expected a transform object"),
    (sphere(transform={"scale": [1, 2]}), "primitives[0].transform.scale: expected 3 numbers"),
    (sphere(transform={"look_at": [0, 0, 0]}), "the z axis has no length"),
    (sphere(name=3), "name: expected a text"),
    (
        {"bsdfs": [{"type": "smooth_coat", "name": "a", "substrate": "a"}]},
        "declare it in bsdfs, before its use",
    ),
    ({"camera": {"type": "fisheye"}}, "camera: expected a known camera type"),
    (
        {"camera": {"type": "pinhole", "fov": 180}},
        "camera.fov: expected at least 0.001 and at most 179.999, got 180",
    ),
    ({"camera": {"type": "pinhole", "resolution": [0, 5]}}, "camera.resolution: expected 1 to"),
    ({"camera": {"type": "pinhole", "resolution": [-3, 5]}}, "got -3 x 5"),
    (
        {"camera": {"type": "pinhole", "resolution": [1000000000, 1000000000]}},
        "choose a size that fits in memory",
    ),
    ({"camera": {"type": "pinhole", "tonemap": "aces"}}, "one of linear, gamma, reinhard, filmic, pbrt"),
    ({"camera": {"type": "thinlens", "aperture_size": -1}}, "camera.aperture_size: expected at least 0"),
    (
        {"integrator": {"type": "path_tracer", "max_bounces": -1}},
        "integrator.max_bounces: expected at least 0",
    ),
    ({"integrator": {"type": "path_tracer", "max_bounces": 10**50}}, "got a huge number"),
    ({"renderer": {"spp": 0}}, "renderer.spp: expected at least 1"),
    ({"renderer": 3}, "renderer: expected an object"),
    (
        {"renderer": {"output_buffers": [{"type": "emission"}]}},
        "renderer.output_buffers[0].type: expected one of color",
    ),
    ({"renderer": {"output_buffers": [{}]}}, 'renderer.output_buffers[0]: the field "type" is missing'),
    (
        {"primitives": [{"type": "instances", "masters": [], "instances": [{}]}]},
        "instances[0].id: expected the number",
    ),
    # Non-finite numbers, which JSON has not but Tungsten reads.
    (
        '{"camera": {"type": "pinhole", "resolution": [NaN, 5]}}',
        "camera.resolution: expected a finite number, got NaN",
    ),
    ('{"camera": {"type": "pinhole", "resolution": [Infinity, 5]}}', "got Infinity"),
    ('{"camera": {"type": "pinhole", "fov": 1e999}}', "camera.fov: expected a finite number"),
    ('{"camera": {"type": "pinhole", "fov": 1e39}}', "camera.fov: expected a finite number"),
]


@pytest.mark.parametrize(("scene", "expected"), WRONG, ids=[str(i) for i in range(len(WRONG))])
def test_what_is_wrong_is_said_in_one_line(refused, scene, expected):
    assert expected in refused(scene)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[" * 200_000, "nested too deeply"),
        ('{"a":' * 200_000, "nested too deeply"),
        (
            '{"bsdfs": ['
            + '{"type": "smooth_coat", "substrate": ' * 300
            + '{"type": "null"}'
            + "}" * 300
            + "]}",
            "256",
        ),
        ('{"camera": {"type": "pinhole", "fov": ' + "9" * 100_000 + "}}", "digits"),
        ('{"x": "' + '\\"' * 200_000, "syntax error"),
        ("/*" + "/* " * 200_000, "syntax error"),
        ('{"camera": {"type": "' + "x" * 200_000 + '"}}', "known camera type"),
        ('{"camera": {"type": "a\\nb\\u0000"}}', "known camera type"),
    ],
    ids=["arrays", "objects", "coats", "digits", "quotes", "comments", "text", "newline"],
)
def test_hostile_text_is_refused(refused, text, expected):
    assert expected in refused(text)


def test_a_thousand_coats_are_refused(refused):
    coats = [{"name": "0", "type": "lambert"}]
    coats += [{"name": str(i), "type": "smooth_coat", "substrate": str(i - 1)} for i in range(1, 1000)]
    assert "bsdfs[256]" in refused({"bsdfs": coats})


def test_a_mixture_that_doubles_with_every_name_is_refused(refused):
    mixed = [{"name": "0", "type": "lambert"}]
    mixed += [
        {"name": str(i), "type": "mixed", "bsdf0": str(i - 1), "bsdf1": str(i - 1)} for i in range(1, 60)
    ]
    assert "bsdfs[8]" in refused({"bsdfs": mixed})


def test_names_in_other_encodings_still_name(tmp_path):
    scene = {
        "bsdfs": [{"name": "Fu\xdfboden", "type": "mirror"}],
        "primitives": [{"type": "quad", "bsdf": "Fu\xdfboden"}],
        "camera": {"type": "pinhole"},
    }
    path = tmp_path / "scene.json"
    path.write_bytes(json.dumps(scene, ensure_ascii=False).encode("latin-1"))
    assert load_scene(path).primitives[0].bsdf.kind == "mirror"


def test_files_that_a_scene_in_latin_1_names_are_found_under_names_in_utf_8(tmp_path):
    mesh = tmp_path / "Fu\xdfboden.obj"
    mesh.touch()
    scene = {"primitives": [{"type": "mesh", "file": "Fu\xdfboden.obj"}]}
    path = tmp_path / "scene.json"
    path.write_bytes(json.dumps(scene, ensure_ascii=False).encode("latin-1"))
    assert load_scene(path).primitives[0].file == mesh


def test_a_scene_in_a_zip_says_what_to_do(tmp_path):
    (tmp_path / "room.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match="a zip on the way to it; unpack it"):
        load_scene(tmp_path / "room.zip" / "room" / "scene.json")


def test_what_tungsten_takes_for_nothing(load):
    scene = load({"media": None, "bsdfs": None, "camera": {"type": "pinhole"}})
    assert scene.bsdfs == ()
    # At (0, 0, 2), looking along +z.
    np.testing.assert_array_equal(scene.camera.world_from_local[:3, 3], (0, 0, 2))
    metals = [{"type": "conductor"}, {"type": "conductor", "k": 0.1}]
    copper, same = load({"primitives": [{"type": "quad", "bsdf": bsdf} for bsdf in metals]}).primitives
    assert same.bsdf.k == copper.bsdf.k


@pytest.mark.parametrize("name", ["none.json", "", "a\0b.json"])
def test_a_scene_that_is_not_there(tmp_path, name):
    with pytest.raises(InputError, match="check the path"):
        load_scene(f"{tmp_path}/{name}")
