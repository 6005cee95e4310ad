"""Inputs and training targets of the published method: images in [0, 1], as in Tungsten's PNGs.

Features are those of `buffers.display`, variances are clipped to [0, 1]. Grey images are read as three equal
channels. Here nothing is rounded to 8 bits, and colour is tone-mapped with gamma 2.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tungsten_dip.buffers.display import ldr_from_feature, ldr_from_radiance
from tungsten_dip.buffers.layers import PLANES
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, Quantity, RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.fit.settings import FitSettings

RANDOM_CHANNELS = 3
"""Channels of fixed random input, where there are any."""

RANDOM_INPUT_SCALE = 0.1

_QUANTITY_FROM_INPUTS: dict[str, Quantity] = {"normals": "normal", "depths": "depth", "albedos": "albedo"}
_QUANTITIES: tuple[Quantity, ...] = ("normal", "albedo", "depth")


@dataclass(frozen=True)
class PaperImages:
    """``given`` is the network's input beside ``random_channels``, ``wanted`` the training target.

    Both are float32 in [0, 1], shape (height, width, channels). ``names`` are those of the channels of
    ``given``. The first three channels of ``wanted`` are the colour. ``notes`` are one line on each
    quantity that was missing or left out.
    """

    given: FloatImage
    names: tuple[str, ...]
    random_channels: int
    wanted: FloatImage
    notes: tuple[str, ...]

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the channels of `network_input`."""
        return (*(f"random {index}" for index in range(self.random_channels)), *self.names)


def network_input(images: PaperImages, seed: int) -> FloatImage:
    """Return the network's input, (height, width, channels): fixed random channels, then the given ones."""
    shape = (*images.given.shape[:2], images.random_channels)
    random = np.random.default_rng(seed).random(shape, np.float32) * np.float32(RANDOM_INPUT_SCALE)
    return np.concatenate([random, images.given], axis=2)


def paper_images(buffers: RenderBuffers, settings: FitSettings) -> PaperImages:
    """Gather the images for ``settings.scheme`` and ``settings.inputs``.

    Increased input channels (``iic``): the features go in, the colour comes out. Increased output channels
    (``ioc``): only random channels go in, colour and all features come out. ``all`` holds the noisy colour
    too. Channels of one value carry nothing and are left out.

    Raises InputError if a feature that ``settings.inputs`` names is missing, a value is NaN, or no input
    channel is left.
    """
    color = ldr_from_radiance(buffers.color.mean)
    features = {"color": color} if settings.scheme == "iic" and settings.inputs.startswith("all") else {}
    random_channels = RANDOM_CHANNELS if settings.scheme == "ioc" or "random" in settings.inputs else 0
    notes = []

    quantities: tuple[Quantity, ...] = ()
    if settings.scheme == "ioc" or settings.inputs.startswith("all"):
        quantities = _QUANTITIES
    elif settings.inputs in _QUANTITY_FROM_INPUTS:
        quantities = (_QUANTITY_FROM_INPUTS[settings.inputs],)
        if buffers.get(quantities[0]) is None:
            raise InputError(
                f"inputs {settings.inputs}: expected the buffer {quantities[0]}, found none; "
                f"render it, or use inputs all (what is there) or random"
            )
    for quantity in quantities:
        buffer = buffers.get(quantity)
        missing = tuple(PLANES) if buffer is None else [p for p in PLANES if getattr(buffer, p) is None]
        if missing:
            notes.append(f"{quantity}: no {', '.join(missing)}, used without")
        if buffer is not None:
            features |= _ldr_planes(quantity, buffer)

    stack = np.concatenate([color[:, :, :0], *features.values()], axis=2)
    names = [f"{name} {channel}" for name in features for channel in range(3)]
    if np.isnan(stack).any() or np.isnan(color).any():
        raise InputError("expected buffers without NaN, found NaN; sanitise them first")
    varies = stack.min(axis=(0, 1)) < stack.max(axis=(0, 1))
    if not varies.all():
        notes.append(f"{np.count_nonzero(~varies)} of {varies.size} feature channels are constant: left out")
    stack = np.ascontiguousarray(stack[:, :, varies])
    names = [name for name, kept in zip(names, varies, strict=True) if kept]

    if settings.scheme == "ioc":
        wanted = np.concatenate([color, stack], axis=2)
        return PaperImages(stack[:, :, :0], (), random_channels, wanted, tuple(notes))
    if stack.shape[2] + random_channels == 0:
        raise InputError(
            f"inputs {settings.inputs}: expected a channel that varies over the image, all are constant; "
            f"use inputs random"
        )
    return PaperImages(stack, tuple(names), random_channels, color, tuple(notes))


def _ldr_planes(quantity: Quantity, buffer: Buffer) -> dict[str, FloatImage]:
    """Return every plane that a feature has as three channels in [0, 1]."""
    images = {}
    for plane, values in buffer.planes():
        ldr = np.clip(values, 0, 1) if plane == "variance" else ldr_from_feature(quantity, values)
        images[f"{quantity} {plane}"] = np.broadcast_to(ldr, (*values.shape[:2], 3))
    return images
