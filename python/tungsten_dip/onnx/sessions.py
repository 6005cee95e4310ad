"""Where onnxruntime computes."""

from __future__ import annotations

from typing import Any

import onnx
import onnxruntime as ort

_PREFERRED = ("CUDAExecutionProvider", "CPUExecutionProvider")


def session_from_proto(proto: onnx.ModelProto, threads: int) -> Any:
    """Return a session that runs a graph of our own, on a GPU if there is one; threads 0: every core."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    available = ort.get_available_providers()
    providers = [name for name in _PREFERRED if name in available]
    return ort.InferenceSession(proto.SerializeToString(), options, providers=providers)
