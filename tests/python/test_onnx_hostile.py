"""Models from elsewhere: nothing hostile gets in."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings, strategies
from onnx import TensorProto, helper

from tungsten_dip.errors import InputError
from tungsten_dip.fit.model import Model
from tungsten_dip.onnx import file as model_file
from tungsten_dip.onnx import load_model
from tungsten_dip.onnx.file import proto_from_model

Spoil = Callable[[onnx.ModelProto], None]


def weight(proto: onnx.ModelProto, name: str = "layer1.weight") -> TensorProto:
    return next(tensor for tensor in proto.graph.initializer if tensor.name == name)


def external(proto: onnx.ModelProto) -> None:
    tensor = weight(proto)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../etc/passwd")


def external_beside_raw(proto: onnx.ModelProto) -> None:
    weight(proto).external_data.add(key="location", value="/etc/passwd")


def huge(proto: onnx.ModelProto) -> None:
    weight(proto).dims[0] = 1 << 40


def negative(proto: onnx.ModelProto) -> None:
    weight(proto).dims[0] = -16


def reshaped(proto: onnx.ModelProto) -> None:
    tensor = weight(proto, "layer2.weight")
    tensor.dims[:] = [256, 1, 1, 1]


def not_finite(proto: onnx.ModelProto) -> None:
    tensor = weight(proto)
    tensor.raw_data = np.float32(np.nan).tobytes() + tensor.raw_data[4:]


def doubles(proto: onnx.ModelProto) -> None:
    weight(proto).data_type = TensorProto.DOUBLE


def strings(proto: onnx.ModelProto) -> None:
    weight(proto).data_type = TensorProto.STRING


def custom_operator(proto: onnx.ModelProto) -> None:
    proto.graph.node[3].op_type = "RunShell"
    proto.graph.node[3].domain = "com.evil"


def custom_domain(proto: onnx.ModelProto) -> None:
    proto.opset_import.add(domain="com.evil", version=1)


def loop(proto: onnx.ModelProto) -> None:
    body = helper.make_graph([], "body", [], [])
    proto.graph.node.append(helper.make_node("Loop", ["", ""], [], body=body))


def branch(proto: onnx.ModelProto) -> None:
    body = helper.make_graph([helper.make_node("Identity", ["color"], ["x"])], "body", [], [])
    proto.graph.node.append(helper.make_node("If", ["color"], ["y"], then_branch=body, else_branch=body))


def function(proto: onnx.ModelProto) -> None:
    node = helper.make_node("Identity", ["a"], ["b"])
    proto.functions.append(helper.make_function("", "Clip", ["a"], ["b"], [node], proto.opset_import))


def attribute(proto: onnx.ModelProto) -> None:
    node = next(node for node in proto.graph.node if node.op_type == "LeakyRelu")
    node.attribute[0].f = 1e30


def constant(proto: onnx.ModelProto) -> None:
    tensor = next(tensor for tensor in proto.graph.initializer if tensor.name == "number 4.0")
    tensor.raw_data = np.float32(1e30).tobytes()


def unused_weight(proto: onnx.ModelProto) -> None:
    proto.graph.initializer.add(
        name="spare.weight", dims=[1], data_type=TensorProto.FLOAT, raw_data=b"\0\0\0\0"
    )


def twice(proto: onnx.ModelProto) -> None:
    proto.graph.initializer.add().CopyFrom(weight(proto))


def missing(proto: onnx.ModelProto) -> None:
    proto.graph.initializer.remove(weight(proto, "std"))


def zero_std(proto: onnx.ModelProto) -> None:
    tensor = weight(proto, "std")
    tensor.raw_data = bytes(len(tensor.raw_data))


def many_nodes(proto: onnx.ModelProto) -> None:
    for _ in range(1 << 17):
        proto.graph.node.add()


def long_name(proto: onnx.ModelProto) -> None:
    proto.graph.node[0].name = "x" * (2 << 20)


def no_metadata(proto: onnx.ModelProto) -> None:
    del proto.metadata_props[:]


def metadata(old: str, new: str) -> Spoil:
    def spoil(proto: onnx.ModelProto) -> None:
        assert old in proto.metadata_props[0].value
        proto.metadata_props[0].value = proto.metadata_props[0].value.replace(old, new, 1)

    return spoil


def whole_metadata(value: str) -> Spoil:
    def spoil(proto: onnx.ModelProto) -> None:
        proto.metadata_props[0].value = value

    return spoil


PILOT = '{"k": null, "kind": "features", "radius": 1, "step": 1, "with_position": false}, '

HOSTILE: list[tuple[Spoil, str]] = [
    (external, "within the file"),
    (external_beside_raw, "within the file"),
    (huge, "raw data of the shape"),
    (negative, "raw data of the shape"),
    (reshaped, r"layer2\.weight: expected shape"),
    (not_finite, "NaN or Inf"),
    (doubles, r"layer1\.weight: expected f4"),
    (strings, r"layer1\.weight: expected f4"),
    (custom_operator, "RunShell"),
    (custom_domain, r"com\.evil"),
    (loop, "Loop"),
    (branch, "If"),
    (function, "functions"),
    (attribute, "constants or attributes"),
    (constant, "constants or attributes"),
    (unused_weight, r"spare\.weight"),
    (twice, "constants or attributes"),
    (missing, "std: expected a weight"),
    (zero_std, "std: expected numbers above 0"),
    (many_nodes, "too many parts"),
    (long_name, "beside the weights"),
    (no_metadata, "tungsten-dip wrote"),
    (metadata('"format": 9', '"format": 1'), "expected format 9, found 1"),
    (metadata('"preset": "draft"', '"preset": "paper"'), "weight|network"),
    (metadata('"extra_pilots": 0', '"extra_pilots": 1000000000000'), "extra_pilots: expected at most 2"),
    (metadata('"extra_pilots": 0', '"extra_pilots": 3'), "extra_pilots: expected at most 2, found 3"),
    (metadata('"extra_pilots": 0', '"extra_pilots": 2'), "inputs"),
    (metadata('"features": [', '"features": [' + 9_999 * '"depth.Z", '), "features: expected each once"),
    (metadata('"baseline": ', '"baseline": 1'), "baseline: expected a number from 1 to 4"),
    (metadata('"baseline": ', '"baseline": -'), "baseline: found -"),
    *(
        (metadata(old, new), "pilots: expected those of the presets of this version, found {'k'")
        for old, new in (
            ('"radius": 1', '"radius": 64'),
            ('"radius": 1', '"radius": 1000000000'),
            ('"radius": 1', f'"radius": {10**400}'),
            ('"step": 1', '"step": 0'),
            ('"radius": 6, "step": 2', '"radius": 6, "step": 4'),
            ('"kind": "features"', '"kind": "median"'),
            ('"kind": "features"', '"kind": ["features"]'),
            ('"kind": "features"', '"kind": "guided"'),
            ('"kind": "guided"', '"kind": "features"'),
            ('"k": 1.0', '"k": 1e-30'),
            ('"k": 1.0', f'"k": {10**400}'),
            ('"with_position"', '"mean"'),
        )
    ),
    (metadata('"pilots": [', '"pilots": [' + 62 * PILOT), "pilots: expected each once, found two of"),
    (metadata('"pilots": [', '"pilots": [], "were": ['), "pilots: expected a list of one or more"),
    (metadata('"pilots": [', '"pilots": {}, "were": ['), "pilots: expected a list of one or more"),
    # Equal in Python, but not what we write.
    (metadata('"step": 1', '"step": true'), "constants or attributes"),
    (metadata('"estimated_relmse": ', '"estimated_relmse": 1e400, "was": '), "estimated_relmse: found inf"),
    (metadata('"estimated_relmse": ', f'"estimated_relmse": {10**400}, "was": '), "relmse: found 1000"),
    (metadata('"format": 9', f'"format": {10**400}'), "expected format 9, found 1000"),
    (metadata('"preset": "draft"', '"preset": ["draft"]'), "preset"),
    (metadata('"channels": [8', '"channels": [-8'), "channels"),
    (metadata('"channels": [8', '"channels": [' + 62 * "8, " + "8"), "channels"),
    (metadata('"channels": [8', '"channels": [' + 20_000 * "8, " + "8"), "channels"),
    (metadata('"seed": 0', '"seed": NaN'), "JSON"),
    (metadata('"baseline error"', '"baseline"'), "inputs"),
    (metadata('"version": "', '"version": "1'), "constants or attributes|graph"),
    (metadata('{"', '{"extra": 1, "'), "graph"),
    (whole_metadata("[" * 100_000), "JSON"),
    (whole_metadata("{"), "JSON"),
    (whole_metadata("[]"), "format"),
    (whole_metadata('{"format": 9}'), "settings"),
]


@pytest.mark.parametrize(("spoil", "message"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_spoilt_file_is_refused_in_one_line(
    spoil: Spoil, message: str, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ort, "InferenceSession", None)
    proto = onnx.load(saved)
    spoil(proto)
    saved.write_bytes(proto.SerializeToString())
    with pytest.raises(InputError, match=message) as raised:
        load_model(saved)
    text = str(raised.value)
    assert text.startswith(f"{saved}: ")
    assert "\n" not in text
    assert len(text) < 500


def test_files_that_are_no_models(tmp_path: Path, saved: Path) -> None:
    cases = {
        "empty": b"",
        "zeros": bytes(5000),
        "noise": np.random.default_rng(0).bytes(5000),
        "endless number": b"\xff" * 100,
        "long part": b"\x3a\xff\xff\xff\xff\xff\xff\xff\x7f",
        "many numbers": b"\x08\x01" * (1 << 18),
        "nested": b"\x3a\x7e" * 64,
        "pickle": b"\x80\x04cos\nsystem\n(S'true'\ntR.",
    }
    for name, content in cases.items():
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(content)
        with pytest.raises(InputError) as raised:
            load_model(path)
        assert str(path) in str(raised.value)
    for name in ("none", "a\0none", "\ud800none", 300 * "a" + "none"):
        with pytest.raises(InputError, match=r"none\.onnx: cannot be read"):
            load_model(tmp_path / f"{name}.onnx")
    for path in (tmp_path, Path(os.devnull)):
        with pytest.raises(InputError, match="expected a file, found a folder or device"):
            load_model(path)


@pytest.mark.parametrize("name", [b"layer1.weight", b"tungsten_dip", b"Conv", b"inputs"])
def test_names_that_are_no_text_are_refused(name: bytes, saved: Path) -> None:
    content = saved.read_bytes()
    assert name in content
    saved.write_bytes(content.replace(name, b"\xff" + name[1:]))
    with pytest.raises(InputError):
        load_model(saved)


def test_nested_graphs_do_not_exhaust_the_stack(model: Model, tmp_path: Path) -> None:
    content = b""
    for _ in range(5000):  # attribute { g: graph { node { attribute ...
        for key in (b"\x2a", b"\x0a", b"\x32"):
            size = len(content)
            length = b""
            while True:
                size, low = size >> 7, size & 0x7F
                length += bytes([low | (0x80 if size else 0)])
                if not size:
                    break
            content = key + length + content
    proto = proto_from_model(model)
    tail = b"\x3a" + _varint(len(content)) + content
    (tmp_path / "m.onnx").write_bytes(proto.SerializeToString() + tail)
    with pytest.raises(InputError):
        load_model(tmp_path / "m.onnx")


def _varint(value: int) -> bytes:
    encoded = b""
    while value > 0x7F:
        encoded += bytes([value & 0x7F | 0x80])
        value >>= 7
    return encoded + bytes([value])


def test_a_file_too_large_is_not_read(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = tmp_path / "large.onnx"
    with sparse.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"at most 64\.0 MiB"):
        load_model(sparse)


@settings(max_examples=60, deadline=None)
@given(data=strategies.data())
def test_bytes_changed_anywhere_are_refused_or_make_another_model(
    data: strategies.DataObject, model: Model
) -> None:
    content = bytearray(proto_from_model(model).SerializeToString())
    cut = data.draw(strategies.integers(0, len(content)))
    if data.draw(strategies.booleans()):
        content = content[:cut]
    for _ in range(data.draw(strategies.integers(0, 3))):
        if content:
            content[data.draw(strategies.integers(0, len(content) - 1))] = data.draw(
                strategies.integers(0, 255)
            )
    try:
        loaded = model_file._model_from_bytes(bytes(content))
    except InputError:
        return
    # What gets through is what we would have written ourselves.
    proto = onnx.ModelProto()
    proto.ParseFromString(bytes(content))
    assert proto_from_model(loaded) == proto
