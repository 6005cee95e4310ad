"""Which layer of an image holds which quantity: the names that renderers give to their layers.

| renderer | colour | features |
|---|---|---|
| Tungsten (one file each) | color | albedo, normal, depth, visibility, each also with A, B, Variance |
| Blender | ViewLayer.Noisy Image, .Combined | .Denoising Albedo, .DiffCol, .Denoising Normal, .Depth |
| Arnold | RGBA (top level) | denoise_albedo, diffuse_albedo, N, Z, and N_noice, Z_noice |
| pbrt-v4 | top level | Albedo, Ns, N, Variance (of one sample; attribute samplesPerPixel) |
| Mitsuba 3 | top level | as the user named them: albedo, nn, sh_normal, dd.y, depth |
| LuxCore | top level | ALBEDO, AVG_SHADING_NORMAL, DEPTH |
| V-Ray | top level | diffuseFilter, normals |
| ours | noisy (top level is the denoised picture) | as in the input |
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from tungsten_dip.buffers.render_buffers import CHANNELS, TRAITS
from tungsten_dip.errors import InputError

ALIASES: dict[str, tuple[str, ...]] = {
    **{quantity: traits.layers for quantity, traits in TRAITS.items()},
    "spp": ("spp",),
}
"""The names of layers, as in `Traits`, of every quantity and of the number of samples."""

_NOISY = ("noisy image", "noisy")
_SHOWN = ("combined", "rgba")

_THREE_CHANNELS = tuple(quantity for quantity, count in CHANNELS.items() if count == 3)

PLANES = {"mean": "", "half_a": "A", "half_b": "B", "variance": "Variance"}
"""The fields of a Buffer, and what Tungsten appends to a quantity's name for each."""

MAP_KEYS = (*(quantity + suffix for quantity in CHANNELS for suffix in PLANES.values()), "alpha")
"""The keys of --map: color, colorA, colorB, colorVariance, albedo, ..., alpha."""

NOTHING = "none"
"""The value of --map that excludes a quantity."""

_COMPONENTS = ("RGB", "XYZ", ("RED", "GREEN", "BLUE"))

_NO_LAYER = "m2_"
"""Begins the names of second moments, which Mitsuba's integrator "moment" writes beside every layer."""

_COMPOSITE = "composite."
"""Begins the names of Blender's layers that its compositor made, perhaps graded already."""

Layers = dict[str, dict[str, str]]


@dataclass(frozen=True)
class Found:
    """What was recognised: channel names per key of --map, and the layers that are not used."""

    channels: dict[str, tuple[str, ...]]
    ignored: tuple[str, ...]


def find_layers(channel_names: Iterable[str], mapping: Mapping[str, str], default: str = "") -> Found:
    """Assign channels to quantities, by the names of the channels and by ``mapping``.

    A value of ``mapping`` is a layer, a channel, several channels joined by commas, or "none". ``default`` is
    the layer that is the colour if no layer is named so, unless its own name is that of another quantity.

    Raises InputError if a mapping names what is not there, or if no colour is found.
    """
    names = list(channel_names)
    layers = _layers(names)
    unknown = [key for key in mapping if key not in MAP_KEYS]
    if unknown:
        raise InputError(f"--map {unknown[0]}=...: expected one of {', '.join(MAP_KEYS)}")
    channels: dict[str, tuple[str, ...]] = {}
    color_prefix = ""
    for quantity in CHANNELS:
        layer: str | None
        if quantity in mapping:
            if mapping[quantity] == NOTHING:
                continue
            channels[quantity] = _mapped(quantity, mapping[quantity], names, layers)
            layer = mapping[quantity]
        else:
            layer = _match(quantity, layers, color_prefix)
            if layer is None and quantity == "color" and _may_be_color(default, layers):
                layer = default
            if layer is None:
                continue
            channels[quantity] = _ordered(layers[layer])
        if quantity == "color":
            color_prefix = _view_layer(channels["color"][0], layers)
        _add_planes(channels, quantity, layer, names, layers, mapping)
    check_no_chroma(channels.get("color", ()), names)
    if "color" not in channels:
        found = _listed(layers) or "nothing"
        raise InputError(f"no colour: expected R, G, B or layer color, found {found}; use --map color=LAYER")
    alpha = _alpha(channels["color"], names, layers, mapping)
    if alpha:
        channels["alpha"] = alpha
    spp = _match("spp", layers, color_prefix)
    if spp is not None:
        channels["spp"] = _ordered(layers[spp])
    for key, value in mapping.items():
        if value != NOTHING and key not in channels:
            raise InputError(f"--map {key}={value}: there is no mean that this belongs to; map that too")
    used = {name for group in channels.values() for name in group}
    ignored = tuple(
        layer or "top level" for layer, components in layers.items() if used.isdisjoint(components.values())
    )
    return Found(channels, ignored)


def planes_of_output(two_buffer_variance: bool, sample_variance: bool) -> list[str]:
    """Return the planes that Tungsten writes of a buffer with these settings."""
    halves = ["half_a", "half_b"] if two_buffer_variance else []
    return ["mean", *halves, *(["variance"] if sample_variance else [])]


def denoised_layer(channel_names: Iterable[str]) -> str | None:
    """Return the layer that a renderer's own denoiser made of a noisy one in the same file, if there is one.

    Blender keeps the noisy picture as "Noisy Image" beside "Combined".
    """
    names = set(channel_names)
    layers = {name.rpartition(".")[0] for name in names}
    by_name = {layer.lower(): layer for layer in layers if {f"{layer}.{c}" for c in "RGB"} <= names}
    shown = [
        by_name[before + dot + alias]
        for before, dot, last in (name.rpartition(".") for name in by_name)
        for alias in _SHOWN
        if last in _NOISY and before + dot + alias in by_name
    ]
    return shown[0] if len(shown) == 1 else None


def view_layers(color: Iterable[str], channel_names: Iterable[str]) -> list[str]:
    """Return the view layers that hold a picture, if the channels of the colour are those of one of them.

    Blender names its layers ``VIEW LAYER.Combined``.
    """
    pictures: dict[str, set[str]] = {}
    for layer, components in _layers(list(channel_names)).items():
        before, _, last = layer.rpartition(".")
        is_result = f"{before}.".lower() == _COMPOSITE
        if before and not is_result and last.lower() in ALIASES["color"] and len(_ordered(components)) == 3:
            pictures.setdefault(before, set()).update(components.values())
    return list(pictures) if any(not channels.isdisjoint(color) for channels in pictures.values()) else []


def check_no_chroma(color: Iterable[str], channel_names: Iterable[str]) -> None:
    """Raise InputError if the channels of the colour are luminance, and others of the file its chroma."""
    if "Y" in map(str.upper, color) and {"RY", "BY"} <= set(channel_names):
        raise InputError(
            "the colour is luminance and chroma (Y, RY, BY): expected R, G, B; convert the image"
        )


def names_quantity(layer: str) -> bool:
    """Return whether a layer of this name may be taken for a quantity, or for one of its planes."""
    matches = any(_match(quantity, {layer: {"": ""}}, "") is not None for quantity in ALIASES)
    return matches or layer.lower().startswith((*CHANNELS, "variance"))


def mapped_channels(value: str, channel_names: Iterable[str]) -> tuple[str, ...]:
    """Return the channels that a value of --map names, none if they are not there or of no known order."""
    names = list(channel_names)
    try:
        return _mapped("", value, names, _layers(names))
    except InputError:
        return ()


def _layers(names: list[str]) -> Layers:
    """Group channels: layer -> component in upper case -> channel."""
    layers: Layers = {}
    for name in names:
        layer, _, component = name.rpartition(".")
        if not layer and component.upper() not in ("R", "G", "B", "A", "Y"):
            layer, component = name, ""  # a bare Z, depth or id is a layer by itself
        components = layers.setdefault(layer, {})
        # Of two spellings one is right, in whatever order the file has them: R rather than r.
        components[component.upper()] = min(name, components.get(component.upper(), name))
    for layer, components in list(layers.items()):
        if {"R", "G", "B"} <= components.keys():
            for component in components.keys() - {"R", "G", "B", "A"}:
                layers[f"{layer}.{component}"] = {"": components.pop(component)}
    return layers


def _view_layer(channel: str, layers: Layers) -> str:
    """Return what precedes the layer in the name of a channel, in lower case, with its dot.

    It is empty if that is no view layer: if it precedes no layer that is named for a quantity.
    """
    view_layer, dot, _ = channel.lower().rpartition(".")[0].rpartition(".")
    prefix = view_layer + dot
    named = {prefix + alias for aliases in ALIASES.values() for alias in aliases if alias}
    return "" if named.isdisjoint(layer.lower() for layer in layers) else prefix


def _match(quantity: str, layers: Layers, color_prefix: str) -> str | None:
    """Find the best layer that is named for a quantity, None if there is none.

    What precedes the alias in a layer's name is its view layer. The best layer is, in this order,

    1. one of the colour's view layer; for the colour itself, one that Blender's compositor did not make,
    2. one of three channels, if the quantity has three,
    3. the one whose alias is the better one (`ALIASES`),
    4. the one whose view layer contains most layers,
    5. the first in the alphabet.

    If the colour is in a view layer, none of another one is taken: it shows other objects. What the
    compositor made counts as no view layer here.
    """
    matches = []
    for layer, components in layers.items():
        name, count = layer.lower(), len(_ordered(components))
        named = (a for a in ALIASES[quantity] if name == a or (a and name.endswith("." + a)))
        alias = next(named, None)
        if alias is None or name.startswith(_NO_LAYER) or count == 0:
            continue
        prefix = name.removesuffix(alias)
        if quantity == "color":
            elsewhere = prefix == _COMPOSITE
        else:
            elsewhere = prefix != color_prefix
            if elsewhere and prefix and color_prefix not in ("", _COMPOSITE):
                continue
        # One channel called color may be an id, beside the three that are the colour.
        # Beside a noisy grey picture, R, G, B are what was made of it.
        noisy_grey = alias == "noisy" and "Y" in components
        too_few = quantity in _THREE_CHANNELS and count < 3 and not noisy_grey
        held = sum(other.lower().startswith(prefix) for other in layers) if prefix else 0
        matches.append((elsewhere, too_few, ALIASES[quantity].index(alias), -held, layer))
    return min(matches)[-1] if matches else None


def _may_be_color(layer: str, layers: Layers) -> bool:
    named_for_another = any(_match(quantity, {layer: {"": ""}}, "") is not None for quantity in CHANNELS)
    return len(_ordered(layers.get(layer, {}))) == 3 and not named_for_another


def _ordered(components: dict[str, str]) -> tuple[str, ...]:
    """Channels of a layer without alpha: in the order of a known triple, or the only one; else none."""
    for triple in _COMPONENTS:
        if all(component in components for component in triple):
            return tuple(components[component] for component in triple)
    rest = [name for component, name in components.items() if component != "A"]
    return tuple(rest) if len(rest) == 1 else ()


def _mapped(key: str, value: str, names: list[str], layers: Layers) -> tuple[str, ...]:
    channels = tuple(part.strip() for part in value.split(","))
    if all(channel in names for channel in channels):
        return channels
    layer = next((layer for layer in layers if layer == value or layer.lower() == value.lower()), None)
    if layer is None:
        raise InputError(f"--map {key}={value}: no such layer or channel; there are {_listed(layers)}")
    ordered = _ordered(layers[layer])
    if not ordered:
        raise InputError(
            f"--map {key}={value}: expected R, G, B or X, Y, Z or one channel, found "
            f"{', '.join(layers[layer].values())}; name the channels, joined by commas"
        )
    return ordered


def _listed(layers: Layers) -> str:
    """Return the names of the layers, and of the channels at the top level."""
    return ", ".join(name or ", ".join(components.values()) for name, components in layers.items())


def _add_planes(
    channels: dict[str, tuple[str, ...]],
    quantity: str,
    layer: str,
    names: list[str],
    layers: Layers,
    mapping: Mapping[str, str],
) -> None:
    """Add halves and variance of a quantity whose mean is ``layer``."""
    for suffix in list(PLANES.values())[1:]:
        key = quantity + suffix
        if key in mapping:
            if mapping[key] != NOTHING:
                channels[key] = _mapped(key, mapping[key], names, layers)
            continue
        wanted = {name.lower() for name in (quantity + suffix, layer + suffix, f"{layer}_{suffix}")}
        match = next((other for other in layers if other.lower() in wanted and _ordered(layers[other])), None)
        if match is not None:
            channels[key] = _ordered(layers[match])


def _alpha(
    color: tuple[str, ...], names: list[str], layers: Layers, mapping: Mapping[str, str]
) -> tuple[str, ...]:
    if "alpha" in mapping:
        return () if mapping["alpha"] == NOTHING else _mapped("alpha", mapping["alpha"], names, layers)
    # Of two spellings, such as R and r, only one is in the layers.
    own = next((components for components in layers.values() if color[0] in components.values()), {})
    alpha = own.get("A") or own.get("ALPHA") or layers.get("", {}).get("A")
    return () if alpha is None else (alpha,)
