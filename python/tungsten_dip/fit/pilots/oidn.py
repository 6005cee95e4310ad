"""Intel Open Image Denoise, which was trained on many images: a denoiser to compare with, and a pilot.

https://www.openimagedenoise.org, through the package ``pyoidn``, on the CPU.
"""

from __future__ import annotations

import logging
from typing import Any, Literal

import numpy as np

from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError
from tungsten_dip.extras import require
from tungsten_dip.fit.pilots.surfaces import images_for

_LOG = logging.getLogger(__name__)

Quality = Literal["fast", "balanced", "high"]


def oidn_image(
    color: FloatImage,
    albedo: FloatImage | None = None,
    normal: FloatImage | None = None,
    *,
    quality: Quality = "high",
    threads: int | None = None,
) -> FloatImage:
    """Denoise one image with Open Image Denoise, in its HDR mode.

    All images are float32 of shape (height, width, 3): linear radiance, albedo (clipped to [0, 1] in there)
    and normals in [-1, 1], as noisy as they were rendered. Values that are not finite are repaired first;
    the arguments are not modified. It uses normals only together with an albedo; without one they are left
    out, and the log reports it. ``threads`` None uses every core. The result is finite linear radiance.

    Raises InputError if the image is empty, the shapes differ, pyoidn is not installed, or the processor is
    not one that Open Image Denoise supports.
    """
    if color.size == 0:
        raise InputError(f"expected an image of at least one pixel, got one of shape {color.shape}")
    require("pyoidn", "Open Image Denoise")
    import pyoidn

    if normal is not None and albedo is None:
        _LOG.info("Open Image Denoise uses normals only together with an albedo: the normals are left out")
        normal = None
    given: dict[str, Any] = {
        name: Buffer(np.ascontiguousarray(image))
        for name, image in (("color", color), ("albedo", albedo), ("normal", normal))
        if image is not None
    }
    threads = thread_count(threads)
    repaired, _ = sanitize(RenderBuffers(**given), threads)
    images: dict[str, FloatImage] = {name: buffer.mean for name, buffer in repaired.quantities()}
    images["output"] = np.empty_like(images["color"])
    qualities = {
        "fast": pyoidn.OIDN_QUALITY_FAST,
        "balanced": pyoidn.OIDN_QUALITY_BALANCED,
        "high": pyoidn.OIDN_QUALITY_HIGH,
    }
    with pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CPU) as device:
        device.set_int("numThreads", threads)
        device.commit()
        with pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT) as denoiser:
            for name, image in images.items():
                denoiser.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
            denoiser.set_bool("hdr", True)
            denoiser.set_quality(qualities[quality])
            denoiser.commit()
            denoiser.execute()
        error = device.get_error()
    if error is not None:
        raise InputError(f"Open Image Denoise: {' '.join(error.split())}; use another method on this machine")
    return images["output"]


def oidn_pilot(
    buffers: RenderBuffers, colors: tuple[FloatImage, ...], threads: int
) -> tuple[FloatImage, ...]:
    """Denoise both halves, each with its own features alone, or the mean; the results are never negative.

    ``colors`` are the two halves, or the mean alone, shape (height, width, 3), linear radiance in the units
    of `evidence.Evidence`: in a renderer's, Open Image Denoise would take very dark images for black. So are
    the results.
    """
    features = (
        images_for(colors, feature) if feature else [None] * len(colors)
        for feature in (buffers.albedo, buffers.normal)
    )
    return tuple(
        np.maximum(oidn_image(color, *given, threads=threads), 0)
        for color, *given in zip(colors, *features, strict=True)
    )
