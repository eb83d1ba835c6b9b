"""Controllers in ONNX files: they act as their weights say, and what does not fit is refused; and their export."""

import dataclasses
import itertools

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from sim.crossing import CrossingCfg
from sim.policy.loaders import load_checkpoint, load_policy
from sim.policy.mlp import MlpPolicy
from sim.policy.onnx import OnnxPolicy, export_onnx, load_onnx
from sim.robots.find import get_robot
from sim.rollout import Rollout
from sim.terrain import crossing_terrain

OBSERVATIONS, ACTIONS = 235, 12
FLOAT, DOUBLE, INT64 = TensorProto.FLOAT, TensorProto.DOUBLE, TensorProto.INT64


def layer(observations=OBSERVATIONS, actions=ACTIONS):
    rng = np.random.default_rng(3)
    return rng.normal(size=(actions, observations)).astype(np.float32) / 10, np.linspace(-1, 1, actions, dtype="f4")


def port(name, shape, kind=FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def graph_model(nodes, inputs, outputs, weights=(), domains=()):
    graph = helper.make_graph(list(nodes), "policy", inputs, outputs, initializer=list(weights))
    opsets = [helper.make_opsetid(domain, version) for domain, version in (("", 17), *((name, 1) for name in domains))]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


def linear(observations=OBSERVATIONS, actions=ACTIONS, batch="batch", out_batch="batch", columns=None):
    """One layer, as a foreign exporter would write it: other names than ours, no checksum."""
    weights = [
        numpy_helper.from_array(value, name) for value, name in zip(layer(observations, actions), "wb", strict=True)
    ]
    node = helper.make_node("Gemm", ["obs", "w", "b"], ["actions"], transB=1)
    shapes = [batch, columns or observations], [out_batch, columns or actions]
    return graph_model([node], [port("obs", shapes[0])], [port("actions", shapes[1])], weights)


def save(path, model):
    path.write_bytes(model.SerializeToString())
    return path


def place(device):
    return "cuda" if device.startswith("cuda") else "cpu"


@pytest.mark.parametrize("batch", [1, 4, 33])
def test_it_acts_as_its_weights_say(tmp_path, anymal, device, batch):
    policy = load_policy(str(save(tmp_path / "policy.onnx", linear())), anymal, device)
    rows = torch.randn(batch, OBSERVATIONS, generator=torch.Generator().manual_seed(batch))
    weight, bias = layer()
    got = policy(rows.to(place(device)))
    assert got.device.type == place(device)
    assert got.dtype == torch.float32
    # Sums of 235 float32 products of order 0.1 in another order than NumPy's float64.
    np.testing.assert_allclose(got.cpu(), rows.double().numpy() @ weight.T.astype(float) + bias, rtol=1e-5, atol=1e-5)


def test_a_row_is_answered_alike_in_any_batch(tmp_path, anymal):
    policy = load_policy(save(tmp_path / "policy.onnx", linear()), anymal, "cpu")
    rows = torch.randn(60, OBSERVATIONS, generator=torch.Generator().manual_seed(1))
    together = policy(rows)
    for size in (1, 4, 7, 20):
        assert torch.equal(torch.cat([policy(part) for part in rows.split(size)]), together), size


def test_unknown_widths_are_settled_by_trying(tmp_path, anymal):
    free = save(tmp_path / "free.onnx", linear(columns="columns"))
    assert isinstance(load_policy(free, anymal, "cpu"), OnnxPolicy)
    with pytest.raises(ValueError, match=r"other\.onnx' failed"):
        load_policy(save(tmp_path / "other.onnx", linear(48, 12, columns="columns")), anymal, "cpu")
    with pytest.raises(ValueError, match="actions"):  # it follows from the weights
        load_policy(save(tmp_path / "other.onnx", linear(235, 10, columns="columns")), anymal, "cpu")


def typed(kind):
    cast = helper.make_node("Cast", ["obs"], ["x"], to=FLOAT)
    cut = helper.make_node("Slice", ["x", "first", "end", "axis"], ["actions"])
    ends = [numpy_helper.from_array(np.array([n]), name) for n, name in ((0, "first"), (ACTIONS, "end"), (1, "axis"))]
    inputs = [port("obs", ["batch", OBSERVATIONS], kind)]
    return graph_model([cast, cut], inputs, [port("actions", ["batch", ACTIONS])], ends)


def many(inputs, outputs):
    nodes = [helper.make_node("Sum", [f"in_{k}" for k in range(inputs)], ["sum"])]
    nodes += [helper.make_node("Identity", ["sum"], [f"out_{k}"]) for k in range(outputs)]
    ports = [[port(f"{name}_{k}", ["b", ACTIONS]) for k in range(n)] for name, n in (("in", inputs), ("out", outputs))]
    return graph_model(nodes, *ports)


def flat():
    node = helper.make_node("Identity", ["obs"], ["actions"])
    return graph_model([node], [port("obs", [OBSERVATIONS])], [port("actions", [OBSERVATIONS])])


def of_a_foreign_operator():
    node = helper.make_node("Surprise", ["obs"], ["actions"], domain="their.own")
    ports = [port("obs", ["b", OBSERVATIONS])], [port("actions", ["b", ACTIONS])]
    return graph_model([node], *ports, domains=["their.own"])


def not_a_number():
    model = linear()
    model.graph.initializer[1].CopyFrom(numpy_helper.from_array(np.full(ACTIONS, np.nan, np.float32), "b"))
    return model


MODELS = {
    "another robot's rows": linear(48),
    "another robot's joints": linear(235, 10),
    "a batch of one": linear(batch=1, out_batch=1),
    "a batch of four": linear(batch=4, out_batch=4),
    "doubles": typed(DOUBLE),
    "integers": typed(INT64),
    "no batch": flat(),
    "two inputs": many(2, 1),
    "two outputs": many(1, 2),
    "a foreign operator": of_a_foreign_operator(),
    "NaN": not_a_number(),
    "no graph": graph_model([], [], []),
}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_model_that_does_not_fit_is_refused(tmp_path, anymal, model, capfd):
    with pytest.raises(ValueError, match=r"theirs\.onnx"):
        load_policy(save(tmp_path / "theirs.onnx", model), anymal, "cpu")
    assert capfd.readouterr() == ("", ""), "onnxruntime says it a second time"


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, anymal, share):
    whole = linear().SerializeToString()
    (tmp_path / "half.onnx").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"half\.onnx"):
        load_policy(tmp_path / "half.onnx", anymal, "cpu")


def externalised(folder):
    """The layer with its weights in a file of their own, as exporters write them by default."""
    onnx.save(linear(), folder / "split.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    return folder / "split.onnx"


@pytest.mark.parametrize("there", [True, False])
def test_weights_in_another_file_are_refused(tmp_path, anymal, monkeypatch, there):
    path = externalised(tmp_path)
    monkeypatch.chdir(tmp_path)
    if there:  # onnxruntime would read them: the refusal is ours
        onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    else:
        (tmp_path / "weights.bin").unlink()
    with pytest.raises(ValueError, match=r"2 of its tensors in another file"):
        load_policy(path, anymal, "cpu")


def test_another_file_is_found_in_a_subgraph(tmp_path, anymal):
    outside = externalised(tmp_path)
    tensor = onnx.load(outside, load_external_data=False).graph.initializer[1]
    model = linear()
    branch = helper.make_graph(
        [helper.make_node("Constant", [], ["c"], value=tensor)], "branch", [], [port("c", [ACTIONS])]
    )
    model.graph.node.append(helper.make_node("If", ["yes"], ["unused"], then_branch=branch, else_branch=branch))
    with pytest.raises(ValueError, match="2 of its tensors in another file"):
        load_policy(save(tmp_path / "deep.onnx", model), anymal, "cpu")


@pytest.mark.skipif("CUDAExecutionProvider" in onnxruntime.get_available_providers(), reason="this one can use a GPU")
def test_without_cuda_in_onnxruntime_it_computes_on_the_cpu_and_says_so(tmp_path):
    path = save(tmp_path / "policy.onnx", linear())
    with pytest.warns(
        UserWarning, match=r"policy\.onnx' runs on the CPU, with copies to and from cuda:0.*onnxruntime-gpu"
    ):
        policy = load_onnx(path, (OBSERVATIONS, ACTIONS), "cuda:0")
    assert policy.device == torch.device("cpu")
    assert policy(torch.zeros(3, OBSERVATIONS)).shape == (3, ACTIONS)


ANYMAL = get_robot("anymal")


def actor(*sizes, normalised=False):
    """An actor of random weights, its normaliser (if any) far from doing nothing."""
    generator = torch.Generator().manual_seed(len(sizes))
    state = {}
    for k, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        state[f"mlp.{2 * k}.weight"] = torch.randn((outputs, inputs), generator=generator) / inputs**0.5
        state[f"mlp.{2 * k}.bias"] = torch.randn(outputs, generator=generator)
    if normalised:
        state["obs_normalizer._mean"] = torch.randn((1, sizes[0]), generator=generator) * 5
        state["obs_normalizer._std"] = torch.rand((1, sizes[0]), generator=generator) * 3 + 0.2
    return MlpPolicy(state)


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("sizes", [(235, 12), (169, 64, 12), (48, 32, 16, 8, 3)])
def test_the_file_is_the_controller(tmp_path, sizes, normalised):
    policy, path = actor(*sizes, normalised=normalised), tmp_path / "new" / "policy.onnx"
    export_onnx(policy, path)
    assert [file.name for file in path.parent.iterdir()] == ["policy.onnx"]
    loaded = load_onnx(path, policy.sizes, "cpu")
    for batch in (1, 7):
        rows = torch.randn((batch, sizes[0]), generator=torch.Generator().manual_seed(9)) * 3
        with torch.inference_mode():
            expected, got = policy(rows), loaded(rows)
        # Both round sums of up to 235 float32 products, each in its own order: a part of the largest of them.
        assert (got - expected).abs().max() <= 1e-5 * max(1.0, expected.abs().max())


def test_the_file_is_as_promised_to_others(tmp_path):
    export_onnx(actor(48, 8, 3, normalised=True), tmp_path / "policy.onnx")
    model = onnx.load(tmp_path / "policy.onnx", load_external_data=False)
    onnx.checker.check_model(model, full_check=True)
    shapes = [
        (
            port.name,
            port.type.tensor_type.elem_type,
            [d.dim_param or d.dim_value for d in port.type.tensor_type.shape.dim],
        )
        for port in (*model.graph.input, *model.graph.output)
    ]
    assert shapes == [
        ("observation", onnx.TensorProto.FLOAT, ["batch", 48]),
        ("action", onnx.TensorProto.FLOAT, ["batch", 3]),
    ]
    assert [node.op_type for node in model.graph.node] == ["Sub", "Div", "Gemm", "Elu", "Gemm"]


@pytest.mark.parametrize("name", ["policy.pt", "policy"])
def test_the_name_must_say_what_it_is(tmp_path, name):
    with pytest.raises(ValueError, match=r"must end in \.onnx"):
        export_onnx(actor(48, 3), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_only_a_checkpoint_can_be_exported(tmp_path):
    export_onnx(load_checkpoint(ANYMAL.policy_file, ANYMAL), tmp_path / "a.onnx")
    with pytest.raises(ValueError, match="must be an rsl_rl checkpoint"):
        load_checkpoint(tmp_path / "a.onnx", ANYMAL)


def test_crossings_are_those_of_the_original(tmp_path):
    export_onnx(load_policy(ANYMAL.policy_file, ANYMAL, "cpu"), tmp_path / "policy.onnx")
    terrains = np.stack([crossing_terrain(*kind) for kind in (("stairs_up_down", 9, 3), ("boxes", 5, 1))])
    results = []
    for policy in (ANYMAL.policy_file, tmp_path / "policy.onnx"):
        cfg = CrossingCfg(max_duration_s=0.6, poll_every_s=0.1)
        rollout = Rollout(ANYMAL, policy, num_terrains=2, num_replicas=4, device="cpu", cfg=cfg)
        results.append(dataclasses.asdict(rollout.evaluate(terrains, np.array([7, 8]))))
    first, second = results
    np.testing.assert_array_equal(second["outcome"], first["outcome"])
    np.testing.assert_array_equal(second["fallen"], first["fallen"])
    np.testing.assert_allclose(second["duration_s"], first["duration_s"])
    # Actions differ by 1e-6, which contacts make 1.5e-5 of a penalty within 0.6 s.
    np.testing.assert_allclose(second["penalties"], first["penalties"], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(second["final_position"], first["final_position"], atol=1e-4)
    assert (first["penalties"][..., 0] > 0).all()
