"""Constants of the published method, also for code without torch: ONNX graphs, commands and tables.

From the published code; ``docs/method.md`` states the method whole.
"""

ITERATIONS = 3000
"""Iterations of a fit."""

LEAKY_SLOPE = 0.2
"""Slope of the leaky ReLU below zero."""

NORM_EPSILON = 1e-5
"""Added to the variance that a batch norm divides by (PyTorch's default)."""

SIDE_CHANNELS = 4
"""Channels of each of Skip's connections across, at the coarsest `SIDE_SCALES` scales."""

SIDE_SCALES = 2

RESNET_BLOCKS = 10
RESNET_WIDTH = 32
"""Channels of every convolution but the last."""
