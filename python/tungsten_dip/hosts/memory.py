"""How large a picture fits into memory; refuses a render that does not, before it starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from tungsten_dip.buffers.image_file import MAX_PIXELS
from tungsten_dip.buffers.render_buffers import CHANNELS, Quantity
from tungsten_dip.errors import InputError
from tungsten_dip.scene.types import Scene

TUNGSTEN_BYTES_PER_PIXEL = 240
"""Measured at the peak of a render with all its files: 228, of 2000 x 2000 pixels."""

_MITSUBA_BYTES_PER_VALUE = 18
"""Four copies of what the integrator returns, and a bit: measured 16.6 in passes, 12.3 without."""

_RECLAIMABLE = ("inactive_file", "active_file", "slab_reclaimable")
"""What Linux counts as available, too."""


def pixels_that_fit(bytes_per_pixel: int) -> int:
    """Return the size of the largest picture for which there is memory."""
    available = _available_bytes()
    return MAX_PIXELS if available is None else min(MAX_PIXELS, available // bytes_per_pixel)


def too_large(path: Path | str, size: str, most: int) -> InputError:
    """Return the error for a picture of more than ``most`` pixels; ``size`` is its "width x height"."""
    return InputError(
        f"{path}: expected at most {most} pixels, for which there is memory, got {size}; "
        "lower the resolution of the camera"
    )


def check_fits_mitsuba(scene: Scene, quantities: Sequence[Quantity]) -> None:
    """Raise InputError if Mitsuba cannot render these quantities of a scene with the memory available."""
    # Of every quantity both halves and the deviations come back, and a count (mitsuba_ext/tungsten_path.cpp).
    values = sum(3 * CHANNELS[name] + 1 for name in quantities)
    most = pixels_that_fit(values * _MITSUBA_BYTES_PER_VALUE)
    width, height = scene.camera.resolution
    if width * height > most:
        raise too_large(scene.path, f"{width} x {height}", most)


def _available_bytes(root: Path = Path("/")) -> int | None:
    """Return what this process can have without swapping; None on systems that do not report it.

    That is what Linux can hand out, or less if a control group, such as a container, allows less.
    """
    try:
        lines = (root / "proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    free = [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return min([*free, *_allowed_by_groups(root)], default=None)


def _allowed_by_groups(root: Path) -> Iterator[int]:
    """Yield the bytes that the control group (version 2) of this process, and each around it, still allow."""
    try:
        lines = (root / "proc/self/cgroup").read_text(errors="surrogateescape").splitlines()
    except OSError:
        return
    for group in (Path(line.removeprefix("0::/")) for line in lines if line.startswith("0::/")):
        for folder in (root / "sys/fs/cgroup" / part for part in (group, *group.parents)):
            try:
                limit, used, statistics = (
                    (folder / f"memory.{name}").read_text() for name in ("max", "current", "stat")
                )
                by_name = dict(line.split() for line in statistics.splitlines())
                # What is kept of files counts as used, until its memory is needed.
                kept = sum(int(by_name.get(name, 0)) for name in _RECLAIMABLE)
                yield max(0, int(limit) - int(used) + kept)
            except (OSError, ValueError):  # the outermost group has no limit, others may have "max"
                continue
