"""Models as ONNX files, which may come from an untrusted source.

A file holds the graph, its weights, and one metadata property in JSON. Reading it takes the weights and the
property alone: the graph that runs is always built anew from them, and a file whose own graph is another one
is refused. Nothing in a file names code, and nothing outside of it is read.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import TensorProto, numpy_helper

from tungsten_dip.buffers.atomic import check_writable, replacing
from tungsten_dip.errors import InputError, check_type
from tungsten_dip.fit.layout import Layout, Pilot
from tungsten_dip.fit.model import Blend, Model
from tungsten_dip.fit.presets import (
    BALANCED_PILOTS,
    DRAFT_PILOTS,
    FINAL_PILOTS,
    FOLLOWING_DRAFT_PILOTS,
    FOLLOWING_PILOTS,
)
from tungsten_dip.fit.settings import NETWORK_SETTINGS, FitSettings
from tungsten_dip.fit.standardisation import Standardisation
from tungsten_dip.onnx.graph import graph_of

LARGEST_FILE_BYTES = 64 << 20
LARGEST_STRUCTURE_BYTES = 1 << 20
"""Size of all but the weights: bounds the memory of the parser."""

_FORMAT = 9
"""Raised whenever another graph is written, or the same one has other inputs."""

_PROPERTY = "tungsten_dip"

_NO_ONNX = "expected an ONNX model, found another file or a truncated one; save it again with --save-model"
_MOST_PARTS = 1 << 16
_LARGEST_COUNT = 1 << 16
_PILOTS = (*DRAFT_PILOTS, *BALANCED_PILOTS, *FINAL_PILOTS, *FOLLOWING_DRAFT_PILOTS, *FOLLOWING_PILOTS)
"""What a file may name: filters with any radius could take hours."""

_MOST_EXTRA_PILOTS = 2
"""Open Image Denoise's image and the previous frame."""


def save_model(path: str | Path, model: Model) -> None:
    """Write a model as an ONNX file, whole or not at all.

    Raises InputError if this is no model, it is larger than `load_model` accepts, or the file cannot be
    written.
    """
    check_type("model", model, Model, "a fit returns it as result.model, None if the image has no noise")
    path = Path(path)
    check_writable(path, ".onnx")
    content = proto_from_model(model).SerializeToString(deterministic=True)
    if len(content) > LARGEST_FILE_BYTES:
        raise InputError(
            f"{path}: expected a model of at most {_mib(LARGEST_FILE_BYTES)}, this has {_mib(len(content))}; "
            f"fit one with fewer channels"
        )
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def load_model(path: str | Path) -> Model:
    """Read a model that `save_model` wrote.

    Raises InputError if the file is anything else.
    """
    path = Path(path)
    try:
        # A device may have no end.
        if path.exists() and not path.is_file():
            raise OSError("expected a file, found a folder or device")
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
    except (OSError, ValueError) as error:  # such as a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); check the path") from error
    try:
        return _model_from_bytes(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def proto_from_model(model: Model) -> onnx.ModelProto:
    """Return the model as ONNX.

    Raises InputError if the model's weights are not those of its network.
    """
    facts: dict[str, Any] = {
        "format": _FORMAT,
        "version": model.version,
        "inputs": model.inputs,
        "settings": {name: getattr(model.settings, name) for name in NETWORK_SETTINGS},
        "estimated_relmse": model.estimated_relmse,
        "source_sha256": model.source_sha256,
    }
    if model.blend is not None:
        layout = model.blend.layout
        facts["layout"] = {
            "features": layout.features,
            "pilots": [asdict(pilot) for pilot in layout.pilots],
            "extra_pilots": layout.extra_count,
            "baseline": layout.baseline_index,
        }
    return graph_of(model, {_PROPERTY: json.dumps(facts, sort_keys=True)})


def _model_from_bytes(content: bytes) -> Model:
    if len(content) > LARGEST_FILE_BYTES:
        raise InputError(f"expected a model of at most {_mib(LARGEST_FILE_BYTES)}, this is larger")
    _check_structure(memoryview(content))
    proto = onnx.ModelProto()
    try:
        proto.ParseFromString(content)
    except (DecodeError, RecursionError):
        raise InputError(_NO_ONNX) from None
    facts = _facts(proto)
    tensors = {tensor.name: tensor for tensor in proto.graph.initializer}
    if not all(isinstance(name, str) for name in tensors):  # bytes are what is no UTF-8
        raise InputError("expected weights with names in UTF-8; this is no model of tungsten-dip")
    model = _model_from_facts(facts, tensors)
    _check_same(proto, proto_from_model(model))
    return model


def _check_structure(content: memoryview) -> None:
    """Bound what a parser would allocate: only the raw bytes of weights may be many.

    Walks the top levels of the file (protocol buffers' wire format): model, graph, initializers.
    """
    budget = itertools.islice(itertools.count(), _MOST_PARTS)
    weights = 0
    for number, value in _parts(content, budget):
        if number != onnx.ModelProto.GRAPH_FIELD_NUMBER:
            continue
        for number_in_graph, part in _parts(value, budget):
            if number_in_graph == onnx.GraphProto.INITIALIZER_FIELD_NUMBER:
                raw = onnx.TensorProto.RAW_DATA_FIELD_NUMBER
                weights += sum(len(data) for n, data in _parts(part, budget) if n == raw)
    if len(content) - weights > LARGEST_STRUCTURE_BYTES:
        raise InputError(
            f"expected at most {_mib(LARGEST_STRUCTURE_BYTES)} beside the weights, found "
            f"{_mib(len(content) - weights)}; this is no model of tungsten-dip"
        )


def _parts(message: memoryview, budget: Iterator[int]) -> Iterator[tuple[int, memoryview]]:
    """Yield number and value of every field that has a length; every field uses up one of the budget."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while at < len(message) and shift < 64:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value
        raise InputError(_NO_ONNX)

    while at < len(message):
        if next(budget, None) is None:
            raise InputError("expected a model of tungsten-dip, this has too many parts to be one")
        key = varint()
        length = {0: 0, 1: 8, 2: -1, 5: 4}.get(key & 7)
        if key & 7 == 0:
            varint()
        if length == -1:
            length = varint()
            yield key >> 3, message[at : at + length]
        if length is None or length > len(message) - at:
            raise InputError(_NO_ONNX)
        at += length


def _facts(proto: onnx.ModelProto) -> dict[str, Any]:
    texts = [p.value for p in proto.metadata_props if p.key == _PROPERTY]
    if len(texts) != 1:
        raise InputError("expected a model that tungsten-dip wrote, found another one; use --save-model")
    try:
        facts = json.loads(texts[0], parse_constant=_no_constant)
    except (ValueError, RecursionError):
        raise InputError("expected metadata in JSON, found none that can be read") from None
    if not isinstance(facts, dict) or facts.get("format") != _FORMAT:
        found = facts.get("format") if isinstance(facts, dict) else None
        raise InputError(
            f"expected format {_FORMAT}, found {found!r:.40}; save the model anew with this version"
        )
    return facts


def _no_constant(name: str) -> None:
    raise ValueError(name)


def _model_from_facts(facts: dict[str, Any], tensors: dict[str, TensorProto]) -> Model:
    chosen = _object("settings", facts.get("settings"))
    hints = get_type_hints(FitSettings)
    settings = FitSettings(
        **{name: _checked(name, chosen.get(name), hints[name]) for name in NETWORK_SETTINGS}
    )
    relmse = _checked("estimated_relmse", facts.get("estimated_relmse"), float | None)
    inputs = _checked("inputs", facts.get("inputs"), tuple[str, ...])
    version, source = (_checked(name, facts.get(name), str) for name in ("version", "source_sha256"))
    blend = None
    if settings.preset != "paper":
        layout = _layout(_object("layout", facts.get("layout")))
        if layout.inputs != inputs:
            raise InputError("the inputs are not those of the pilots; this version has other names for them")
        mean, std = (_array(tensors.pop(n, None), n, dtype) for n, dtype in (("mean", "f8"), ("std", "f4")))
        if not (std > 0).all():
            raise InputError("std: expected numbers above 0")
        blend = Blend(layout, Standardisation(mean.ravel(), std.ravel()))
    # Other initializers are constants of the graph, which the comparison of the graphs checks.
    weights = {
        name: _array(tensor, name, "f4")
        for name, tensor in tensors.items()
        if name.endswith((".weight", ".bias"))
    }
    return Model(inputs, weights, settings, relmse, source, blend, version)


def _layout(facts: dict[str, Any]) -> Layout:
    given = facts.get("pilots")
    if not isinstance(given, list) or not given:
        raise InputError("pilots: expected a list of one or more")
    pilots: list[Pilot] = []
    for values in given:
        pilot = next((pilot for pilot in _PILOTS if asdict(pilot) == values), None)
        if pilot is None:
            raise InputError(f"pilots: expected those of the presets of this version, found {values!r:.100}")
        if pilot in pilots:
            raise InputError(f"pilots: expected each once, found two of {values!r:.100}")
        pilots.append(pilot)
    features = _checked("features", facts.get("features"), tuple[str, ...])
    if len(set(features)) < len(features):
        raise InputError("features: expected each once, found one of them twice")
    extra_count, baseline = (_checked(n, facts.get(n), int) for n in ("extra_pilots", "baseline"))
    if extra_count > _MOST_EXTRA_PILOTS:
        raise InputError(f"extra_pilots: expected at most {_MOST_EXTRA_PILOTS}, found {extra_count}")
    layout = Layout(features, tuple(pilots), extra_count, baseline)
    if not 0 < baseline < layout.candidate_count:
        raise InputError(
            f"baseline: expected a number from 1 to {layout.candidate_count - 1}, found {baseline}"
        )
    return layout


def _object(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{name}: expected an object")
    return value


def _checked(name: str, value: Any, hint: Any) -> Any:
    """Return a value of JSON as the type of a hint."""
    if get_origin(hint) is tuple:
        if isinstance(value, list) and len(value) <= _LARGEST_COUNT:
            return tuple(_checked(name, item, get_args(hint)[0]) for item in value)
    elif get_origin(hint) is Literal:
        if isinstance(value, str) and value in get_args(hint):
            return value
    elif isinstance(hint, UnionType):
        if value is None:
            return None
        return _checked(name, value, next(a for a in get_args(hint) if a is not type(None)))
    elif hint is float:
        # Compared rather than converted: a whole number in JSON may be larger than any float.
        largest = sys.float_info.max
        if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= largest:
            return value
    elif hint is int:
        if type(value) is int and 0 <= value < 1 << 63:
            return value
    elif isinstance(value, hint):
        return value
    raise InputError(f"{name}: found {value!r:.40}, which tungsten-dip does not write")


def _array(tensor: TensorProto | None, name: str, dtype: str) -> np.ndarray[Any, Any]:
    """Return an initializer's values, with no more memory than the file has bytes for them."""
    if tensor is None:
        raise InputError(f"{name}: expected a weight of that name, found none")
    expected = TensorProto.DOUBLE if dtype == "f8" else TensorProto.FLOAT
    if tensor.data_location != TensorProto.DEFAULT or tensor.external_data:
        raise InputError(f"{name}: expected weights within the file, these are in another one")
    if tensor.data_type != expected:
        raise InputError(f"{name}: expected {dtype} numbers, found type {tensor.data_type}")
    count = math.prod(tensor.dims) if all(0 < d <= _LARGEST_COUNT for d in tensor.dims) else -1
    if len(tensor.dims) > 4 or count * np.dtype(dtype).itemsize != len(tensor.raw_data):
        raise InputError(f"{name}: expected raw data of the shape that it names, found other data")
    array = numpy_helper.to_array(tensor).copy()
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite weights, found NaN or Inf")
    return array


def _check_same(found: onnx.ModelProto, expected: onnx.ModelProto) -> None:
    """Raise InputError unless the file's graph is the very one that the model's weights belong to."""
    if found.SerializeToString(deterministic=True) == expected.SerializeToString(deterministic=True):
        return
    domains = [entry.domain for entry in found.opset_import]
    operators = [[node.op_type for node in proto.graph.node] for proto in (found, expected)]
    what = "it differs in its constants or attributes"
    if domains != [""]:
        what = f"it uses operators of the domains {domains!r:.60}"
    elif found.functions or found.training_info or found.graph.sparse_initializer:
        what = "it holds functions, training information or sparse weights"
    elif operators[0] != operators[1]:
        strange = [name for name in operators[0] if name not in operators[1]]
        what = f"it computes {strange[0]!r:.40}" if strange else "it has other operators or another order"
    raise InputError(f"the graph is not the one that tungsten-dip writes for these weights: {what}")


def _mib(size: int) -> str:
    return f"{size / (1 << 20):.1f} MiB"
