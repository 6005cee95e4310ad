"""Fitted networks as ONNX files: saved, loaded, used and trained further."""

from tungsten_dip.onnx.file import load_model, save_model
from tungsten_dip.onnx.inference import infer

__all__ = ["infer", "load_model", "save_model"]
