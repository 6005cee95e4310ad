"""Fitted networks as ONNX files: saved, loaded, used and trained further."""

from tungsten_dip.fit.model import Model
from tungsten_dip.onnx.file import load_model, save_model
from tungsten_dip.onnx.inference import infer

__all__ = ["Model", "infer", "load_model", "save_model"]
