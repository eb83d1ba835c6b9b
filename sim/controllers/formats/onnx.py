"""Controllers in ONNX files: data alone, run by onnxruntime; and checkpoints written as such files."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper
from torch.nn import functional

from sim.controllers.formats.onnx_data import read_onnx
from sim.controllers.formats.rsl_rl import MlpPolicy
from sim.controllers.runner import Recurrent, with_rows_of_zeros
from sim.files.atomic import prepare_output, write_atomically

_OPSET = 17  # of 2022, since robots rarely run a new onnxruntime
_IR_VERSION = 8
_OPERATORS = {name: name.capitalize() for name in ("elu", "selu", "relu", "tanh", "sigmoid", "softplus", "identity")}
_OPERATORS["lrelu"] = "LeakyRelu"
_CPU = "CPUExecutionProvider"
_CUDA = "CUDAExecutionProvider"


class OnnxPolicy:
    """A controller that onnxruntime runs; tensors are copied from their device and back."""

    def __init__(self, data: bytes, device: torch.device, sizes: tuple[int, int] | None) -> None:
        """From the content of a file; ``sizes`` of observation and action are those of the file if None."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()  # 1 in worker processes
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # exceptions report all errors
        options.add_session_config_entry("session.load_model_format", "ONNX")
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        providers: list[Any] = [_CPU]
        if device.type == "cuda" and _CUDA in onnxruntime.get_available_providers():
            # TF32 would round every product to 10 bits.
            providers = [(_CUDA, {"device_id": str(device.index or 0), "use_tf32": "0"}), _CPU]
        self.session = onnxruntime.InferenceSession(data, options, providers=providers, enable_fallback=0)
        self.ports = self.session.get_inputs(), self.session.get_outputs()
        self.sizes, self.states, self.is_single = _check_sizes(*self.ports, sizes)

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions (num_envs, num_joints) on the device of the observations (num_envs, observation_size)."""
        return self.run([observation])[0]

    def run(self, inputs: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Outputs for the graph's inputs, in its order, on their device; a graph for one robot runs once a robot."""
        values = [value.detach().cpu().float() for value in inputs]
        names = [port.name for port in self.ports[0]]
        calls = zip(*(value.split(1, dim=-2) for value in values), strict=True) if self.is_single else [values]
        results = [self.session.run(None, dict(zip(names, map(np.asarray, call), strict=True))) for call in calls]
        outputs = [np.concatenate(rows, axis=-2) for rows in zip(*results, strict=True)]
        return [torch.from_numpy(output).to(inputs[0].device) for output in outputs]


class _OnnxRecurrent(Recurrent):
    """A controller that remembers: states of shape (layers, num_envs, size) go in and come out."""

    graph_safe = False

    def __init__(self, policy: OnnxPolicy) -> None:
        super().__init__([torch.zeros(layers, 1, size) for layers, _, size in policy.states], 1)
        self.sizes = policy.sizes
        self._run = policy.run

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        action, *after = self._run([rows, *state])
        return action, after


class OnnxLayers(torch.nn.Module):
    """A controller whose graph has only plain layers, in torch's operators, so that it can be captured."""

    def __init__(self, model: Any, policy: OnnxPolicy) -> None:
        """From a graph and onnxruntime's policy of it; a KeyError if it has another operator."""
        super().__init__()
        self.sizes = policy.sizes
        self._input, self._output = (ports[0].name for ports in policy.ports)
        constants = {tensor.name: tensor for tensor in model.graph.initializer}
        self._nodes: list[tuple[Callable[..., Any], list[str], list[str], dict[str, Any]]] = []
        for node in model.graph.node:
            attributes = {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
            if node.op_type == "Constant":
                constants[node.output[0]] = attributes["value"]
                continue
            if node.op_type == "Split":
                attributes["chunks"] = len(node.output)
            self._nodes.append((_LAYERS[node.op_type], [*node.input], [*node.output], attributes))
        self._names = list(constants)
        weights = [torch.tensor(numpy_helper.to_array(tensor)) for tensor in constants.values()]
        self.weights = torch.nn.ParameterList(torch.nn.Parameter(weight, requires_grad=False) for weight in weights)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Actions, shape (num_envs, num_joints)."""
        values = dict(zip(self._names, self.weights, strict=True)) | {self._input: with_rows_of_zeros(rows)}
        for layer, inputs, outputs, attributes in self._nodes:
            value = layer(*(values[name] for name in inputs), **attributes)
            values |= zip(outputs, value if isinstance(value, tuple) else [value], strict=True)
        return values[self._output][: len(rows)]

    def run(self, inputs: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """:meth:`OnnxPolicy.run` of the same graph."""
        return [self(*inputs)]


_LAYERS: dict[str, Callable[..., Any]] = {
    **{name: getattr(torch, name.lower()) for name in ("Add", "Sub", "Mul", "Div", "MatMul", "Tanh", "Sigmoid")},
    **{name: getattr(functional, name.lower()) for name in ("Elu", "Selu", "Relu", "Softplus")},
    "LeakyRelu": lambda value, alpha=0.01: functional.leaky_relu(value, alpha),
    "Identity": torch.clone,
    "Split": lambda value, *, chunks, axis=0: value.chunk(chunks, axis),
    "Gemm": lambda rows, weight, bias, alpha=1.0, beta=1.0, **attributes: torch.addmm(
        bias, rows, weight.T if attributes.get("transB") else weight, alpha=alpha, beta=beta
    ),
}
"""Operators of a graph of plain layers. Other attributes are found when the outputs are compared."""


def load_onnx(path: Path, sizes: tuple[int, int] | None, device: str) -> "OnnxLayers | OnnxPolicy | _OnnxRecurrent":
    """A controller from an ONNX file of these observation and action sizes, or of any if None, on a torch device.

    Its graph maps observations (batch, observation_size) to actions (batch, num_joints), both float32; states ``X_in``
    and ``X_out``, (layers, batch, size), follow if it remembers. Only these files are read; no code runs.

    A graph of plain layers becomes a torch module, if it maps random rows as onnxruntime does. Another graph for one
    robot is changed into one for any number, if that acts on each robot as before; else it runs once a robot.
    """
    target = torch.device(device)
    try:
        model, data = read_onnx(path)
        if not model.graph.node:
            raise ValueError("it has no graph")
        policy = OnnxPolicy(data, target, sizes)
        if layers := _make_if_equal(lambda: OnnxLayers(model, policy), policy, 1e-5):
            return layers.to(target)
        if policy.is_single:
            policy = _make_if_equal(lambda: OnnxPolicy(_free_batch(model), target, sizes), policy, 1e-4) or policy
    except Exception as error:  # protobuf and onnxruntime have errors of their own, without a base
        raise ValueError(f"policy '{path}' is no ONNX file of this robot: {error}: export it anew") from None
    if target.type == "cuda" and policy.session.get_providers()[0] != _CUDA:
        what = "runs on the CPU, since this onnxruntime has no CUDA that works"
        remedy = "install onnxruntime-gpu, or give the rsl_rl checkpoint"
        warnings.warn(f"policy '{path}' has more than plain layers and {what}: {remedy}", stacklevel=2)
    if policy.is_single:
        warnings.warn(f"policy '{path}' can only run one robot after the other: searches take long", stacklevel=2)
    return _OnnxRecurrent(policy).to(target) if policy.states else policy


def _make_if_equal(make: Callable[[], Any], policy: OnnxPolicy, tolerance: float) -> Any:
    """The result of ``make`` if it maps random rows, and states, as the policy does; else None."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(1, policy.sizes[0]), *policy.states]
    try:
        made = make()
        for count, size in ((1, 0.1), (5, 1.0), (40, 3.0)):
            inputs = [size * torch.randn([*shape[:-2], count, shape[-1]], generator=generator) for shape in shapes]
            for value, expected in zip(made.run(inputs), policy.run(inputs), strict=True):
                largest = max(1.0, float(expected.abs().max()))
                torch.testing.assert_close(value, expected, rtol=0.0, atol=tolerance * largest)
    except Exception:  # onnxruntime's errors have no base
        return None
    return made


def _free_batch(model: Any) -> bytes:
    """The graph for any number of robots."""
    constants = {tensor.name for tensor in model.graph.initializer}
    for port in (*model.graph.input, *model.graph.output):
        if port.name not in constants:
            port.type.tensor_type.shape.dim[-2].dim_param = "batch"
    del model.graph.value_info[:]
    return model.SerializeToString()


def _check_sizes(
    inputs: Any, outputs: Any, sizes: tuple[int, int] | None
) -> tuple[tuple[int, int], list[list[int]], bool]:
    """Widths of observation and action, shapes of the states, and whether the graph is for one robot."""
    if [port.name for port in inputs[1:]] != [f"{port.name.removesuffix('_out')}_in" for port in outputs[1:]]:
        got = " and ".join(", ".join(port.name for port in ports) for ports in (inputs, outputs))
        must = "one input and one output, and after them the states X_in and X_out if it remembers"
        raise ValueError(f"it must have {must}, got {got}")
    ends = {"input": inputs[0], "output": outputs[0]}
    shapes = [list(port.shape or [None, None]) for port in ends.values()]  # an output's may be unknown
    for (kind, port), shape in zip(ends.items(), shapes, strict=True):
        if port.type != "tensor(float)" or len(shape) != 2:
            raise ValueError(f"its {kind} must be float32 of shape (batch, size), got {port.type} of shape {shape}")
    states = [list(port.shape) for port in inputs[1:]]
    if any(len(shape) != 3 or not isinstance(shape[0], int) or not isinstance(shape[2], int) for shape in states):
        raise ValueError(f"its states must have shape (layers, batch, size), got {states}")
    batches = {shape[-2] for shape in (*shapes, *states) if isinstance(shape[-2], int)}
    if batches - {1}:
        raise ValueError(f"its batch must be free, or of one robot, got {max(batches)}: make its first axis dynamic")
    widths: tuple[Any, Any] = (shapes[0][1], shapes[1][1])
    sizes = sizes or widths
    if not all(isinstance(size, int) for size in sizes):
        raise ValueError(f"its rows must have known widths, got {widths}")
    if any(isinstance(width, int) and width != size for width, size in zip(widths, sizes, strict=True)):
        raise ValueError(f"expected {sizes[0]} observations and {sizes[1]} actions, got {widths}")
    return sizes, states, bool(batches)


def export_onnx(policy: MlpPolicy, path: Path) -> None:
    """Writes a policy as one self-contained file that ends in .onnx; its folder is made if need be.

    Its input is ``observation``, shape (batch, observation_size), its output ``action``, shape (batch, num_joints),
    both float32, the batch free. The same policy gives the same bytes.
    """
    if path.suffix.lower() != ".onnx":
        raise ValueError(f"'{path}' must end in .onnx, by which controllers of that kind are known")
    if policy.activation not in _OPERATORS:
        raise ValueError(f"ONNX of opset {_OPSET} has no {policy.activation}, only {', '.join(_OPERATORS)}")
    prepare_output(path)
    nodes: list[Any] = []
    weights: list[Any] = []

    def node(kind: str, value: str, name: str, tensors: dict[str, torch.Tensor], **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, [value, *tensors], [name], name=f"make_{name}", **attributes))
        arrays = {key: tensor.detach().cpu().float().contiguous().numpy() for key, tensor in tensors.items()}
        weights.extend(numpy_helper.from_array(array, key) for key, array in arrays.items())
        return name

    value = "observation"
    if policy.normalised:  # the 1e-2 is rsl_rl's
        value = node("Sub", value, "centred", {"mean": policy.mean})
        value = node("Div", value, "normalised", {"scale": policy.std + 1e-2})
    for k, layer in enumerate(policy.layers):
        name = "action" if k == len(policy.layers) - 1 else f"layer_{k}"
        if isinstance(layer, torch.nn.Linear):
            value = node("Gemm", value, name, {f"weight_{k}": layer.weight, f"bias_{k}": layer.bias}, transB=1)
        else:
            value = node(_OPERATORS[policy.activation], value, name, {})
    ends = zip(("observation", "action"), policy.sizes, strict=True)
    ports = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])] for name, size in ends]
    graph = helper.make_graph(nodes, "policy", *ports, initializer=weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    write_atomically(path, model.SerializeToString(deterministic=True))
