"""ONNX files as data: a graph with its weights inside, or in one file beside it, as torch writes them since 2.9."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper

_PAGE = 65_536  # bytes to which a file of weights may be filled up


def find_data_file(path: Path) -> Path | None:
    """The one file beside an ONNX file that it names for its weights; None if it names none."""
    outside = _read_graph(path)[1]
    names = {field.value for tensor in outside for field in tensor.external_data if field.key == "location"}
    file = path.parent / next(iter(names), "")
    if outside and ({file.name} != names or file.resolve().parent != path.parent.resolve()):
        raise ValueError(f"it must keep its tensors in one file beside it, got {len(outside)} in {', '.join(names)}")
    if outside and not file.is_file():
        raise ValueError(f"it keeps its weights in {file.name}, which is not beside it: copy both files")
    return file if outside else None


def read_onnx(path: Path) -> tuple[Any, bytes]:
    """The graph of a file with all its weights, and its bytes; a ValueError if any are not in the file beside it."""
    model, outside = _read_graph(path)
    file = find_data_file(path)
    data = file.read_bytes() if file else b""
    used = 0
    for tensor in outside:
        fields = {field.key: field.value for field in tensor.external_data}
        size = int(np.prod(tensor.dims)) * helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
        start, length = int(fields.get("offset", 0)), int(fields.get("length", size))
        if length != size or not 0 <= start <= len(data) - size:
            got = f"{length} from {start} on in {file} of {len(data)}"
            raise ValueError(f"'{tensor.name}' must have {size} bytes, got {got}: copy both files of one export")
        used = max(used, start + size)
        tensor.raw_data = data[start : start + size]
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]
    if len(data) > used + _PAGE:
        raise ValueError(f"{file} must have {used:,} bytes, got {len(data):,}: copy both files of one export")
    return model, model.SerializeToString() if outside else path.read_bytes()


def read_metadata(path: Path) -> dict[str, str]:
    """What an exporter wrote into an ONNX file beside its graph, by names."""
    return {item.key: item.value for item in _read_graph(path)[0].metadata_props}


def _read_graph(path: Path) -> tuple[Any, list[Any]]:
    """The graph of a file, and its tensors whose values are in another."""
    try:
        model = onnx.ModelProto.FromString(path.read_bytes())
    except Exception as error:  # protobuf's errors have no base
        raise ValueError(f"{path} is no ONNX file: {error}") from None
    return model, [tensor for tensor in _tensors(model) if tensor.external_data or tensor.data_location]


def _tensors(message: Any) -> Iterator[Any]:
    """Every tensor in a model, those in subgraphs and attributes included."""
    if message.DESCRIPTOR.full_name == "onnx.TensorProto":
        yield message
        return
    for inner in [value for field, value in message.ListFields() if field.message_type is not None]:
        for part in [inner] if hasattr(inner, "DESCRIPTOR") else inner:
            yield from _tensors(part)
