"""Which effects a scene uses, and which buffers are informative for it (docs/scenes.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from typing import Any

from tungsten_dip.buffers.render_buffers import Quantity
from tungsten_dip.scene.types import (
    AtmosphericMedium,
    Bsdf,
    CheckerTexture,
    ConductorBsdf,
    ConstantTexture,
    Curves,
    DielectricBsdf,
    DiffuseTransmissionBsdf,
    ExponentialMedium,
    ForwardBsdf,
    HomogeneousMedium,
    InfiniteSphere,
    InfiniteSphereCap,
    Instances,
    Medium,
    Mesh,
    MinecraftMap,
    MirrorBsdf,
    PathTracer,
    PhongBsdf,
    PlasticBsdf,
    Point,
    Primitive,
    RoughCoatBsdf,
    RoughConductorBsdf,
    RoughDielectricBsdf,
    RoughPlasticBsdf,
    RoughWireBsdf,
    Scene,
    Skydome,
    SmoothCoatBsdf,
    Texture,
    ThinlensCamera,
    ThinSheetBsdf,
    TransparencyBsdf,
    Vec3,
)

_GLOSSY = (
    PhongBsdf,
    RoughCoatBsdf,
    RoughConductorBsdf,
    RoughDielectricBsdf,
    RoughPlasticBsdf,
    RoughWireBsdf,
)
_SPECULAR = (ConductorBsdf, DielectricBsdf, MirrorBsdf, PlasticBsdf, SmoothCoatBsdf, ThinSheetBsdf)
_ALWAYS_SPECULAR = (ConductorBsdf, DielectricBsdf, ForwardBsdf, MirrorBsdf, ThinSheetBsdf)
_ENVIRONMENT = (InfiniteSphere, InfiniteSphereCap, Skydome)

_DEFAULT_SKY = "white sky (no light is in the scene)"
"""The light that Tungsten adds to a scene without lights."""

_MOST_LISTED = 4
"""Names in one line of `inspect_text`."""


@dataclass(frozen=True)
class Effects:
    """The effects that a scene uses. Every field lists the objects that use it, and is empty if none does.

    Only what is in use counts: BSDFs on primitives, media that fill something and are not empty, lights that
    emit.
    """

    depth_of_field: tuple[str, ...]
    glossy_reflection: tuple[str, ...]
    specular_transport: tuple[str, ...]
    transmission: tuple[str, ...]
    transparency: tuple[str, ...]
    participating_media: tuple[str, ...]
    hair: tuple[str, ...]
    textures: tuple[str, ...]
    environment_light: tuple[str, ...]
    max_bounces: int


@dataclass(frozen=True)
class Decision:
    """Which buffers a fit learns from, colour first, and why each is or is not among them."""

    buffers: tuple[Quantity, ...]
    reasons: dict[Quantity, str]


def effects_of(scene: Scene) -> Effects:
    """Return the effects that a scene uses."""
    primitives = list(_primitives(scene))
    bsdfs = list(_bsdfs(primitives))
    media = [
        m for primitive in primitives for m in (primitive.int_medium, primitive.ext_medium) if m is not None
    ]
    if scene.camera.medium is not None:
        media.append(scene.camera.medium)
    textured: list[Bsdf | Primitive] = [
        *bsdfs,
        *(primitive for primitive in primitives if _may_emit(primitive)),
    ]
    environments = _names(p for p in primitives if isinstance(p, _ENVIRONMENT) and _may_emit(p))
    if not any(_may_emit(primitive) for primitive in scene.primitives):
        environments = (_DEFAULT_SKY,)
    aperture = scene.camera.aperture_size if isinstance(scene.camera, ThinlensCamera) else 0.0
    return Effects(
        depth_of_field=(f"camera (aperture {aperture:g})",) if aperture > 0.0 else (),
        glossy_reflection=_names(b for b in bsdfs if isinstance(b, _GLOSSY)),
        specular_transport=_names(b for b in bsdfs if isinstance(b, _SPECULAR)),
        transmission=_names(b for b in bsdfs if _lets_light_in(b)),
        transparency=_names(b for b in bsdfs if _is_crossed_unbent(b)),
        participating_media=_names(m for m in media if not _is_empty(m)),
        hair=_names(p for p in primitives if isinstance(p, Curves)),
        textures=_names(o for o in textured if any(_varies(t) for t in _textures(o))),
        environment_light=environments,
        max_bounces=scene.integrator.max_bounces,
    )


def decision_of(scene: Scene) -> Decision:
    """Return which buffers of a scene a fit learns from."""
    left_out = _reasons_without_information(scene, effects_of(scene))
    informative: dict[Quantity, str] = {
        "color": "the image itself",
        "albedo": "distinguishes surfaces of different colours",
        "normal": "distinguishes surfaces of different orientation",
        "depth": "distinguishes near from far",
    }
    return Decision(
        buffers=tuple(name for name in informative if name not in left_out),
        reasons={**informative, **left_out},
    )


def inspect_facts(scene: Scene) -> dict[str, Any]:
    """Return the content of `inspect_text` as plain objects for JSON."""
    return {
        "scene": str(scene.path),
        "width": scene.camera.resolution[0],
        "height": scene.camera.resolution[1],
        "spp": scene.renderer.spp,
        "camera": scene.camera.kind,
        "tonemap": scene.camera.tonemap,
        "integrator": scene.integrator.kind,
        "primitives": len(scene.primitives),
        "effects": asdict(effects_of(scene)),
        "decision": asdict(decision_of(scene)),
    }


def inspect_text(scene: Scene) -> str:
    """Return the effects that a scene uses and the buffers of a fit, as a table to read."""
    effects, decision = effects_of(scene), decision_of(scene)
    width, height = scene.camera.resolution
    lines = [
        f"{scene.path}: {width} x {height} pixels, {scene.renderer.spp} samples per pixel, "
        f"{len(scene.primitives)} primitives",
        "",
        "effect               used by",
    ]
    for field in fields(effects):
        value = getattr(effects, field.name)
        text = str(value) if isinstance(value, int) else _listed(value)
        lines.append(f"{field.name.replace('_', ' '):<21}{text}")

    lines += ["", f"{'buffer':<21}{'for a fit':<16}why"]
    for buffer, reason in decision.reasons.items():
        use = "learned from" if buffer in decision.buffers else "left out"
        lines.append(f"{buffer:<21}{use:<16}{reason}")
    if scene.integrator.kind != PathTracer.kind:
        lines += [
            "",
            f"{scene.integrator.kind}: Tungsten writes only colour, Mitsuba has only the path_tracer",
        ]
    return "\n".join(lines)


def _reasons_without_information(scene: Scene, effects: Effects) -> dict[Quantity, str]:
    """Return the features that would be constant, or as noisy as the image, with the reason."""
    reasons: dict[Quantity, str] = {
        "visibility": "one random shadow ray a sample: as noisy as the image that it would guide"
    }
    surfaces = [p for p in _primitives(scene) if not isinstance(p, (*_ENVIRONMENT, Point, Instances))]
    if not surfaces:
        reasons["normal"] = reasons["depth"] = "nothing but environment is in the scene"
        if not effects.environment_light:
            reasons["albedo"] = "nothing is in the scene"
        return reasons
    if effects.environment_light or any(_may_emit(surface) for surface in surfaces):
        # Emitters add their radiance to the albedo, and the sky is written as one.
        return reasons
    if any(isinstance(surface, MinecraftMap) for surface in surfaces):
        return reasons
    albedos = {_constant_value(albedo) for surface in surfaces for albedo in _written_albedos(surface)}
    if len(albedos) <= 1 and None not in albedos:
        reasons["albedo"] = "one colour on every surface"
    return reasons


def _written_albedos(surface: Primitive) -> Iterator[Texture]:
    """Yield what Tungsten writes as albedo, unless the path goes on to what a specular surface shows."""
    bsdfs = surface.bsdf if isinstance(surface, Mesh) else (getattr(surface, "bsdf", None),)
    for bsdf in bsdfs:
        if isinstance(bsdf, Bsdf) and not isinstance(bsdf, _ALWAYS_SPECULAR):
            yield bsdf.written_albedo


def _primitives(scene: Scene) -> Iterator[Primitive]:
    """Yield every primitive, and the masters of instances that are placed somewhere."""
    waiting = list(reversed(scene.primitives))
    while waiting:
        primitive = waiting.pop()
        yield primitive
        if isinstance(primitive, Instances):
            waiting.extend(reversed(primitive.masters))


def _bsdfs(primitives: list[Primitive]) -> Iterator[Bsdf]:
    """Yield every BSDF on a primitive and every one within it, each once."""
    waiting: list[Any] = [getattr(primitive, "bsdf", ()) for primitive in reversed(primitives)]
    seen = set()
    while waiting:
        item = waiting.pop()
        if isinstance(item, tuple):
            waiting.extend(reversed(item))
        elif item not in seen:
            seen.add(item)
            yield item
            waiting.extend(value for value in vars(item).values() if isinstance(value, Bsdf))


def _textures(item: Bsdf | Primitive) -> Iterator[Texture]:
    yield from (value for value in vars(item).values() if isinstance(value, Texture))


def _constant_value(texture: Texture) -> Vec3 | None:
    """Return the one value of a texture, or None if it varies."""
    if isinstance(texture, ConstantTexture):
        return texture.value
    if isinstance(texture, CheckerTexture) and texture.on_color == texture.off_color:
        return texture.on_color
    return None


def _varies(texture: Texture) -> bool:
    return _constant_value(texture) is None


def _may_emit(primitive: Primitive) -> bool:
    """Whether a primitive is a light; an image, which is not read here, is assumed to emit."""
    if isinstance(primitive, Skydome):
        return primitive.intensity > 0.0
    return primitive.emitter is not None and _constant_value(primitive.emitter) != (0.0, 0.0, 0.0)


def _is_empty(medium: Medium) -> bool:
    """Whether a medium neither scatters nor absorbs."""
    if not isinstance(medium, HomogeneousMedium | AtmosphericMedium | ExponentialMedium):
        return False
    return medium.density == 0.0 or not any((*medium.sigma_a, *medium.sigma_s))


def _lets_light_in(bsdf: Bsdf) -> bool:
    """Whether light crosses the surface and is bent or scattered there, whatever lies within the BSDF."""
    if isinstance(bsdf, DielectricBsdf | RoughDielectricBsdf):
        return bsdf.enable_refraction
    return isinstance(bsdf, DiffuseTransmissionBsdf)


def _is_crossed_unbent(bsdf: Bsdf) -> bool:
    if isinstance(bsdf, TransparencyBsdf):
        return _constant_value(bsdf.alpha) != (1.0, 1.0, 1.0)
    return isinstance(bsdf, ForwardBsdf | ThinSheetBsdf)


def _names(items: Iterator[Any]) -> tuple[str, ...]:
    """Return what to call objects in messages: their name in the file or else their type, each once."""
    return tuple(dict.fromkeys(f"{item.name} ({item.kind})" if item.name else item.kind for item in items))


def _listed(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
    return ", ".join(names[:_MOST_LISTED]) + more if names else "-"
