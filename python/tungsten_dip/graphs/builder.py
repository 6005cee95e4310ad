"""ONNX graphs, node by node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper

OPSET = 18
IR_VERSION = 8
"""The least that this opset needs: old runtimes read the files as well."""

Dims = Sequence[int | str]


class GraphBuilder:
    """Collects nodes and constants; values are identified by their names."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._initializers: dict[str, onnx.TensorProto] = {}

    def constant(self, name: str, value: npt.NDArray[Any]) -> str:
        """Add an initializer, unless there is one of that name, and return the name."""
        if name not in self._initializers:
            # Raw bytes, whatever the size, so that files can be compared.
            little_endian = np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<"), copy=False)
            self._initializers[name] = helper.make_tensor(
                name,
                helper.np_dtype_to_tensor_dtype(value.dtype),
                value.shape,
                little_endian.tobytes(),
                raw=True,
            )
        return name

    def number(self, value: float) -> str:
        """Add a float32 constant."""
        return self.constant(f"number {value!r}", np.array(value, np.float32))

    def integers(self, *values: int) -> str:
        """Add a vector of int64."""
        return self.constant(f"integers {','.join(map(str, values))}", np.array(values, np.int64))

    def add(self, operator: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Add a node of one output and return the output's name."""
        name = output or f"{operator} {len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def split(self, value: str, sizes: Sequence[int], axis: int = 0) -> list[str]:
        """Cut a tensor into parts of these sizes along an axis."""
        outputs = [f"part {index} of {value}" for index in range(len(sizes))]
        self._nodes.append(helper.make_node("Split", [value, self.integers(*sizes)], outputs, axis=axis))
        return outputs

    def model(
        self,
        name: str,
        inputs: Mapping[str, Dims],
        outputs: Mapping[str, Dims],
        metadata: dict[str, str] | None = None,
        version: str = "",
    ) -> onnx.ModelProto:
        """Return the whole, with float32 inputs and outputs of these dimensions (names: of any size)."""

        def infos(values: Mapping[str, Dims]) -> list[onnx.ValueInfoProto]:
            return [helper.make_tensor_value_info(n, TensorProto.FLOAT, list(d)) for n, d in values.items()]

        graph = helper.make_graph(
            self._nodes, name, infos(inputs), infos(outputs), list(self._initializers.values())
        )
        proto = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="tungsten-dip",
            producer_version=version,
        )
        helper.set_model_props(proto, metadata or {})
        return proto
