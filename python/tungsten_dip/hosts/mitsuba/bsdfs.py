"""Tungsten's BSDFs as Mitsuba's, or as our plugins where Mitsuba has no counterpart.

Tungsten turns a BSDF that does not transmit towards the viewer, which Mitsuba's "twosided" does.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Literal

from tungsten_dip.hosts.mitsuba.scene_builder import Node, SceneBuilder, constant
from tungsten_dip.hosts.mitsuba.textures import UV, slopes_node, texture_node
from tungsten_dip.scene import types as ts
from tungsten_dip.scene.types import Matrix

_LOG = logging.getLogger(__name__)

_LETS_THROUGH = ts.TransparencyBsdf | ts.ThinSheetBsdf | ts.ForwardBsdf
"""What lets light pass straight on, beside what it scatters."""

_SMALLEST_ALPHA = 1e-3  # Tungsten clamps roughness here

# Absorption of the two pigments of hair, per radius.
# d'Eon et al., "An Energy-Conserving Hair Reflectance Model", EGSR 2011.
_EUMELANIN = (0.419, 0.697, 1.37)
_PHEOMELANIN = (0.187, 0.4, 1.05)


BentShape = Literal["mesh", "cube", "quad"]
"""The shapes whose tangents, which a height map bends, are known to "tungsten_bump"."""


def bsdf_object(
    builder: SceneBuilder,
    bsdf: ts.Bsdf,
    uv: Matrix = UV,
    *,
    shape: BentShape | None = None,
    faces_viewer: bool = False,
) -> Any:
    """Return the Mitsuba BSDF for a surface with this parameterisation, and note its albedo texture.

    ``shape`` is what carries it, None for others than a height map can bend. ``faces_viewer`` is for hair on
    curves whose normal Tungsten turns towards the viewer.

    Raises InputError for what has no counterpart.
    """
    heights = height_map(bsdf)
    key = ("bsdf", bsdf, uv.tobytes().hex(), None if heights is None else shape, faces_viewer)
    found = builder.made(key)
    if found is not None:
        return found
    outer = builder.place
    builder.place = f"{outer}, {_named(bsdf)}" if outer else _named(bsdf)
    node = _hair(bsdf, faces_viewer) if isinstance(bsdf, ts.HairBsdf) else _node(builder, bsdf, uv)
    if heights is not None:
        if shape is None:
            raise builder.unsupported("bump mapping of another shape than a mesh, a quad or a cube")
        # Outside of "twosided": Tungsten turns the bent normal towards the viewer.
        node = {
            "type": "tungsten_bump",
            "nested": node,
            "slopes": slopes_node(builder, heights),
            "shape": shape,
        }
    built = builder.add("bsdf", node)
    builder.albedo[built.id()] = texture_node(builder, bsdf.written_albedo, "rgb", uv)
    builder.place = outer
    return builder.remember(key, built)


def height_map(bsdf: ts.Bsdf) -> ts.Texture | None:
    """Return what bends the surface, if anything does: Tungsten computes the slopes of bitmaps alone."""
    flat = ts.ConstantTexture | ts.CheckerTexture | ts.DiskTexture | ts.BladeTexture
    return None if isinstance(bsdf.bump, flat) else bsdf.bump


def _named(bsdf: ts.Bsdf) -> str:
    return f'bsdf "{bsdf.name}"' if bsdf.name else f"bsdf of type {bsdf.kind}"


def _transmits(bsdf: ts.Bsdf) -> bool:
    """Whether Tungsten counts it as transmissive, and does not turn it towards the viewer."""
    match bsdf:
        case ts.DielectricBsdf() | ts.RoughDielectricBsdf():
            return bsdf.enable_refraction
        case ts.SmoothCoatBsdf() | ts.RoughCoatBsdf():
            return _transmits(bsdf.substrate)
        case ts.TransparencyBsdf():
            return _transmits(bsdf.base)
        case ts.MixedBsdf():
            return _transmits(bsdf.bsdf0) or _transmits(bsdf.bsdf1)
        case ts.DiffuseTransmissionBsdf() | ts.HairBsdf() | ts.LambertianFiberBsdf():
            return True
    return False


def _scatters(bsdf: ts.Bsdf) -> bool:
    """Whether Tungsten mixes it by weight alone: it scatters, and lets nothing straight through."""
    match bsdf:
        case ts.SmoothCoatBsdf() | ts.RoughCoatBsdf():
            return _scatters(bsdf.substrate)
        case ts.MixedBsdf():
            return _scatters(bsdf.bsdf0) and _scatters(bsdf.bsdf1)
    return isinstance(
        bsdf,
        ts.LambertBsdf
        | ts.OrenNayarBsdf
        | ts.PhongBsdf
        | ts.RoughConductorBsdf
        | ts.RoughDielectricBsdf
        | ts.PlasticBsdf
        | ts.RoughPlasticBsdf
        | ts.DiffuseTransmissionBsdf,
    )


def _node(builder: SceneBuilder, bsdf: ts.Bsdf, uv: Matrix) -> Node:
    if isinstance(bsdf, ts.TransparencyBsdf):
        if isinstance(bsdf.base, _LETS_THROUGH):
            raise builder.unsupported(
                f"a transparency over a BSDF that lets light through ({bsdf.base.kind})"
            )
        # The mask comes outside: what is behind "twosided" must not transmit.
        opacity = texture_node(builder, bsdf.alpha, "alpha_or_average", uv)
        return {"type": "mask", "opacity": opacity, "nested": _node(builder, bsdf.base, uv)}
    one_sided = _one_sided(builder, bsdf, uv)
    has_both_sides = _transmits(bsdf) or isinstance(bsdf, ts.ThinSheetBsdf | ts.ForwardBsdf)
    turned = builder.source.integrator.enable_two_sided_shading and not has_both_sides
    return {"type": "twosided", "nested": one_sided} if turned else one_sided


def _one_sided(builder: SceneBuilder, bsdf: ts.Bsdf, uv: Matrix) -> Node:
    translate = _TRANSLATORS.get(type(bsdf))
    if translate is None:
        raise builder.unsupported(f"a BSDF of type {bsdf.kind}")
    return translate(builder, bsdf, uv)


def _albedo(builder: SceneBuilder, bsdf: ts.Bsdf, uv: Matrix) -> Any:
    return texture_node(builder, bsdf.albedo, "rgb", uv)


def _lambert(builder: SceneBuilder, bsdf: ts.LambertBsdf, uv: Matrix) -> Node:
    return {"type": "diffuse", "reflectance": _albedo(builder, bsdf, uv)}


def _oren_nayar(builder: SceneBuilder, bsdf: ts.OrenNayarBsdf, uv: Matrix) -> Node:
    roughness = texture_node(builder, bsdf.roughness, "average", uv)
    return {"type": "tungsten_oren_nayar", "albedo": _albedo(builder, bsdf, uv), "roughness": roughness}


def _phong(builder: SceneBuilder, bsdf: ts.PhongBsdf, uv: Matrix) -> Node:
    return {
        "type": "tungsten_phong",
        "albedo": _albedo(builder, bsdf, uv),
        "exponent": bsdf.exponent,
        "diffuse_ratio": bsdf.diffuse_ratio,
    }


def _mirror(builder: SceneBuilder, bsdf: ts.MirrorBsdf, uv: Matrix) -> Node:
    return {"type": "tungsten_conductor", "albedo": _albedo(builder, bsdf, uv)}


def _conductor(builder: SceneBuilder, bsdf: ts.ConductorBsdf, uv: Matrix) -> Node:
    return {
        "type": "tungsten_conductor",
        "albedo": _albedo(builder, bsdf, uv),
        "eta": {"type": "rgb", "value": list(bsdf.eta)},
        "k": {"type": "rgb", "value": list(bsdf.k)},
    }


def _rough_conductor(builder: SceneBuilder, bsdf: ts.RoughConductorBsdf, uv: Matrix) -> Node:
    return {
        "type": "roughconductor",
        "eta": constant(bsdf.eta),
        "k": constant(bsdf.k),
        "specular_reflectance": _albedo(builder, bsdf, uv),
        **_microfacets(builder, bsdf, uv),
    }


def _dielectric(builder: SceneBuilder, bsdf: ts.DielectricBsdf, uv: Matrix) -> Node:
    if not bsdf.enable_refraction:
        return _reflecting_glass(builder, bsdf, uv, {"type": "conductor"})
    return {"type": "dielectric", **_refraction(builder, bsdf, uv)}


_LEAST_BEND = 1e-4


def _rough_dielectric(builder: SceneBuilder, bsdf: ts.RoughDielectricBsdf, uv: Matrix) -> Node:
    if not bsdf.enable_refraction:
        rough = {"type": "roughconductor", **_microfacets(builder, bsdf, uv)}
        return _reflecting_glass(builder, bsdf, uv, rough)
    node = {"type": "roughdielectric", **_refraction(builder, bsdf, uv), **_microfacets(builder, bsdf, uv)}
    # Mitsuba's has no half-vectors where nothing is bent, and refuses.
    return node | {"int_ior": bsdf.ior if abs(bsdf.ior - 1) > _LEAST_BEND else 1 + _LEAST_BEND}


def _reflecting_glass(
    builder: SceneBuilder, bsdf: ts.DielectricBsdf | ts.RoughDielectricBsdf, uv: Matrix, surface: Node
) -> Node:
    """Glass that reflects alone: a ``surface`` of a metal that does not absorb."""
    albedo = _albedo(builder, bsdf, uv)
    front, back = (
        {**surface, "eta": constant(ior), "k": constant(0.0), "specular_reflectance": albedo}
        for ior in (bsdf.ior, 1 / bsdf.ior)
    )
    # What is not turned towards the viewer is seen from within the glass.
    turned = builder.source.integrator.enable_two_sided_shading
    return front if turned else {"type": "twosided", "front": front, "back": back}


def _refraction(builder: SceneBuilder, bsdf: ts.DielectricBsdf | ts.RoughDielectricBsdf, uv: Matrix) -> Node:
    return {
        "int_ior": bsdf.ior,
        "ext_ior": 1.0,
        "specular_reflectance": _albedo(builder, bsdf, uv),
        "specular_transmittance": _albedo(builder, bsdf, uv),
    }


def _microfacets(
    builder: SceneBuilder, bsdf: ts.RoughConductorBsdf | ts.RoughDielectricBsdf, uv: Matrix
) -> Node:
    if bsdf.distribution == "phong":
        raise builder.unsupported(f"a {bsdf.kind} of distribution phong")
    alpha = texture_node(builder, bsdf.roughness, "average", uv, least=_SMALLEST_ALPHA)
    return {"distribution": bsdf.distribution, "alpha": alpha}


def _rough_layer(builder: SceneBuilder, bsdf: ts.RoughPlasticBsdf | ts.RoughCoatBsdf, uv: Matrix) -> Node:
    roughness = texture_node(builder, bsdf.roughness, "average", uv)
    return {"roughness": roughness, "distribution": bsdf.distribution}


def _layer(
    bsdf: ts.PlasticBsdf | ts.RoughPlasticBsdf | ts.SmoothCoatBsdf | ts.RoughCoatBsdf,
) -> Node:
    return {
        "ior": bsdf.ior,
        "sigma_a": {"type": "rgb", "value": [bsdf.thickness * s for s in bsdf.sigma_a]},
    }


def _plastic(builder: SceneBuilder, bsdf: ts.PlasticBsdf | ts.RoughPlasticBsdf, uv: Matrix) -> Node:
    node = {"type": "tungsten_plastic", "albedo": _albedo(builder, bsdf, uv), **_layer(bsdf)}
    return node | _rough_layer(builder, bsdf, uv) if isinstance(bsdf, ts.RoughPlasticBsdf) else node


def _coat(builder: SceneBuilder, bsdf: ts.SmoothCoatBsdf | ts.RoughCoatBsdf, uv: Matrix) -> Node:
    substrate = bsdf.substrate
    if _transmits(substrate) or isinstance(substrate, _LETS_THROUGH):
        raise builder.unsupported(f"a {bsdf.kind} over a BSDF that transmits ({substrate.kind})")
    node = {"type": "tungsten_coat", "nested": _one_sided(builder, substrate, uv), **_layer(bsdf)}
    return node | _rough_layer(builder, bsdf, uv) if isinstance(bsdf, ts.RoughCoatBsdf) else node


def _thinsheet(builder: SceneBuilder, bsdf: ts.ThinSheetBsdf, uv: Matrix) -> Node:
    return {
        "type": "tungsten_thinsheet",
        "ior": bsdf.ior,
        "interference": bsdf.enable_interference,
        "thickness": texture_node(builder, bsdf.thickness, "average", uv),
        "sigma_a": {"type": "rgb", "value": list(bsdf.sigma_a)},
    }


def _diffuse_transmission(builder: SceneBuilder, bsdf: ts.DiffuseTransmissionBsdf, uv: Matrix) -> Node:
    return {"type": "tungsten_diffuse_transmission", "albedo": _albedo(builder, bsdf, uv)}


def _mixed(builder: SceneBuilder, bsdf: ts.MixedBsdf, uv: Matrix) -> Node:
    parts = (bsdf.bsdf0, bsdf.bsdf1)
    for part in parts:
        if isinstance(part, ts.MirrorBsdf | ts.ConductorBsdf | ts.DielectricBsdf):
            # Tungsten's light samples and BSDF samples disagree about the share of the other part.
            _LOG.warning(
                "%s: %s: a mixed BSDF with a specular part (%s) is darker than Tungsten's by up to a sixth; "
                "for the same picture render with --host tungsten",
                builder.source.path, builder.place, part.kind,
            )  # fmt: skip
        elif not _scatters(part):
            raise builder.unsupported(f"a mixed BSDF of a {part.kind}")
    if all(isinstance(part, ts.PlasticBsdf | ts.SmoothCoatBsdf) for part in parts):
        raise builder.unsupported("a mixed BSDF of two smooth layers")
    return {
        "type": "tungsten_mixed",
        "ratio": texture_node(builder, bsdf.ratio, "average", uv),
        "albedo": _albedo(builder, bsdf, uv),
        "bsdf_0": _one_sided(builder, bsdf.bsdf0, uv),
        "bsdf_1": _one_sided(builder, bsdf.bsdf1, uv),
    }


def _null(builder: SceneBuilder, bsdf: ts.NullBsdf, uv: Matrix) -> Node:
    return {"type": "diffuse", "reflectance": constant(0.0)}


def _forward(builder: SceneBuilder, bsdf: ts.ForwardBsdf, uv: Matrix) -> Node:
    return {"type": "null"}


def _hair(bsdf: ts.HairBsdf, faces_viewer: bool) -> Node:
    sigma_a = bsdf.sigma_a
    if sigma_a is None:
        r, g, b = (
            bsdf.melanin_concentration * (eumelanin + bsdf.melanin_ratio * (pheomelanin - eumelanin))
            for eumelanin, pheomelanin in zip(_EUMELANIN, _PHEOMELANIN, strict=True)
        )
        sigma_a = (r, g, b)
    return {
        "type": "tungsten_hair",
        "roughness": bsdf.roughness,
        "scale_angle": bsdf.scale_angle,
        "sigma_a": {"type": "rgb", "value": list(sigma_a)},
        "faces_viewer": faces_viewer,
    }


_TRANSLATORS: dict[type[ts.Bsdf], Callable[[SceneBuilder, Any, Matrix], Node]] = {
    ts.LambertBsdf: _lambert,
    ts.OrenNayarBsdf: _oren_nayar,
    ts.PhongBsdf: _phong,
    ts.MirrorBsdf: _mirror,
    ts.ConductorBsdf: _conductor,
    ts.RoughConductorBsdf: _rough_conductor,
    ts.DielectricBsdf: _dielectric,
    ts.RoughDielectricBsdf: _rough_dielectric,
    ts.PlasticBsdf: _plastic,
    ts.RoughPlasticBsdf: _plastic,
    ts.SmoothCoatBsdf: _coat,
    ts.RoughCoatBsdf: _coat,
    ts.ThinSheetBsdf: _thinsheet,
    ts.DiffuseTransmissionBsdf: _diffuse_transmission,
    ts.MixedBsdf: _mixed,
    ts.NullBsdf: _null,
    ts.ForwardBsdf: _forward,
}
