"""What was read: raw channels that are copied unchanged from the input file to the output file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from tungsten_dip.buffers.render_buffers import Buffer

OWN = "tungsten_dip/"
"""Prefix of the names of our own attributes."""

ADDED = OWN + "added"
"""Attribute: the channels of the first part that `write_layers` added."""

MOVED_TO = OWN + "moved_to"
"""Attribute: the layer that holds input channels whose names `write_layers` needed itself."""

MAP = OWN + "map"
"""Attribute: the --map of the input, as JSON."""

SPP = OWN + "spp"
"""Attribute: samples per pixel."""

FRAME = {"dataWindow", "displayWindow", "pixelAspectRatio", "screenWindowCenter", "screenWindowWidth"}
"""Attributes of an EXR header that describe the position of the pixels; the others describe their origin."""

Channel = npt.NDArray[Any]
"""float16, float32 or uint32, shape (height, width), as in the file."""


@dataclass(frozen=True)
class Part:
    """One image of a file: its channels in the order of the file, and the attributes of its (EXR) header.

    The data window and the display window are among the attributes where they matter. What was read as
    float32 becomes, in place, a view of the image that `read_buffers` makes of it: at 4K, a second copy of
    all channels would take more than a GiB.
    """

    channels: dict[str, Channel]
    attributes: dict[str, Any] = field(default_factory=dict)
    name: str = ""

    @property
    def window(self) -> tuple[int, int, int, int]:
        """Column and row of the first pixel (the corner of the EXR data window), width and height."""
        column, row = self.attributes.get("dataWindow", ((0, 0),))[0]
        height, width = next(iter(self.channels.values())).shape
        return int(column), int(row), width, height

    @property
    def is_crop(self) -> bool:
        """Whether these pixels are others than those to be displayed: EXR's two windows differ."""
        data, display = (self.attributes.get(name, ()) for name in ("dataWindow", "displayWindow"))
        return not np.array_equal(data, display)


@dataclass(frozen=True)
class Source:
    """The parts of an input file, the --map that assigned its layers, and which part holds the colour.

    ``read`` is what was made of it: the quantities, ``alpha`` and ``spp``, by name.
    """

    parts: tuple[Part, ...]
    mapping: Mapping[str, str] = field(default_factory=dict)
    color_part: int = 0
    read: Mapping[str, Buffer | Channel | float | None] = field(default_factory=dict)

    @property
    def main(self) -> Part:
        """The part that holds the colour."""
        return self.parts[self.color_part]
