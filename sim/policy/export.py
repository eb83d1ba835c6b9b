"""Controllers written as ONNX files, each compared with its original."""

from pathlib import Path
from typing import Any

import torch
from onnx import TensorProto, helper, numpy_helper

from sim.files.atomic import prepare_output, write_atomically
from sim.policy.loaders import MlpPolicy, load_policy, prepare_torch
from sim.policy.onnx_file import OnnxPolicy, load_onnx, onnx_policy, seal
from sim.robots.robot import RobotCfg

INPUT, OUTPUT = "observation", "action"
TOLERANCE = 1e-5
"""How far actions may be from the original's, as a part of the largest action (of 1 if that is smaller)."""
_OPSET, _IR_VERSION = 17, 8  # of 2022: what runs on robots is rarely new
_BATCHES = (1, 64)


def to_onnx(policy: MlpPolicy) -> bytes:
    """The bytes of an ONNX file that computes what a policy does.

    Its input is ``observation``, shape (batch, observation_size), its output ``action``, shape (batch, num_joints),
    both float32, the batch free. The same policy gives the same bytes.
    """
    nodes: list[Any] = []
    weights: list[Any] = []

    def weight(name: str, value: torch.Tensor) -> str:
        weights.append(numpy_helper.from_array(value.detach().cpu().float().contiguous().numpy(), name))
        return name

    def node(kind: str, inputs: list[str], name: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [name], name=f"make_{name}", **attributes))
        return name

    value = INPUT
    if policy.normalised:  # the 1e-2 is rsl_rl's
        value = node("Sub", [value, weight("mean", policy.mean)], "centred")
        value = node("Div", [value, weight("scale", policy.std + 1e-2)], "normalised")
    last = len(policy.layers) - 1
    for k, layer in enumerate(policy.layers):
        name = OUTPUT if k == last else f"layer_{k}"
        if isinstance(layer, torch.nn.Linear):
            inputs = [value, weight(f"weight_{k}", layer.weight), weight(f"bias_{k}", layer.bias)]
            value = node("Gemm", inputs, name, transB=1)
        else:
            value = node("Elu", [value], name, alpha=1.0)
    ports = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])]
        for name, size in zip((INPUT, OUTPUT), policy.sizes, strict=True)
    ]
    graph = helper.make_graph(nodes, "policy", *ports, initializer=weights)
    return seal(helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION))


def export_onnx(policy: MlpPolicy, path: Path) -> float:
    """Writes a policy as one self-contained ONNX file and compares it with the original, before and after writing.

    Args:
        policy: The actor, on any device.
        path: File to write, ending in .onnx; its folder is made if need be.

    Returns:
        The largest difference between an action of the file and the original's, on random rows.

    Raises:
        ValueError: If the name is another, the file cannot be written there, or the actions differ by more than
            :data:`TOLERANCE`; an older file is then as it was.
        OSError: If writing fails, as on a full disk.
    """
    if path.suffix.lower() != ".onnx":
        raise ValueError(f"'{path}' must end in .onnx, by which controllers of that kind are known")
    prepare_output(path)
    data = to_onnx(policy)
    _difference(policy, onnx_policy(data, str(path), policy.sizes, "cpu"), path)
    write_atomically(path, data)
    return _difference(policy, load_onnx(path, policy.sizes, "cpu"), path)


@torch.inference_mode()
def _difference(policy: MlpPolicy, exported: OnnxPolicy, path: Path) -> float:
    """The largest difference between the actions of two controllers, on random rows in batches of several sizes.

    Raises:
        ValueError: If it is more than :data:`TOLERANCE` allows.
    """
    device, generator = policy.mean.device, torch.Generator().manual_seed(0)
    largest = 0.0
    for batch in _BATCHES:
        rows = 2.0 * torch.randn((batch, policy.sizes[0]), generator=generator)
        if policy.normalised:
            rows = rows * policy.std.cpu() + policy.mean.cpu()
        expected, got = policy(rows.to(device)).cpu(), exported(rows)
        apart = float((got - expected).abs().max())
        allowed = TOLERANCE * max(1.0, float(expected.abs().max()))
        if not apart <= allowed:  # NaN is not either
            raise ValueError(
                f"'{path}': as ONNX the controller's actions are {apart:.2g} from the original's, expected at most "
                f"{allowed:.2g}, on random rows: look for actions that are not finite, or another onnxruntime"
            )
        largest = max(largest, apart)
    return largest


def read_checkpoint(policy: str | None, robot: RobotCfg) -> MlpPolicy:
    """A robot's controller that can be written as ONNX, on the CPU.

    Args:
        policy: An rsl_rl checkpoint; the shipped controller if None.
        robot: The robot it walks.

    Raises:
        ValueError: If it is another kind of controller.
    """
    spec = policy or str(robot.policy_file)
    prepare_torch("cpu")
    found = load_policy(spec, robot, "cpu")
    if not isinstance(found, MlpPolicy):
        raise ValueError(
            f"policy '{spec}' must be an rsl_rl checkpoint (.pt with actor_state_dict), got another kind of "
            f"controller ({type(found).__name__}): export it with the tool that made it, its first axis dynamic"
        )
    return found
