"""Controllers in ONNX files: data alone, run by onnxruntime; and checkpoints written as such files."""

import functools
import math
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
_BINARY = ("Add", "Sub", "Mul", "Div", "Pow", "MatMul")
_UNARY = ("Abs", "Cos", "Erf", "Exp", "Log", "Neg", "Sigmoid", "Sin", "Sqrt", "Tanh")
_CPU = "CPUExecutionProvider"
_CUDA = "CUDAExecutionProvider"


class _Ports:
    """What a graph takes and returns: columns of the rows in the order of its inputs, states, and actions."""

    def __init__(self, inputs: Sequence[Any], outputs: Sequence[Any], sizes: tuple[int, int] | None) -> None:
        """From onnxruntime's ports; ``sizes`` of observation and action are those of the graph if None."""
        self.axes: dict[str, int] = {}  # of robots, of each input
        self.is_single = False
        names = [port.name for port in outputs]
        pairs = {port.name: state for port in inputs if (state := f"{port.name.removesuffix('_in')}_out") in names}
        rest = [port for port in outputs if port.name not in pairs.values()]
        actions = [port for port in rest if "action" in port.name] or rest
        self.columns = {port.name: self._read_shape(port) for port in inputs if port.name not in pairs}
        """Shape of one robot's input, and of its states, by their names; None where it is free."""
        self.states = {port.name: self._read_shape(port, (1, 0)) for port in inputs if port.name in pairs}
        if not rest or not self.columns or None in sum(self.states.values(), ()):
            got = [port.name for port in inputs], names
            raise ValueError(f"it must have an input and an output, and states X_in and X_out, got {got}")
        width = None if None in sum(self.columns.values(), ()) else sum(map(math.prod, self.columns.values()))
        count = self._read_shape(actions[0])[-1]
        self.sizes: tuple[Any, Any] = sizes or (width, count)
        if None in self.sizes or (width is None and len(self.columns) > 1):
            raise ValueError(f"its rows must have known widths, got {self.columns} and {count}")
        if any(known not in (None, size) for known, size in zip((width, count), self.sizes, strict=True)):
            raise ValueError(f"expected {self.sizes[0]} observations and {self.sizes[1]} actions, got {(width, count)}")
        if width is None:
            self.columns = dict.fromkeys(self.columns, (self.sizes[0],))
        self.outputs = {actions[0].name: 0} | {pairs[name]: self.axes[name] for name in self.states}  # and their axes
        self.ignored = [name for name in names if name not in self.outputs]

    def _read_shape(self, port: Any, axes: Sequence[int] = (0,)) -> tuple[Any, ...]:
        """The shape of one robot's tensor, None where it is free; robots stand along one of the axes, if free."""
        shape = [size if isinstance(size, int) else None for size in port.shape or (None, None)]  # if it is unknown
        axes = sorted(axes, key=lambda axis: shape[axis : axis + 1] != [None])
        axis = next((axis for axis in axes if shape[axis : axis + 1] in ([None], [1])), None)
        if port.type != "tensor(float)" or len(shape) < 2 or axis is None:
            got = f"{port.type} of shape {port.shape}"
            raise ValueError(f"'{port.name}' must be float32 of shape (batch, size), its batch free or 1, got {got}")
        self.is_single |= shape[axis] == 1
        self.axes[port.name] = axis
        return (*shape[:axis], *shape[axis + 1 :])

    def feed(self, rows: torch.Tensor, states: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Inputs by their names, robots first, from rows (num_rows, observation_size) and states."""
        parts = rows.split([math.prod(shape) for shape in self.columns.values()], dim=1)
        columns = [part.reshape(len(rows), *shape) for part, shape in zip(parts, self.columns.values(), strict=True)]
        return dict(zip((*self.columns, *self.states), (*columns, *states), strict=True))


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
        self.ports = _Ports(self.session.get_inputs(), self.session.get_outputs(), sizes)
        self.sizes = self.ports.sizes

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions (num_envs, num_joints) on the device of the observations (num_envs, observation_size)."""
        return self.run(observation, ())[0]

    def run(self, rows: torch.Tensor, states: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Actions of the rows and the states after them, robots first; a graph for one robot runs once a robot."""
        axes, outputs = self.ports.axes, self.ports.outputs
        inputs = {name: value.detach().cpu().float() for name, value in self.ports.feed(rows, states).items()}
        size = 1 if self.ports.is_single else len(rows)
        results: list[list[Any]] = []
        for parts in zip(*(value.split(size) for value in inputs.values()), strict=True):
            feed = {name: part.movedim(0, axes[name]).numpy() for name, part in zip(inputs, parts, strict=True)}
            values: Any = self.session.run([*outputs], feed)
            results.append([np.moveaxis(value, axis, 0) for value, axis in zip(values, outputs.values(), strict=True)])
        return [torch.from_numpy(np.concatenate(values)).to(rows.device) for values in zip(*results, strict=True)]


class _OnnxRecurrent(Recurrent):
    """A controller that remembers: states go in and come out."""

    def __init__(self, network: "OnnxPolicy | OnnxLayers", ports: _Ports) -> None:
        super().__init__([torch.zeros(1, *shape) for shape in ports.states.values()], 0)
        self.sizes = ports.sizes
        self.network = network
        self.graph_safe = isinstance(network, OnnxLayers)

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        action, *after = self.network.run(rows, state)
        return action, after


class OnnxLayers(torch.nn.Module):
    """A controller whose graph has only plain layers, in torch's operators, so that it can be captured."""

    def __init__(self, model: Any, ports: _Ports, *, each: bool = False) -> None:
        """From a graph and its ports; any error if it has another operator. With ``each`` it runs for each robot."""
        super().__init__()
        self.sizes = ports.sizes
        self._ports = ports
        self._each = each
        constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
        self._nodes: list[tuple[Callable[..., Any], list[Any], list[str], dict[str, Any]]] = []
        for node in model.graph.node:
            attributes = {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
            if node.op_type == "Constant":
                constants[node.output[0]] = numpy_helper.to_array(attributes["value"])
                continue
            if node.op_type == "Split":
                attributes["num_outputs"] = len(node.output)
            arguments: list[Any] = [*node.input]
            if node.op_type in _OF_NUMBERS:  # of the graph; a device would have to be waited for
                arguments[1:] = [constants[name].tolist() if name else None for name in arguments[1:]]
            self._nodes.append((_LAYERS[node.op_type], arguments, [*node.output], attributes))
        self._names = list(constants)
        weights = [torch.tensor(value) for value in constants.values()]
        self.weights = torch.nn.ParameterList(torch.nn.Parameter(weight, requires_grad=False) for weight in weights)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Actions, shape (num_envs, num_joints)."""
        return self.run(with_rows_of_zeros(rows), ())[0][: len(rows)]

    def run(self, rows: torch.Tensor, states: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """:meth:`OnnxPolicy.run` of the same graph."""
        inputs = self._ports.feed(rows, states)
        return torch.vmap(self._compute)(inputs) if self._each else self._compute(inputs)

    def _compute(self, inputs: dict[str, torch.Tensor]) -> list[torch.Tensor]:
        """The outputs that are needed; with ``each`` of one robot, whose axis goes in and comes out."""
        ports, each = self._ports, self._each
        values: dict[Any, Any] = dict(zip(self._names, self.weights, strict=True))
        values |= {name: value.unsqueeze(ports.axes[name]) if each else value for name, value in inputs.items()}
        for layer, arguments, outputs, attributes in self._nodes:
            value = layer(*(values[name] if isinstance(name, str) else name for name in arguments), **attributes)
            values |= zip(outputs, value if isinstance(value, tuple) else [value], strict=True)
        return [values[name].squeeze(axis) if each else values[name] for name, axis in ports.outputs.items()]


_OF_NUMBERS = ("Clip", "ReduceMean", "Reshape", "Slice", "Split", "Unsqueeze")
_LAYERS: dict[str, Callable[..., Any]] = {
    **{name: getattr(torch, name.lower()) for name in (*_BINARY, *_UNARY)},
    **{name: getattr(functional, name.lower()) for name in ("Elu", "Selu", "Relu", "Softplus")},
    "LeakyRelu": lambda value, alpha=0.01: functional.leaky_relu(value, alpha),
    "Identity": torch.clone,
    "Max": lambda *values: functools.reduce(torch.maximum, values),
    "Min": lambda *values: functools.reduce(torch.minimum, values),
    "Clip": lambda value, min=None, max=None: value.clamp(min, max),
    "Split": lambda value, sizes=None, *, num_outputs, axis=0, split=None: (
        value.split(sizes or split, axis) if sizes or split else value.chunk(num_outputs, axis)
    ),
    "Concat": lambda *values, axis: torch.cat(values, axis),
    "Gather": lambda value, index, *, axis=0: value.index_select(axis, index),
    "GatherND": lambda value, index, **attributes: value[index[None].unbind(-1)][0],
    "Reshape": lambda value, shape, **attributes: value.reshape(shape),
    "Transpose": lambda value, *, perm: value.permute(perm),
    "Slice": lambda value, start, end, axis, step=(1,): torch.ops.aten.slice(value, *axis, *start, *end, *step),
    "Unsqueeze": lambda value, axis: value.unsqueeze(*axis),
    "ReduceMean": lambda value, axes=(), *, keepdims=1, **attributes: value.mean(axes, bool(keepdims)),
    "LayerNormalization": lambda value, weight, bias=None, *, axis=-1, epsilon=1e-5, **attributes: (
        functional.layer_norm(value, value.shape[axis:], weight, bias, epsilon)
    ),
    "Gemm": lambda rows, weight, bias, alpha=1.0, beta=1.0, **attributes: torch.addmm(
        bias, rows, weight.T if attributes.get("transB") else weight, alpha=alpha, beta=beta
    ),
}  # operators of a graph of plain layers; other attributes are found when the outputs are compared


def load_onnx(path: Path, sizes: tuple[int, int] | None, device: str) -> "OnnxLayers | OnnxPolicy | _OnnxRecurrent":
    """A controller from an ONNX file of these observation and action sizes, or of any if None, on a torch device.

    Inputs are columns of the observation, and states X or X_in; outputs are actions, and states X_out. Plain layers
    become a torch module, another graph for one robot one for any number, if that acts as before on random rows.
    """
    target = torch.device(device)
    try:
        model, data = read_onnx(path)
        if not model.graph.node:
            raise ValueError("it has no graph")
        policy = OnnxPolicy(data, target, sizes)
        ports = policy.ports
        makers: list[Callable[[], Any]] = [lambda: OnnxLayers(model, ports)]
        if ports.is_single:
            makers.append(lambda: OnnxLayers(model, ports, each=True))
            makers.append(lambda: OnnxPolicy(_free_batch(model, ports), target, sizes))
        network: Any = next(filter(None, (_make_if_equal(make, policy) for make in makers)), policy)
    except Exception as error:  # protobuf and onnxruntime have errors of their own, without a base
        raise ValueError(f"policy '{path}' is no ONNX file of this robot: {error}: export it anew") from None
    if ports.ignored:
        warnings.warn(f"policy '{path}' returns more than actions: {', '.join(ports.ignored)}: ignored", stacklevel=2)
    if isinstance(network, OnnxPolicy):
        if target.type == "cuda" and policy.session.get_providers()[0] != _CUDA:
            what = "has more than plain layers and runs on the CPU: install onnxruntime-gpu, or give the checkpoint"
            warnings.warn(f"policy '{path}' {what}", stacklevel=2)
        if network.ports.is_single:
            warnings.warn(f"policy '{path}' can only run one robot after the other: searches take long", stacklevel=2)
    network = _OnnxRecurrent(network, ports) if ports.states else network
    return network if isinstance(network, OnnxPolicy) else network.to(target)


def _make_if_equal(make: Callable[[], Any], policy: OnnxPolicy) -> Any:
    """The result of ``make`` if it maps random rows, and states, as the policy does; else None."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(policy.sizes[0],), *policy.ports.states.values()]
    try:
        made = make()
        for count, size in ((1, 0.1), (5, 1.0), (40, 3.0)):
            rows, *states = (size * torch.randn([count, *shape], generator=generator) for shape in shapes)
            for value, expected in zip(made.run(rows, states), policy.run(rows, states), strict=True):
                torch.testing.assert_close(value, expected, rtol=0.0, atol=1e-4 * max(1.0, float(expected.abs().max())))
    except Exception:  # onnxruntime's errors have no base
        return None
    return made


def _free_batch(model: Any, ports: _Ports) -> bytes:
    axes = ports.axes | ports.outputs
    for port in (*model.graph.input, *model.graph.output):
        if port.name in axes:
            port.type.tensor_type.shape.dim[axes[port.name]].dim_param = "batch"
    del model.graph.value_info[:]
    return model.SerializeToString()


def export_onnx(policy: MlpPolicy, path: Path) -> None:
    """Writes a policy, from ``observation`` to ``action``, with a free batch, as one .onnx of always the same bytes."""
    if path.suffix.lower() != ".onnx":
        raise ValueError(f"'{path}' must end in .onnx, by which controllers of that kind are known")
    if policy.activation not in _OPERATORS:
        raise ValueError(f"ONNX of opset {_OPSET} has no {policy.activation}, only {', '.join(_OPERATORS)}")
    prepare_output(path)
    steps: list[tuple[str, str, dict[str, torch.Tensor]]] = []
    if policy.normalised:  # the 1e-2 is rsl_rl's
        steps = [("Sub", "centred", {"mean": policy.mean}), ("Div", "normalised", {"scale": policy.std + 1e-2})]
    for k, layer in enumerate(policy.layers):
        name = "action" if k == len(policy.layers) - 1 else f"layer_{k}"
        tensors: dict[str, torch.Tensor] = {f"{key}_{k}": value for key, value in layer.named_parameters()}
        steps.append(("Gemm" if tensors else _OPERATORS[policy.activation], name, tensors))
    nodes: list[Any] = []
    weights: list[Any] = []
    value = "observation"
    for kind, name, tensors in steps:
        attributes: dict[str, Any] = {"transB": 1} if kind == "Gemm" else {}
        nodes.append(helper.make_node(kind, [value, *tensors], [name], name=f"make_{name}", **attributes))
        arrays = {key: tensor.detach().cpu().float().contiguous().numpy() for key, tensor in tensors.items()}
        weights += [numpy_helper.from_array(array, key) for key, array in arrays.items()]
        value = name
    ends = zip(("observation", "action"), policy.sizes, strict=True)
    ports = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])] for name, size in ends]
    graph = helper.make_graph(nodes, "policy", *ports, initializer=weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    write_atomically(path, model.SerializeToString(deterministic=True))
