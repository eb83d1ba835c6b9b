"""Controllers in ONNX files: data alone, from one file, run by onnxruntime; and checkpoints written as such files."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper

from sim.files.atomic import prepare_output, write_atomically
from sim.policy.mlp import MlpPolicy

_OPSET, _IR_VERSION = 17, 8  # of 2022: what runs on robots is rarely new
_CPU, _CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"


class OnnxPolicy:
    """A controller that onnxruntime runs: where the observations are if it can, else on the CPU, with copies."""

    def __init__(self, session: Any, sizes: tuple[int, int], device: torch.device) -> None:
        """Of a session with one float32 input and one output, of these observation and action sizes, on its device."""
        self.sizes = sizes
        self.device = device
        self._session = session
        self._input, self._output = session.get_inputs()[0].name, session.get_outputs()[0].name

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions (num_envs, num_joints) on the device of the observations (num_envs, observation_size)."""
        rows = observation.detach().to(self.device, torch.float32).contiguous()
        action = torch.empty((len(rows), self.sizes[1]), device=self.device)
        binding = self._session.io_binding()
        for bind, name, tensor in (
            (binding.bind_input, self._input, rows),
            (binding.bind_output, self._output, action),
        ):
            bind(name, self.device.type, self.device.index or 0, np.float32, tuple(tensor.shape), tensor.data_ptr())
        if self.device.type == "cuda":  # it has a stream of its own: ours must be done before, and it waits at its end
            torch.cuda.current_stream(self.device).synchronize()
        self._session.run_with_iobinding(binding)
        return action.to(observation.device)


def load_onnx(path: Path, sizes: tuple[int, int] | None, device: str) -> OnnxPolicy:
    """Load a controller from an ONNX file.

    Nothing but that file is read and no code in it runs: weights beside it are refused, and onnxruntime knows only its
    own operators. It is read by onnxruntime's C++, which a file made to harm can crash.

    Args:
        path: The file; its graph takes observations (batch, observation_size) and gives actions (batch, num_joints),
            both float32, for any batch.
        sizes: Observation and action size of the robot; None takes whatever the file has.
        device: Torch device name; on CUDA the graph runs on the GPU if onnxruntime is built for it, else on the CPU.
    """
    where = torch.device(device)
    try:
        data = path.read_bytes()
        _check_all_inside(data)
        session = _open_session(data, where)
        sizes = _checked_sizes(session, sizes)
    except Exception as error:  # protobuf and onnxruntime have errors of their own, without a base
        raise ValueError(f"policy '{path}' is no ONNX file of this robot: {error}: export it anew") from None
    if where.type == "cuda" and session.get_providers()[0] != _CUDA:
        warnings.warn(
            f"policy '{path}' runs on the CPU, with copies to and from {device} every control step: this onnxruntime "
            "has no CUDA that works; install onnxruntime-gpu, or give the rsl_rl checkpoint",
            stacklevel=2,
        )
        where = torch.device("cpu")
    return OnnxPolicy(session, sizes, where)


def _check_all_inside(data: bytes) -> None:
    model = onnx.ModelProto.FromString(data)
    if not model.graph.node:
        raise ValueError("it has no graph")
    outside = [tensor.name for tensor in _tensors(model) if tensor.external_data or tensor.data_location]
    if outside:
        raise ValueError(f"it keeps {len(outside)} of its tensors in another file ('{outside[0]}' first)")


def _tensors(message: Any) -> Iterator[Any]:
    """Every tensor in a model, those in subgraphs and attributes included."""
    if message.DESCRIPTOR.full_name == "onnx.TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in [value] if hasattr(value, "DESCRIPTOR") else value:
                yield from _tensors(inner)


def _open_session(data: bytes, device: torch.device) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()  # one in worker processes, as prepare_torch has it
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong comes as an exception
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers: list[Any] = [_CPU]
    if device.type == "cuda" and _CUDA in onnxruntime.get_available_providers():
        # TF32 would round every product to 10 bits.
        providers = [(_CUDA, {"device_id": str(device.index or 0), "use_tf32": "0"}), _CPU]
    return onnxruntime.InferenceSession(data, options, providers=providers, enable_fallback=0)


def _checked_sizes(session: Any, sizes: tuple[int, int] | None) -> tuple[int, int]:
    """Widths of input and output; refuses a graph that is not one batch of float32 rows of these sizes to another."""
    widths: list[Any] = []
    for kind, ports in (("input", session.get_inputs()), ("output", session.get_outputs())):
        if len(ports) != 1:
            raise ValueError(f"it must have one {kind}, got {len(ports)} (one that remembers: use module:callable)")
        shape = list(ports[0].shape or [None, None])  # an output's may be unknown: it is tried afterwards
        if ports[0].type != "tensor(float)" or len(shape) != 2:
            raise ValueError(f"its {kind} must be float32 of shape (batch, size), got {ports[0].type} of shape {shape}")
        if isinstance(shape[0], int):
            raise ValueError(f"its {kind} must have a free batch size, got shape {shape}: make its first axis dynamic")
        widths.append(shape[1])
    if sizes is None and not all(isinstance(width, int) for width in widths):
        raise ValueError(f"its rows must have known widths, got {widths}")
    expected = sizes or (widths[0], widths[1])
    if any(isinstance(width, int) and width != size for width, size in zip(widths, expected, strict=True)):
        raise ValueError(f"expected {expected[0]} observations and {expected[1]} actions, got {widths}")
    return expected


def export_onnx(policy: MlpPolicy, path: Path) -> None:
    """Writes a policy as one self-contained file that ends in .onnx; its folder is made if need be.

    Its input is ``observation``, shape (batch, observation_size), its output ``action``, shape (batch, num_joints),
    both float32, the batch free. The same policy gives the same bytes.
    """
    if path.suffix.lower() != ".onnx":
        raise ValueError(f"'{path}' must end in .onnx, by which controllers of that kind are known")
    prepare_output(path)
    nodes: list[Any] = []
    weights: list[Any] = []

    def weight(name: str, value: torch.Tensor) -> str:
        weights.append(numpy_helper.from_array(value.detach().cpu().float().contiguous().numpy(), name))
        return name

    def node(kind: str, inputs: list[str], name: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [name], name=f"make_{name}", **attributes))
        return name

    value = "observation"
    if policy.normalised:  # the 1e-2 is rsl_rl's
        value = node("Sub", [value, weight("mean", policy.mean)], "centred")
        value = node("Div", [value, weight("scale", policy.std + 1e-2)], "normalised")
    last = len(policy.layers) - 1
    for k, layer in enumerate(policy.layers):
        name = "action" if k == last else f"layer_{k}"
        if isinstance(layer, torch.nn.Linear):
            inputs = [value, weight(f"weight_{k}", layer.weight), weight(f"bias_{k}", layer.bias)]
            value = node("Gemm", inputs, name, transB=1)
        else:
            value = node("Elu", [value], name, alpha=1.0)
    ports = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])]
        for name, size in zip(("observation", "action"), policy.sizes, strict=True)
    ]
    graph = helper.make_graph(nodes, "policy", *ports, initializer=weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    write_atomically(path, model.SerializeToString(deterministic=True))
