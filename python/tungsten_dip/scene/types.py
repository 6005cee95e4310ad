"""Tungsten's scene file as typed objects: one frozen dataclass per ``type``, with Tungsten's own defaults.

Field names are the keys of the JSON (``Key`` marks the few that differ) and ``kind`` is the value of its
``type``, so that `parse` reads every class from its annotations alone. References by name are resolved: two
primitives that name one BSDF hold the same object, and objects compare by identity, which is what a host
needs to share them.

Lengths are in scene units, angles in degrees, colours are linear RGB. Matrices are float64, shape (4, 4), act
on column vectors, and are read-only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import Quantity

Vec3 = tuple[float, float, float]
"""A point, a direction or a linear RGB colour; a single number in the file means all three."""

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Key:
    """Marks a field whose key in the JSON is another one."""

    name: str


@dataclass(frozen=True)
class Range:
    """Marks numbers that must lie within [lowest, highest] to mean anything."""

    lowest: float
    highest: float = float("inf")


Positive = Annotated[float, Range(1e-30)]
NotNegative = Annotated[float, Range(0.0)]
NotNegativeVec3 = Annotated[Vec3, Range(0.0)]
Fraction = Annotated[float, Range(0.0, 1.0)]
Count = Annotated[int, Range(1, 2**31 - 1)]
Bounces = Annotated[int, Range(0, 2**31 - 1)]
Fov = Annotated[float, Range(1e-3, 179.999)]
Transform = Annotated[Matrix, Key("transform")]

MicrofacetDistribution = Literal["beckmann", "phong", "ggx"]
TonemapName = Literal["linear", "gamma", "reinhard", "filmic", "pbrt"]
FilterName = Literal["dirac", "box", "tent", "gaussian", "mitchell_netravali", "catmull_rom", "lanczos"]


def identity() -> Matrix:
    """Return a read-only identity matrix."""
    matrix = np.eye(4)
    matrix.flags.writeable = False
    return matrix


def default_camera_frame() -> Matrix:
    """Return the frame of a camera that has no transform: at the origin, looking along +z, +y up."""
    matrix = np.diag([-1.0, 1.0, 1.0, 1.0])
    matrix.flags.writeable = False
    return matrix


def default_pinhole_frame() -> Matrix:
    """Return the frame of a pinhole that has no transform: the same, but at (0, 0, 2)."""
    matrix = np.diag([-1.0, 1.0, 1.0, 1.0])
    matrix[2, 3] = 2.0
    matrix.flags.writeable = False
    return matrix


# --- Textures ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Texture:
    """A colour or a number over the surface.

    Where a number is needed, it is the mean of a bitmap's RGB, or the first component of another texture.
    """

    kind: ClassVar[str] = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstantTexture(Texture):
    """One colour everywhere. Numbers and [r, g, b] in the file become this too."""

    kind: ClassVar[str] = "constant"
    value: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class BitmapTexture(Texture):
    """An image file. A bare string in the file becomes this too.

    ``gamma_correct`` undoes a gamma of 2.2 in 8-bit colour; HDR images, and images that supply a number
    (roughness, bump, alpha), are not changed. ``interpolate`` is bilinear filtering, ``clamp`` stops at
    the border where the default repeats, ``scale`` multiplies the values.
    """

    kind: ClassVar[str] = "bitmap"
    file: Path
    gamma_correct: bool = True
    interpolate: bool = True
    clamp: bool = False
    scale: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckerTexture(Texture):
    """A chess board of ``res_u`` by ``res_v`` squares over the unit square of UV."""

    kind: ClassVar[str] = "checker"
    on_color: Vec3 = (0.8, 0.8, 0.8)
    off_color: Vec3 = (0.2, 0.2, 0.2)
    res_u: Count = 20
    res_v: Count = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class DiskTexture(Texture):
    """``value`` inside the circle of radius 0.5 about the middle of UV, zero outside."""

    kind: ClassVar[str] = "disk"
    value: Vec3 = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class BladeTexture(Texture):
    """``value`` inside a regular polygon of ``blades`` corners: the aperture of a lens.

    ``angle`` is in radians, the one angle of the format that is not in degrees.
    """

    kind: ClassVar[str] = "blade"
    blades: Annotated[int, Range(3, 1000)] = 6
    angle: float = 0.5 * np.pi / 6
    value: Vec3 = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class IesTexture(Texture):
    """The profile of a luminaire from an IES file, tabulated over the sphere at ``resolution``."""

    kind: ClassVar[str] = "ies"
    file: Path
    resolution: Annotated[int, Range(1, 16384)] = 256


# --- Participating media ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseFunction:
    """How a medium scatters by angle."""

    kind: ClassVar[str] = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class IsotropicPhaseFunction(PhaseFunction):
    """Equally in every direction."""

    kind: ClassVar[str] = "isotropic"


@dataclass(frozen=True, eq=False, kw_only=True)
class HenyeyGreensteinPhaseFunction(PhaseFunction):
    """Henyey and Greenstein's function of mean cosine ``g``, forward where positive."""

    kind: ClassVar[str] = "henyey_greenstein"
    g: Annotated[float, Range(-1.0, 1.0)] = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class RayleighPhaseFunction(PhaseFunction):
    """Rayleigh scattering."""

    kind: ClassVar[str] = "rayleigh"


@dataclass(frozen=True, eq=False, kw_only=True)
class Transmittance:
    """How light fades with optical depth."""

    kind: ClassVar[str] = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExponentialTransmittance(Transmittance):
    """Beer and Lambert's law, that of ordinary media."""

    kind: ClassVar[str] = "exponential"


@dataclass(frozen=True, eq=False, kw_only=True)
class DoubleExponentialTransmittance(Transmittance):
    """The mean of two exponentials."""

    kind: ClassVar[str] = "double_exponential"
    sigma_a: float = 0.5
    sigma_b: float = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearTransmittance(Transmittance):
    """Falls linearly to zero at ``max_t``."""

    kind: ClassVar[str] = "linear"
    max_t: Positive = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class QuadraticTransmittance(Transmittance):
    """Falls quadratically to zero at ``max_t``."""

    kind: ClassVar[str] = "quadratic"
    max_t: Positive = 0.75


@dataclass(frozen=True, eq=False, kw_only=True)
class ErlangTransmittance(Transmittance):
    """Erlang-distributed free paths."""

    kind: ClassVar[str] = "erlang"
    rate: float = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class DavisTransmittance(Transmittance):
    """Davis and Marshak's power law; ``alpha`` must exceed 1, smaller values are raised to it."""

    kind: ClassVar[str] = "davis"
    alpha: float = 1.1


@dataclass(frozen=True, eq=False, kw_only=True)
class DavisWeinsteinTransmittance(Transmittance):
    """Davis and Weinstein's law; ``h`` is clamped to [0.5, 1]."""

    kind: ClassVar[str] = "davis_weinstein"
    h: float = 0.75
    c: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class PulseTransmittance(Transmittance):
    """Steps down in ``num_pulses`` pulses between ``min`` and ``max``."""

    kind: ClassVar[str] = "pulse"
    min: float = 0.0
    max: float = 1.0
    num_pulses: Count = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class InterpolatedTransmittance(Transmittance):
    """A mixture of two others; ``ratio`` is the weight of ``tr_b``."""

    kind: ClassVar[str] = "interpolated"
    tr_a: Transmittance = LinearTransmittance()
    tr_b: Transmittance = ErlangTransmittance()
    ratio: Fraction = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class VdbGrid:
    """An OpenVDB file; ``world_from_local`` is applied after the grid was scaled to the unit cube."""

    kind: ClassVar[str] = "vdb"
    file: Path
    density_name: str = "density"
    density_scale: float = 1.0
    emission_name: str = "Cd"
    emission_scale: float = 1.0
    scale_emission_by_density: bool = True
    normalize_size: bool = True
    integration_method: Literal["exact_nearest", "exact_linear", "raymarching", "residual_ratio"] = (
        "exact_nearest"
    )
    sampling_method: Literal["exact_nearest", "exact_linear", "raymarching"] = "exact_nearest"
    step_size: Positive = 5.0
    supergrid_subsample: Count = 10
    world_from_local: Transform = field(default_factory=identity)


@dataclass(frozen=True, eq=False, kw_only=True)
class Medium:
    """A participating medium. Coefficients are per scene unit."""

    kind: ClassVar[str] = ""
    name: str = ""
    phase_function: PhaseFunction = IsotropicPhaseFunction()
    transmittance: Transmittance = ExponentialTransmittance()
    max_bounces: Bounces = 1024


@dataclass(frozen=True, eq=False, kw_only=True)
class HomogeneousMedium(Medium):
    """A constant medium; both coefficients are multiplied by ``density``."""

    kind: ClassVar[str] = "homogeneous"
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    sigma_s: NotNegativeVec3 = (0.0, 0.0, 0.0)
    density: NotNegative = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class AtmosphericMedium(Medium):
    """Fades exponentially with the squared height over a planet.

    ``pivot`` names a primitive that gives the centre.
    """

    kind: ClassVar[str] = "atmosphere"
    pivot: str = ""
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    sigma_s: NotNegativeVec3 = (0.0, 0.0, 0.0)
    density: NotNegative = 1.0
    falloff_scale: float = 1.0
    radius: Positive = 1.0
    center: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class ExponentialMedium(Medium):
    """Fades exponentially along ``falloff_direction``; the density is ``density`` at ``unit_point``."""

    kind: ClassVar[str] = "exponential"
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    sigma_s: NotNegativeVec3 = (0.0, 0.0, 0.0)
    density: NotNegative = 1.0
    falloff_scale: float = 1.0
    unit_point: Vec3 = (0.0, 0.0, 0.0)
    falloff_direction: Vec3 = (0.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class VoxelMedium(Medium):
    """Density (and emission) from a grid."""

    kind: ClassVar[str] = "voxel"
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    sigma_s: NotNegativeVec3 = (0.0, 0.0, 0.0)
    grid: VdbGrid


# --- BSDFs ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Bsdf:
    """How a surface reflects and transmits. ``bump`` is a height map."""

    kind: ClassVar[str] = ""
    name: str = ""
    albedo: Texture = ConstantTexture(value=(1.0, 1.0, 1.0))
    bump: Texture | None = None

    @property
    def written_albedo(self) -> Texture:
        """What Tungsten writes into the albedo buffer, whatever the BSDF does with it."""
        return self.albedo


@dataclass(frozen=True, eq=False, kw_only=True)
class LambertBsdf(Bsdf):
    """Ideal diffuse reflection, one-sided."""

    kind: ClassVar[str] = "lambert"


@dataclass(frozen=True, eq=False, kw_only=True)
class OrenNayarBsdf(Bsdf):
    """Oren and Nayar's rough diffuse reflection."""

    kind: ClassVar[str] = "oren_nayar"
    roughness: Texture = ConstantTexture(value=(1.0, 1.0, 1.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class PhongBsdf(Bsdf):
    """A Phong lobe, and a diffuse one of weight ``diffuse_ratio``."""

    kind: ClassVar[str] = "phong"
    exponent: NotNegative = 64.0
    diffuse_ratio: Fraction = 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class MirrorBsdf(Bsdf):
    """Perfect reflection tinted by the albedo."""

    kind: ClassVar[str] = "mirror"


@dataclass(frozen=True, eq=False, kw_only=True)
class ConductorBsdf(Bsdf):
    """Polished metal of complex index of refraction ``eta`` + i ``k``, set by ``material`` if it is named."""

    kind: ClassVar[str] = "conductor"
    material: str = ""
    eta: Vec3 = (0.200438, 0.924033, 1.10221)
    k: Vec3 = (3.91295, 2.45285, 2.14219)


@dataclass(frozen=True, eq=False, kw_only=True)
class RoughConductorBsdf(Bsdf):
    """Metal of microfacets."""

    kind: ClassVar[str] = "rough_conductor"
    material: str = ""
    eta: Vec3 = (0.200438, 0.924033, 1.10221)
    k: Vec3 = (3.91295, 2.45285, 2.14219)
    distribution: MicrofacetDistribution = "ggx"
    roughness: Texture = ConstantTexture(value=(0.1, 0.1, 0.1))


@dataclass(frozen=True, eq=False, kw_only=True)
class DielectricBsdf(Bsdf):
    """Clear glass; without ``enable_refraction`` it only reflects."""

    kind: ClassVar[str] = "dielectric"
    ior: Positive = 1.5
    enable_refraction: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class RoughDielectricBsdf(Bsdf):
    """Frosted glass; without ``enable_refraction`` it only reflects."""

    kind: ClassVar[str] = "rough_dielectric"
    ior: Positive = 1.5
    enable_refraction: bool = True
    distribution: MicrofacetDistribution = "ggx"
    roughness: Texture = ConstantTexture(value=(0.1, 0.1, 0.1))


@dataclass(frozen=True, eq=False, kw_only=True)
class PlasticBsdf(Bsdf):
    """A diffuse base under a smooth dielectric layer that absorbs ``sigma_a`` over ``thickness``."""

    kind: ClassVar[str] = "plastic"
    ior: Positive = 1.5
    thickness: NotNegative = 1.0
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class RoughPlasticBsdf(Bsdf):
    """A diffuse base under a rough dielectric layer that absorbs ``sigma_a`` over ``thickness``."""

    kind: ClassVar[str] = "rough_plastic"
    ior: Positive = 1.5
    thickness: NotNegative = 1.0
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    distribution: MicrofacetDistribution = "ggx"
    roughness: Texture = ConstantTexture(value=(0.02, 0.02, 0.02))


@dataclass(frozen=True, eq=False, kw_only=True)
class SmoothCoatBsdf(Bsdf):
    """A smooth dielectric layer over another BSDF."""

    kind: ClassVar[str] = "smooth_coat"
    ior: Positive = 1.3
    thickness: NotNegative = 1.0
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    substrate: Bsdf = RoughConductorBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class RoughCoatBsdf(Bsdf):
    """A rough dielectric layer over another BSDF."""

    kind: ClassVar[str] = "rough_coat"
    ior: Positive = 1.3
    thickness: NotNegative = 1.0
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)
    distribution: MicrofacetDistribution = "ggx"
    roughness: Texture = ConstantTexture(value=(0.02, 0.02, 0.02))
    substrate: Bsdf = RoughConductorBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class ThinSheetBsdf(Bsdf):
    """A film that light crosses unbent.

    ``thickness`` is in units of 500 nm where ``enable_interference`` is set.
    """

    kind: ClassVar[str] = "thinsheet"
    ior: Positive = 1.5
    enable_interference: bool = False
    thickness: Texture = ConstantTexture(value=(0.5, 0.5, 0.5))
    sigma_a: NotNegativeVec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class DiffuseTransmissionBsdf(Bsdf):
    """Scatters diffusely, half forwards and half backwards: Tungsten reads no other share from the file."""

    kind: ClassVar[str] = "diffuse_transmission"


@dataclass(frozen=True, eq=False, kw_only=True)
class TransparencyBsdf(Bsdf):
    """``base`` where ``alpha`` is 1, nothing where it is 0.

    A bitmap with an alpha channel is read by that.
    """

    kind: ClassVar[str] = "transparency"
    base: Bsdf = LambertBsdf()
    alpha: Texture = ConstantTexture(value=(1.0, 1.0, 1.0))

    @property
    def written_albedo(self) -> Texture:
        """That of ``base``."""
        return self.base.albedo


@dataclass(frozen=True, eq=False, kw_only=True)
class MixedBsdf(Bsdf):
    """Two BSDFs; ``ratio`` is the weight of ``bsdf0``."""

    kind: ClassVar[str] = "mixed"
    bsdf0: Bsdf
    bsdf1: Bsdf
    ratio: Texture = ConstantTexture(value=(0.5, 0.5, 0.5))


@dataclass(frozen=True, eq=False, kw_only=True)
class NullBsdf(Bsdf):
    """Absorbs everything: the BSDF of lights without a surface."""

    kind: ClassVar[str] = "null"


@dataclass(frozen=True, eq=False, kw_only=True)
class ForwardBsdf(Bsdf):
    """Lets light pass unchanged: a boundary between media."""

    kind: ClassVar[str] = "forward"


@dataclass(frozen=True, eq=False, kw_only=True)
class HairBsdf(Bsdf):
    """A strand of hair. ``sigma_a`` None means: from the melanin. ``scale_angle`` is in degrees."""

    kind: ClassVar[str] = "hair"
    scale_angle: float = 2.0
    melanin_ratio: float = 0.5
    melanin_concentration: NotNegative = 0.25
    sigma_a: NotNegativeVec3 | None = None
    roughness: NotNegative = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class LambertianFiberBsdf(Bsdf):
    """A diffuse thread."""

    kind: ClassVar[str] = "lambertian_fiber"


@dataclass(frozen=True, eq=False, kw_only=True)
class RoughWireBsdf(Bsdf):
    """A metal thread."""

    kind: ClassVar[str] = "rough_wire"
    material: str = ""
    eta: Vec3 = (0.200438, 0.924033, 1.10221)
    k: Vec3 = (3.91295, 2.45285, 2.14219)
    roughness: NotNegative = 0.1


# --- Primitives -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Primitive:
    """A surface, or a light.

    ``emission`` is radiance; ``power`` is in watts over the whole surface and takes precedence.
    ``int_medium`` fills the inside, ``ext_medium`` the outside.
    """

    kind: ClassVar[str] = ""
    name: str = ""
    world_from_local: Transform = field(default_factory=identity)
    emission: Texture | None = None
    power: Texture | None = None
    int_medium: Medium | None = None
    ext_medium: Medium | None = None

    @property
    def emitter(self) -> Texture | None:
        """Its power or else its emission; None if it emits nothing."""
        return self.power or self.emission


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh(Primitive):
    """Triangles from a .wo3 or .obj file; a triangle selects one of ``bsdf`` by its material index.

    ``smooth`` interpolates the vertex normals, ``recompute_normals`` (only together with it) computes them
    anew.
    """

    kind: ClassVar[str] = "mesh"
    file: Path
    smooth: bool = False
    backface_culling: bool = False
    recompute_normals: bool = False
    bsdf: tuple[Bsdf, ...] = (LambertBsdf(),)


@dataclass(frozen=True, eq=False, kw_only=True)
class Cube(Primitive):
    """The cube [-0.5, 0.5]^3."""

    kind: ClassVar[str] = "cube"
    bsdf: Bsdf = LambertBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class Sphere(Primitive):
    """The unit sphere; a scale that differs by axis makes it a sphere of the largest, never an ellipsoid."""

    kind: ClassVar[str] = "sphere"
    bsdf: Bsdf = LambertBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class Quad(Primitive):
    """The square [-0.5, 0.5]^2 in the xz plane; its normal is edge_z x edge_x, which is +y."""

    kind: ClassVar[str] = "quad"
    bsdf: Bsdf = LambertBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class Disk(Primitive):
    """The unit disk in the xz plane, normal +y; ``cone_angle`` limits what it emits."""

    kind: ClassVar[str] = "disk"
    cone_angle: Annotated[float, Range(0.0, 180.0)] = 90.0
    bsdf: Bsdf = LambertBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class Cylinder(Primitive):
    """The cylinder of radius 0.5 and height 1 about the y axis.

    The larger of its x and z scale is its width.
    """

    kind: ClassVar[str] = "cylinder"
    capped: bool = True
    bsdf: Bsdf = LambertBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class Curves(Primitive):
    """Hairs, quadratic B-splines from a .fiber or .hair file.

    ``curve_thickness`` None keeps the widths of the file; ``curve_taper`` thins every curve towards its tip;
    ``subsample`` is the share of curves that is left out.
    """

    kind: ClassVar[str] = "curves"
    file: Path
    mode: Literal["cylinder", "half_cylinder", "bcsdf_cylinder", "ribbon"] = "half_cylinder"
    curve_thickness: Positive | None = None
    curve_taper: bool = False
    subsample: Fraction = 0.0
    bsdf: Bsdf = HairBsdf()


@dataclass(frozen=True, eq=False, kw_only=True)
class Point(Primitive):
    """A point light."""

    kind: ClassVar[str] = "point"


@dataclass(frozen=True, eq=False, kw_only=True)
class InfiniteSphere(Primitive):
    """Light from everywhere.

    An environment map (latitude and longitude), turned by the transform's rotation.
    """

    kind: ClassVar[str] = "infinite_sphere"
    sample: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class InfiniteSphereCap(Primitive):
    """Light from a cone of directions about +y.

    The sun. ``skydome`` names a primitive whose transform it takes.
    """

    kind: ClassVar[str] = "infinite_sphere_cap"
    sample: bool = True
    skydome: str = ""
    cap_angle: Annotated[float, Range(0.0, 180.0)] = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Skydome(Primitive):
    """Hosek and Wilkie's sky; the transform's +y points to the sun. ``temperature`` is in kelvin."""

    kind: ClassVar[str] = "skydome"
    temperature: Positive = 5777.0
    gamma_scale: float = 1.0
    turbidity: float = 3.0
    intensity: float = 2.0
    sample: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Where one instance is placed: ``id`` selects the master; only position and rotation are used."""

    id: Annotated[int, Range(0, 255)] = 0
    world_from_local: Transform = field(default_factory=identity)


@dataclass(frozen=True, eq=False, kw_only=True)
class Instances(Primitive):
    """Copies of ``masters``: ``instances`` lists them, or a binary file does.

    With a second file ``file_b`` every placement is interpolated by ``ratio``. A master is placed by its own
    transform, then by its placement, then by the transform here, whose scale changes the distances of
    the copies but not their size.
    """

    kind: ClassVar[str] = "instances"
    masters: tuple[Primitive, ...] = ()
    instances: tuple[Placement, ...] = ()
    file_a: Annotated[Path | None, Key("instancesA")] = None
    file_b: Annotated[Path | None, Key("instancesB")] = None
    ratio: Fraction = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class MinecraftMap(Primitive):
    """A world of the game Minecraft."""

    kind: ClassVar[str] = "minecraft_map"
    map_path: Path
    resource_packs: tuple[Path, ...] = ()


# --- Cameras ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """Where the picture is taken from.

    In ``world_from_local`` the camera looks along +z, +y is up and +x points to the right of the picture:
    Tungsten negates the x axis of the transform in the file for that. ``resolution`` is (width, height).
    ``pixel_center`` is where in a pixel Tungsten centres its reconstruction filter.
    """

    kind: ClassVar[str] = ""
    pixel_center: ClassVar[float] = 0.5
    tonemap: TonemapName = "gamma"
    resolution: tuple[int, int] = (1000, 563)
    reconstruction_filter: FilterName = "tent"
    world_from_local: Transform = field(default_factory=default_camera_frame)
    medium: Medium | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PerspectiveCamera(Camera):
    """A pinhole or a thin lens before a flat picture. ``fov`` is horizontal."""

    fov: Fov = 60.0

    @property
    def plane_distance(self) -> float:
        """The distance of the picture plane, on which the width of the picture is 2."""
        return 1 / math.tan(math.radians(self.fov) / 2)


@dataclass(frozen=True, eq=False, kw_only=True)
class PinholeCamera(PerspectiveCamera):
    """Everything in focus."""

    kind: ClassVar[str] = "pinhole"
    world_from_local: Transform = field(default_factory=default_pinhole_frame)


@dataclass(frozen=True, eq=False, kw_only=True)
class ThinlensCamera(PerspectiveCamera):
    """Depth of field. ``aperture_size`` is the radius of the lens.

    ``focus_distance`` is measured along the axis; where ``focus_pivot`` names a primitive, it is the distance
    to that. Tungsten's thin lens samples a pixel about its upper left corner, not about its middle as the
    pinhole does: the image is shifted by half a pixel to the right and down.
    """

    kind: ClassVar[str] = "thinlens"
    pixel_center: ClassVar[float] = 0.0
    focus_distance: Positive = 1.0
    focus_pivot: str = ""
    aperture_size: NotNegative = 0.001
    cateye: NotNegative = 0.0
    aperture: Texture = DiskTexture()


@dataclass(frozen=True, eq=False, kw_only=True)
class EquirectangularCamera(Camera):
    """All directions, by latitude and longitude."""

    kind: ClassVar[str] = "equirectangular"


@dataclass(frozen=True, eq=False, kw_only=True)
class CubemapCamera(Camera):
    """All directions, on the faces of a cube."""

    kind: ClassVar[str] = "cubemap"
    mode: Literal["horizontal_cross", "vertical_cross", "row", "column"] = "horizontal_cross"


# --- Integrators ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Integrator:
    """How light is followed.

    A path has at most ``max_bounces`` edges: with 1 only emitters in plain view are seen, with 2 direct light
    too. Surfaces that light crosses unbent (``forward``, ``transparency``) count.
    """

    kind: ClassVar[str] = ""
    min_bounces: Bounces = 0
    max_bounces: Bounces = 64
    enable_consistency_checks: bool = False
    enable_two_sided_shading: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class PathTracer(Integrator):
    """The one integrator of Tungsten that writes feature buffers."""

    kind: ClassVar[str] = "path_tracer"
    enable_light_sampling: bool = True
    enable_volume_light_sampling: bool = True
    low_order_scattering: bool = True
    include_surfaces: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class LightTracer(Integrator):
    """Paths from the lights."""

    kind: ClassVar[str] = "light_tracer"
    low_order_scattering: bool = True
    include_surfaces: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class BidirectionalPathTracer(Integrator):
    """Paths from both ends."""

    kind: ClassVar[str] = "bidirectional_path_tracer"
    image_pyramid: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotonMap(Integrator):
    """Photon mapping. ``volume_gather_radius`` None means: as ``gather_radius``."""

    kind: ClassVar[str] = "photon_map"
    photon_count: Annotated[int, Range(0, 2**32 - 1)] = 1_000_000
    volume_photon_count: Annotated[int, Range(0, 2**32 - 1)] = 1_000_000
    gather_photon_count: Count = 20
    gather_radius: Positive = 1e30
    volume_gather_radius: Positive | None = None
    volume_photon_type: Literal["points", "beams", "planes", "planes_1d"] = "points"
    low_order_scattering: bool = True
    include_surfaces: bool = True
    fixed_volume_radius: bool = False
    use_grid: bool = False
    use_frustum_grid: bool = False
    grid_memory: Count = 32 * 1024


@dataclass(frozen=True, eq=False, kw_only=True)
class ProgressivePhotonMap(PhotonMap):
    """Photon mapping with a shrinking radius."""

    kind: ClassVar[str] = "progressive_photon_map"
    alpha: Fraction = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class KelemenMlt(PathTracer):
    """Metropolis light transport in primary sample space."""

    kind: ClassVar[str] = "kelemen_mlt"
    initial_sample_pool: Count = 10_000
    bidirectional: bool = True
    large_step_probability: Fraction = 0.1
    image_pyramid: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class MultiplexedMlt(Integrator):
    """Multiplexed Metropolis light transport."""

    kind: ClassVar[str] = "multiplexed_mlt"
    initial_sample_pool: Count = 3_000_000
    image_pyramid: bool = False
    large_step_probability: Fraction = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class ReversibleJumpMlt(Integrator):
    """Reversible jump Metropolis light transport."""

    kind: ClassVar[str] = "reversible_jump_mlt"
    initial_sample_pool: Count = 3_000_000
    iterations_per_batch: int = -1
    image_pyramid: bool = False
    gaussian_mutation: bool = False
    large_step_probability: Fraction = 0.1
    strategy_perturbation_probability: Fraction = 0.05


# --- The renderer and the scene ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputBuffer:
    """A buffer that Tungsten is to write. Halves A and B come with ``two_buffer_variance``."""

    type: Quantity
    ldr_output_file: str = ""
    hdr_output_file: str = ""
    two_buffer_variance: bool = False
    sample_variance: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class Renderer:
    """How often to sample and what to write. Output paths are as in the file, relative to
    ``output_directory``.

    An empty path means: not written. ``checkpoint_interval`` and ``timeout`` are durations as text, "0" for
    none.
    """

    output_directory: str = ""
    output_file: str = "TungstenRender.png"
    hdr_output_file: str = ""
    variance_output_file: str = ""
    resume_render_file: str = "TungstenRenderState.dat"
    overwrite_output_files: bool = True
    adaptive_sampling: bool = True
    enable_resume_render: bool = False
    stratified_sampler: bool = True
    scene_bvh: bool = True
    spp: Count = 32
    spp_step: Count = 16
    checkpoint_interval: str = "0"
    timeout: str = "0"
    output_buffers: tuple[OutputBuffer, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A scene file; ``path`` is where it was read from, ``input_directory`` where the files it names are.

    None: beside it. ``files`` are all that it names (textures, meshes, ...), whether they are used or not.
    """

    path: Path
    input_directory: Path | None = None
    files: frozenset[Path] = frozenset()
    media: tuple[Medium, ...] = ()
    bsdfs: tuple[Bsdf, ...] = ()
    primitives: tuple[Primitive, ...] = ()
    camera: Camera = PinholeCamera()
    integrator: Integrator = PathTracer()
    renderer: Renderer = Renderer()
