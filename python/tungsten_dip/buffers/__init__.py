"""Buffers of a render: the data model, mending, statistics of the noise, pre-filtering of features."""

from tungsten_dip.buffers.model import CHANNELS, FEATURES, Buffer, FloatImage, RenderBuffers

__all__ = ["CHANNELS", "FEATURES", "Buffer", "FloatImage", "RenderBuffers"]
