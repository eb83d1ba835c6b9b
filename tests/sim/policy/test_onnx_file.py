"""Controllers from ONNX files: they act as their weights say, and what does not fit is named before any work."""

import shutil
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from sim.policy.loaders import load_policy
from sim.policy.onnx_file import OnnxPolicy, load_onnx, seal

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


def test_rows_of_another_type_and_layout_are_taken(tmp_path, anymal):
    policy = load_policy(save(tmp_path / "policy.onnx", linear()), anymal, "cpu")
    rows = torch.randn(6, OBSERVATIONS, generator=torch.Generator().manual_seed(0))
    expected = policy(rows)
    assert torch.equal(policy(rows.double()), expected)
    assert torch.equal(policy(rows.T.contiguous().T), expected)
    assert torch.equal(policy(rows.clone().requires_grad_()), expected)
    with pytest.raises(Exception, match="invalid dimensions for input: obs"):
        policy(rows[:, 1:])


def test_a_row_is_answered_alike_in_any_batch(tmp_path, anymal):
    policy = load_policy(save(tmp_path / "policy.onnx", linear()), anymal, "cpu")
    rows = torch.randn(60, OBSERVATIONS, generator=torch.Generator().manual_seed(1))
    together = policy(rows)
    for size in (1, 4, 7, 20):
        assert torch.equal(torch.cat([policy(part) for part in rows.split(size)]), together), size


@pytest.mark.parametrize("threads", [1, 2])
def test_it_has_as_many_threads_as_torch(tmp_path, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        policy = load_onnx(save(tmp_path / "policy.onnx", linear()), (OBSERVATIONS, ACTIONS), "cpu")
    finally:
        torch.set_num_threads(before)
    options = policy._session.get_session_options()
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (threads, 1)


def test_unknown_widths_are_settled_by_trying(tmp_path, anymal):
    free = save(tmp_path / "free.onnx", linear(columns="columns"))
    assert isinstance(load_policy(free, anymal, "cpu"), OnnxPolicy)
    with pytest.raises(ValueError, match=r"other\.onnx' failed on observations of shape \(4, 235\)"):
        load_policy(save(tmp_path / "other.onnx", linear(48, 12, columns="columns")), anymal, "cpu")
    with pytest.raises(
        ValueError, match="maps any number of observations to 10 actions"
    ):  # it follows from the weights
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


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (linear(48), "maps 48 observations to 12 actions.*235 observations and 12 joints"),
        (linear(235, 10), "maps 235 observations to 10 actions.*use a controller of this robot"),
        (linear(batch=1, out_batch=1), r"fixed batch size of 1 \(input 'obs' of shape \[1, 235\]\).*export-policy"),
        (linear(batch=4, out_batch=4), "fixed batch size of 4"),
        (typed(DOUBLE), r"input of shape.*float32, got 'obs'.*tensor\(double\)"),
        (typed(INT64), r"got 'obs'.*tensor\(int64\)"),
        (flat(), r"\(batch, size\).*got 'obs' of shape \[235\]"),
        (many(2, 1), r"one input, got 2 \(in_0, in_1\).*module:callable"),
        (many(1, 2), r"one output, got 2 \(out_0, out_1\)"),
        (of_a_foreign_operator(), "refused by onnxruntime.*Surprise"),
        (not_a_number(), "not finite"),
        (graph_model([], [], []), "no ONNX file: expected a graph"),
    ],
)
def test_a_model_that_does_not_fit_is_named(tmp_path, anymal, model, message, capfd):
    with pytest.raises(ValueError, match=message) as caught:
        load_policy(save(tmp_path / "theirs.onnx", model), anymal, "cpu")
    assert "theirs.onnx" in str(caught.value)
    assert capfd.readouterr() == ("", ""), "onnxruntime says it a second time"


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, anymal, share):
    whole = linear().SerializeToString()
    (tmp_path / "half.onnx").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"half\.onnx' is no (whole )?ONNX file"):
        load_policy(tmp_path / "half.onnx", anymal, "cpu")


def test_a_checkpoint_is_no_onnx_whatever_its_name(tmp_path, anymal):
    shutil.copy(anymal.policy_file, tmp_path / "renamed.onnx")
    with pytest.raises(ValueError, match=r"renamed\.onnx' is no whole ONNX file \(truncated or foreign\)"):
        load_policy(tmp_path / "renamed.onnx", anymal, "cpu")


def test_a_file_that_cannot_be_read_is_named(tmp_path, anymal, monkeypatch):
    def forbidden(path):
        raise PermissionError(13, "Permission denied", str(path))

    path = save(tmp_path / "locked.onnx", linear())
    monkeypatch.setattr(Path, "read_bytes", forbidden)
    with pytest.raises(ValueError, match=r"locked\.onnx' cannot be read: Permission denied"):
        load_policy(path, anymal, "cpu")


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
    with pytest.raises(ValueError, match=r"split\.onnx' keeps 2 of its tensors in another file \('w' first\)"):
        load_policy(path, anymal, "cpu")


def test_another_file_is_found_in_a_subgraph(tmp_path, anymal):
    outside = externalised(tmp_path)
    tensor = onnx.load(outside, load_external_data=False).graph.initializer[1]
    model = linear()
    branch = helper.make_graph(
        [helper.make_node("Constant", [], ["c"], value=tensor)], "branch", [], [port("c", [ACTIONS])]
    )
    model.graph.node.append(helper.make_node("If", ["yes"], ["unused"], then_branch=branch, else_branch=branch))
    with pytest.raises(ValueError, match="keeps 2 of its tensors in another file"):
        load_policy(save(tmp_path / "deep.onnx", model), anymal, "cpu")


def test_without_onnxruntime_the_remedy_is_named(tmp_path, anymal, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ValueError, match=r"policy\.onnx' needs onnx and onnxruntime.*pip install onnx onnxruntime"):
        load_policy(save(tmp_path / "policy.onnx", linear()), anymal, "cpu")


def test_every_flipped_byte_of_a_sealed_file_is_seen(tmp_path, anymal):
    whole = seal(linear())
    path = tmp_path / "sealed.onnx"
    path.write_bytes(whole)
    assert isinstance(load_policy(path, anymal, "cpu"), OnnxPolicy)
    for position in np.random.default_rng(0).integers(len(whole), size=100):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        with pytest.raises(ValueError, match=r"sealed\.onnx"):
            load_policy(path, anymal, "cpu")


@pytest.mark.parametrize("how", ["weights", "checksum gone", "two checksums", "something after it"])
def test_a_sealed_file_that_was_changed_is_named(tmp_path, anymal, how):
    whole = seal(linear())
    model = onnx.ModelProto.FromString(whole)
    if how == "weights":
        model.graph.initializer[1].CopyFrom(numpy_helper.from_array(np.zeros(ACTIONS, np.float32), "b"))
    elif how == "checksum gone":
        del model.metadata_props[:]
    elif how == "two checksums":
        model.metadata_props.append(model.metadata_props[0])
    else:
        model.doc_string = "mine"
    with pytest.raises(ValueError, match="does not have its checksum"):
        load_policy(save(tmp_path / "changed.onnx", model), anymal, "cpu")
    model.producer_name = "another tool"
    del model.metadata_props[:]
    assert isinstance(load_policy(save(tmp_path / "changed.onnx", model), anymal, "cpu"), OnnxPolicy)


@pytest.mark.skipif("CUDAExecutionProvider" in onnxruntime.get_available_providers(), reason="this one can use a GPU")
def test_without_cuda_in_onnxruntime_it_computes_on_the_cpu_and_says_so(tmp_path):
    path = save(tmp_path / "policy.onnx", linear())
    with pytest.warns(
        UserWarning, match=r"policy\.onnx' runs on the CPU, with copies to and from cuda:0.*onnxruntime-gpu"
    ):
        policy = load_onnx(path, (OBSERVATIONS, ACTIONS), "cuda:0")
    assert policy.device == torch.device("cpu")
    assert policy(torch.zeros(3, OBSERVATIONS)).shape == (3, ACTIONS)
