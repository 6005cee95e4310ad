"""What the previous frame shows of this one: its result, moved to where the camera now sees the same points.

A pixel's depth and the camera give the point that it shows; projected into the previous frame, the four
pixels around it are asked for their colour, each only if it shows the same surface: as in Schied et al. 2017,
"Spatiotemporal Variance-Guided Filtering", section 4.1. Exact for diffuse light in scenes that stand still.
What moved, was hidden or lay outside fails the tests; what they miss (a moved shadow) the fit finds by the
error that it makes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Halves, RenderBuffers
from tungsten_dip.cores import in_pair
from tungsten_dip.errors import InputError
from tungsten_dip.scene.types import Camera, PerspectiveCamera

_DEPTH_TOLERANCE = 0.02
"""Relative difference of distances up to which two pixels show one surface."""

_NORMAL_TOLERANCE = 0.2
"""Difference in each component: normals may be 11 to 20 degrees apart, as on a curved surface from pixel to
pixel."""

_ALBEDO_TOLERANCE = 0.1
"""Difference relative to the larger of 1 and the albedo (a light's is its radiance)."""

_MOVED_ALBEDO_OFFSET = np.float32(0.02)
"""Added to the albedos that light is moved without, on black surfaces too: what one frame divides by another
number than the next one multiplies by would light up at their edges."""

_LEAST_WEIGHT = 0.25
"""Weight of the four pixels around a point, in total; less is the rim of a surface."""


def check_camera(camera: Camera, buffers: RenderBuffers) -> None:
    """Raise InputError if frames cannot be moved with this camera, or it took another or a larger picture."""
    if not isinstance(camera, PerspectiveCamera):
        raise InputError(
            f"camera of type {camera.kind}: expected pinhole or thinlens; leave the cameras out, frames are "
            f"then denoised without their predecessors"
        )
    width, height = camera.resolution
    if width * buffers.height != height * buffers.width:
        raise InputError(
            f"the camera takes {width}x{height} pixels, the buffers have {buffers.width}x{buffers.height}; "
            f"name the scene that they were rendered from"
        )
    # A picture of the camera's size is whole, also if only a part of it is to be displayed.
    if buffers.source is not None and (buffers.width, buffers.height) != (width, height):
        part = buffers.source.main
        if part.is_crop:
            column, row, width, height = part.window
            raise InputError(
                f"expected all that the camera takes, got {width}x{height} pixels from ({column}, {row}) of "
                f"it; render without a crop, or leave the cameras out"
            )


def reproject(
    halves: Halves,
    previous: RenderBuffers,
    previous_camera: Camera,
    current: RenderBuffers,
    camera: Camera,
    threads: int,
) -> Halves:
    """Move the previous frame's halves (linear radiance, shape (height, width, 3)) to the current frame.

    Both buffers are sanitised, have one size and a depth, and albedos with little noise. Where the previous
    frame does not show what the current one does, the result is NaN.
    """
    assert current.depth is not None
    assert isinstance(previous_camera, PerspectiveCamera)
    assert isinstance(camera, PerspectiveCamera)
    shape = current.color.mean.shape
    depth = current.depth.mean[:, :, 0]
    points = _points(camera, depth)
    # Light is moved without the albedo, which the current frame has more sharply. Of that, each half takes
    # its own: errors that it shared with the half which scores it would pass for truth.
    images = [
        (half / albedo).reshape(-1, 3) for half, albedo in zip(halves, _divisors(previous), strict=True)
    ]
    moved_a, moved_b = (np.zeros((depth.size, 3), np.float32) for _ in halves)
    middle = depth.size // 2

    def move(part: slice) -> None:
        column, row, distance = _seen_from(previous_camera, points, depth > 0, part)
        sums = moved_a[part], moved_b[part]
        total = np.zeros(len(distance), np.float32)
        for index, weight in _neighbours(column, row, shape[0], shape[1]):
            weight = weight * _same_surface(previous, index, current, part, distance)
            total += weight
            for sum_of_half, image in zip(sums, images, strict=True):
                sum_of_half += weight[:, None] * image[index]
        total[total < _LEAST_WEIGHT] = np.nan
        for sum_of_half in sums:
            sum_of_half /= total[:, None]

    in_pair(lambda lower: move(slice(middle, None) if lower else slice(middle)), threads)
    albedo_a, albedo_b = _divisors(current)
    return moved_a.reshape(shape) * albedo_a, moved_b.reshape(shape) * albedo_b


_Points = tuple[npt.NDArray[np.float64], FloatArray]
"""A camera's position, and the way from there to what every pixel shows. Far from the origin, float32 holds
positions less finely than pixels see, but it holds the differences of two."""


def _points(camera: PerspectiveCamera, depth: FloatArray) -> _Points:
    """Return what every pixel shows; the way there has length 1 for sky."""
    height, width = depth.shape
    frame = np.asarray(camera.world_from_local, np.float64)
    # Tungsten's PinholeCamera::sampleDirection: x from -1 to 1 over the width, the plane at 1 / tan(fov / 2).
    ray = np.empty((height, width, 3), np.float32)
    ray[:, :, 0] = (np.arange(width) + camera.pixel_center) * 2 / width - 1
    ray[:, :, 1] = (height / width - (np.arange(height) + camera.pixel_center) * 2 / width)[:, None]
    ray[:, :, 2] = camera.plane_distance
    ray /= np.sqrt(np.einsum("...i,...i", ray, ray))[:, :, None]
    world = ray @ _rotation(camera).T.astype(np.float32)
    return frame[:3, 3], world * np.where(depth > 0, depth, 1)[:, :, None]


def _seen_from(
    camera: PerspectiveCamera, points: _Points, hit: npt.NDArray[np.bool_], part: slice
) -> tuple[FloatArray, ...]:
    """Return where a camera sees points, in pixels (far outside if behind it), and how far from it they are.

    Arrays are flat, of a part of the flat image. The distance of the sky is 0.
    """
    height, width = hit.shape
    origin, way = points[0], points[1].reshape(-1, 3)[part]
    hit = hit.ravel()[part]
    position = np.asarray(camera.world_from_local, np.float64)[:3, 3]
    offset = (origin - position).astype(np.float32)
    local = (way + hit[:, None] * offset) @ _rotation(camera).astype(np.float32)
    x, y, z = local.T
    before = z > 0
    scale = np.where(before, camera.plane_distance / np.where(before, z, 1), np.nan) * np.float32(width / 2)
    column = np.where(before, x * scale + width / 2 - camera.pixel_center, -2 * width)
    row = np.where(before, height / 2 - y * scale - camera.pixel_center, -2 * height)
    return column, row, np.where(hit, np.sqrt(np.einsum("ij,ij->i", local, local)), 0)


def _neighbours(
    column: FloatArray, row: FloatArray, height: int, width: int
) -> Iterator[tuple[npt.NDArray[np.intp], FloatArray]]:
    """Yield flat indices and bilinear weights of the four pixels around; the weight is 0 outside."""
    left, top = np.floor(column), np.floor(row)
    right_share, bottom_share = column - left, row - top
    for down in (0, 1):
        y = top + down
        of_row = np.where((y >= 0) & (y < height), bottom_share if down else 1 - bottom_share, 0)
        for across in (0, 1):
            x = left + across
            of_column = np.where((x >= 0) & (x < width), right_share if across else 1 - right_share, 0)
            # A float32 does not tell all pixels of a large image apart.
            in_row, in_column = (np.clip(of, 0, n - 1).astype(np.intp) for of, n in ((y, height), (x, width)))
            yield in_row * width + in_column, (of_row * of_column).astype(np.float32)


def _same_surface(
    previous: RenderBuffers,
    index: npt.NDArray[np.intp],
    current: RenderBuffers,
    part: slice,
    distance: FloatArray,
) -> npt.NDArray[np.bool_]:
    assert previous.depth is not None
    found = previous.depth.mean.ravel()[index]
    same: npt.NDArray[np.bool_] = np.where(
        distance > 0, np.abs(found - distance) <= _DEPTH_TOLERANCE * distance, found == 0
    )
    for before, now, tolerance in (
        (previous.normal, current.normal, _NORMAL_TOLERANCE),
        (previous.albedo, current.albedo, _ALBEDO_TOLERANCE),
    ):
        if before is None or now is None:
            continue
        values = now.mean.reshape(-1, 3)[part]
        difference = np.abs(before.mean.reshape(-1, 3)[index] - values)
        same &= _largest(difference) <= tolerance * np.maximum(1, _largest(values))
    return same


def _largest(values: FloatArray) -> FloatArray:
    """Return the largest of three values, faster than numpy's along a short axis."""
    largest: FloatArray = np.maximum(np.maximum(values[:, 0], values[:, 1]), values[:, 2])
    return largest


def _divisors(buffers: RenderBuffers) -> tuple[FloatImage | np.float32, ...]:
    """Return what divides the colour of each half, so that light is left."""
    albedo = buffers.albedo
    if albedo is None:
        return np.float32(1), np.float32(1)
    return tuple(image + _MOVED_ALBEDO_OFFSET for image in albedo.halves_or_mean)


def _rotation(camera: Camera) -> npt.NDArray[np.float64]:
    columns = np.asarray(camera.world_from_local, np.float64)[:3, :3]
    # A scaled frame scales neither the picture nor the distances along its rays.
    rotation: npt.NDArray[np.float64] = columns / np.linalg.norm(columns, axis=0)
    return rotation
