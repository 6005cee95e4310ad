"""Sessions of onnxruntime: the device, and the number of threads."""

from __future__ import annotations

import os
from typing import Any, Literal

import onnx

from tungsten_dip.errors import InputError
from tungsten_dip.graphs.builder import GraphBuilder

# Read as it is imported: otherwise onnxruntime keeps a device id, and sends what it is used for to Microsoft.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime as ort

Device = Literal["auto", "cpu", "cuda"]

_CUDA, _CPU = "CUDAExecutionProvider", "CPUExecutionProvider"


def check_device(device: Device) -> None:
    """Raise InputError if onnxruntime cannot compute there."""
    if device != "cuda":
        return
    # An onnxruntime that was built for GPUs, but lacks a library of theirs, takes the CPU without a word.
    if _CUDA not in ort.get_available_providers() or _CUDA not in _trial_session().get_providers():
        raise InputError("device cuda: expected an onnxruntime that can use one, found none; use cpu or auto")


def _trial_session() -> Any:
    graph = GraphBuilder()
    graph.add("Identity", "x", output="y")
    return session_from_proto(graph.model("trial", {"x": (1,)}, {"y": (1,)}), 1)


def session_from_proto(proto: onnx.ModelProto, threads: int, device: Device = "auto") -> Any:
    """Return a session that runs a graph of our own; device auto: a GPU if there is one."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    wanted = (_CPU,) if device == "cpu" else (_CUDA, _CPU)
    available = ort.get_available_providers()
    providers = [name for name in wanted if name in available]
    return ort.InferenceSession(proto.SerializeToString(), options, providers=providers)
