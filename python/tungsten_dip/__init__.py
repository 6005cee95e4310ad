"""Denoise path-traced images with a small network fitted to each image alone; no training data needed.

The public names are all here and load on first use: importing the package loads neither torch nor a renderer.

    import tungsten_dip as dip

    buffers = dip.read_buffers("renders/kitchen")
    result = dip.denoise(buffers, dip.FitSettings(preset="draft"))
    dip.write_denoised("kitchen_denoised.exr", result, buffers)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tungsten_dip.interrupts import deferred_interrupts

if TYPE_CHECKING:
    from tungsten_dip.buffers.image_file import write_image
    from tungsten_dip.buffers.read import read_buffers, read_image
    from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
    from tungsten_dip.errors import InputError
    from tungsten_dip.fit import denoise
    from tungsten_dip.fit.model import Model
    from tungsten_dip.fit.result import FitResult, HistoryPoint
    from tungsten_dip.fit.settings import FitSettings
    from tungsten_dip.fit.write import write_denoised
    from tungsten_dip.hosts import render
    from tungsten_dip.onnx import infer, load_model, save_model
    from tungsten_dip.report.metrics import Comparison, compare
    from tungsten_dip.scene.parse import load_scene

    __version__: str

_MODULE_BY_NAME = {
    "Buffer": "buffers.render_buffers",
    "Comparison": "report.metrics",
    "FitResult": "fit.result",
    "FitSettings": "fit.settings",
    "HistoryPoint": "fit.result",
    "InputError": "errors",
    "Model": "fit.model",
    "RenderBuffers": "buffers.render_buffers",
    "compare": "report.metrics",
    "denoise": "fit",
    "infer": "onnx",
    "load_model": "onnx",
    "load_scene": "scene.parse",
    "read_buffers": "buffers.read",
    "read_image": "buffers.read",
    "render": "hosts",
    "save_model": "onnx",
    "write_denoised": "fit.write",
    "write_image": "buffers.image_file",
}

__all__ = [
    "Buffer",
    "Comparison",
    "FitResult",
    "FitSettings",
    "HistoryPoint",
    "InputError",
    "Model",
    "RenderBuffers",
    "__version__",
    "compare",
    "denoise",
    "infer",
    "load_model",
    "load_scene",
    "read_buffers",
    "read_image",
    "render",
    "save_model",
    "write_denoised",
    "write_image",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("tungsten-dip")
    if name not in _MODULE_BY_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with deferred_interrupts():
        module = import_module(f"{__name__}.{_MODULE_BY_NAME[name]}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return __all__
