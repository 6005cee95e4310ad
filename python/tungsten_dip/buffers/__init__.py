"""Buffers of a render: the data model, files, sanitising, checks of half buffers, pre-filtering."""

from tungsten_dip.buffers.atomic import check_writable, replacing, write_text
from tungsten_dip.buffers.half_buffers import HalvesTest, compare_halves
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.layers import PLANES
from tungsten_dip.buffers.prefilter import prefilter_features
from tungsten_dip.buffers.read import read_buffers, read_image
from tungsten_dip.buffers.render_buffers import CHANNELS, FEATURES, Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.buffers.write import write_denoised, write_error_map, write_tungsten_folder

__all__ = [
    "CHANNELS",
    "FEATURES",
    "PLANES",
    "Buffer",
    "FloatImage",
    "HalvesTest",
    "RenderBuffers",
    "check_writable",
    "compare_halves",
    "prefilter_features",
    "read_buffers",
    "read_image",
    "replacing",
    "sanitize",
    "write_denoised",
    "write_error_map",
    "write_image",
    "write_text",
    "write_tungsten_folder",
]
