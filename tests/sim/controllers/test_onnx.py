"""Controllers in ONNX files: they act as their weights say, and what does not fit is refused; and their export."""

import numpy as np
import onnx.parser
import onnxruntime
import pytest
import torch
from onnx import numpy_helper

from sim.controllers.formats.onnx import export_onnx, load_onnx
from sim.controllers.formats.rsl_rl import MlpPolicy
from sim.controllers.loaders import load_actor, load_policy
from sim.controllers.runner import is_graph_safe
from sim.controllers.spec import ControllerSpec, controller_hash
from tests.builders import ACTIONS, OBSERVATIONS, rows_of, rsl_rl_actor
from tests.sim.controllers.test_loaders import runner_on


def parse(text, **weights):
    """A graph in ONNX's own text, with these weights."""
    model = onnx.parser.parse_model(f'<ir_version: 8, opset_import: ["": 17]> policy {text}')
    model.graph.initializer.extend(numpy_helper.from_array(np.array(value), key) for key, value in weights.items())
    return model


def linear(observations=OBSERVATIONS, actions=ACTIONS, batch="batch", columns=None, bias=None):
    """One layer, as a foreign exporter would write it: other names than ours."""
    weight = np.random.default_rng(3).normal(size=(actions, observations)).astype(np.float32) / 10
    offset = np.linspace(-1, 1, actions, dtype="f4") if bias is None else bias
    ports = f"(float[{batch}, {columns or observations}] obs) => (float[{batch}, {columns or actions}] actions)"
    return parse(f"{ports} {{ actions = Gemm<transB = 1>(obs, w, b) }}", w=weight, b=offset)


def chain(last, bound=False):
    """As mujoco_playground's exporter: normalised, a layer with swish, one with mean and spread, for one robot.

    With ``bound`` a node of it knows that there is one.
    """
    rng = np.random.default_rng(5)
    width = OBSERVATIONS
    shapes = {"mean": width, "factor": width, "w0": (width, 16), "b0": 16, "w1": (16, 24), "b1": 24}
    weights = {name: rng.normal(size=shape).astype(np.float32) / 5 for name, shape in shapes.items()}
    text = f"""(float[1, {width}] obs) => (float[1, {ACTIONS}] actions) {{
        raw = {"Reshape(obs, size)" if bound else "Identity(obs)"}
        centred = Sub(raw, mean)
        rows = Mul(centred, factor)
        hidden = Gemm(rows, w0, b0)
        gate = Sigmoid(hidden)
        swish = Mul(hidden, gate)
        out = Gemm(swish, w1, b1)
        mode, spread = Split<axis = -1>(out)
        actions = {last}(mode)
    }}"""
    return parse(text, size=[1, width], **weights), weights


def save(path, model):
    path.write_bytes(model if isinstance(model, bytes) else model.SerializeToString())
    return path


@pytest.mark.filterwarnings("ignore:policy.*runs on the CPU")
@pytest.mark.parametrize(
    ("last", "function"), [("Tanh", np.tanh), ("Softsign", lambda value: value / (1.0 + np.abs(value)))]
)
def test_it_acts_as_its_weights_say_captured_if_its_operators_are_known(tmp_path, anymal, device, last, function):
    model, weights = chain(last)
    policy = load_policy(str(save(tmp_path / "policy.onnx", model)), anymal, device)
    assert is_graph_safe(policy) == (last == "Tanh")
    runner, observation, action, _ = runner_on(policy, rows_of(33).numpy(), device)
    for rows in (rows_of(33).numpy(), -rows_of(33).numpy()):
        observation.assign(rows)
        runner()
        hidden = (rows - weights["mean"]) * weights["factor"] @ weights["w0"].astype(float) + weights["b0"]
        out = hidden / (1.0 + np.exp(-hidden)) @ weights["w1"] + weights["b1"]
        # Sums of 235 float32 products of order 0.1; on a GPU perhaps of TF32.
        near = {"rtol": 2e-3, "atol": 5e-3} if device.startswith("cuda") else {"rtol": 1e-5, "atol": 1e-5}
        np.testing.assert_allclose(action.numpy(), function(out[:, :ACTIONS]), **near)


@pytest.mark.parametrize("model", [linear(columns="columns"), chain("Softsign")[0]], ids=["torch", "onnxruntime"])
def test_a_row_is_answered_alike_in_any_batch_and_a_width_may_be_unknown(tmp_path, anymal, model):
    policy = load_policy(save(tmp_path / "policy.onnx", model), anymal, "cpu")
    for size in (1, 4, 7, 20):
        assert torch.equal(torch.cat([policy(rows) for rows in rows_of(60).split(size)]), policy(rows_of(60))), size


def test_a_graph_that_knows_of_one_robot_runs_once_a_robot(tmp_path, anymal):
    with pytest.warns(UserWarning, match=r"bound\.onnx.*one robot after the other"):
        bound = load_policy(save(tmp_path / "bound.onnx", chain("Softsign", bound=True)[0]), anymal, "cpu")
    known = load_policy(save(tmp_path / "free.onnx", chain("Softsign")[0]), anymal, "cpu")
    torch.testing.assert_close(bound(rows_of(7)), known(rows_of(7)), rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:policy.*one robot after the other")
@pytest.mark.parametrize("batch", ["n", 1])
@pytest.mark.parametrize("last", ["Identity", "Softsign"])
def test_inputs_are_columns_of_the_row_states_come_back_and_other_outputs_are_named(tmp_path, batch, last):
    text = f"""(float[{batch}, 2] command, float[{batch}, 2, 3] past, float[{batch}, 3] speed)
        => (float[{batch}, 3] mean, float[{batch}, 2, 3] past_out, float[{batch}, 5] actions) {{
        newer = Slice(past, start, end, axis)
        now = Unsqueeze(speed, axis)
        past_out = Concat<axis = 1>(newer, now)
        mean = ReduceMean<axes = [1], keepdims = 0>(past_out)
        both = Concat<axis = -1>(command, mean)
        actions = {last}(both)
    }}"""
    model = parse(text, start=[1], end=[2], axis=[1])
    with pytest.warns(UserWarning, match=r"policy\.onnx' returns more than actions: mean"):
        policy = load_onnx(save(tmp_path / "policy.onnx", model), (5, 5), "cpu")
    assert is_graph_safe(policy) == (last == "Identity")
    policy.reset(torch.ones(2, dtype=torch.bool))
    rows = torch.tensor([[1.0, 2.0, 4.0, 6.0, 8.0], [0.0, 0.0, 2.0, 2.0, 2.0]])
    expected = rows * torch.tensor([1, 1, 0.5, 0.5, 0.5])  # the mean of speed and the zeros before the episode
    function = torch.nn.functional.softsign if last == "Softsign" else torch.clone
    torch.testing.assert_close(policy(rows), function(expected))
    policy.reset(torch.tensor([True, False]))
    torch.testing.assert_close(policy(rows), function(torch.stack([expected[0], rows[1]])))  # the other's speed again


MODELS = {
    "another robot's rows": linear(48),
    "another robot's rows, of unknown width": linear(48, columns="columns"),
    "a batch of four": linear(batch=4),
    "NaN": linear(bias=np.full(ACTIONS, np.nan, np.float32)),
    "no batch": parse("(float[12] obs) => (float[12] actions) { actions = Identity(obs) }"),
    "doubles": parse("(double[n, 12] obs) => (double[n, 12] actions) { actions = Identity(obs) }"),
    "no state that comes out": parse("(float[n, 235] a, float[1, n, 3] h_in) => (float[n, 235] b) { b = Identity(a) }"),
    "rows that are mixed": parse(
        "(float[n, 235] obs) => (float[n, 12] actions) { sums = CumSum(obs, axis) actions = Gemm(sums, w) }",
        axis=0,
        w=np.eye(OBSERVATIONS, ACTIONS, dtype="f4"),
    ),
    "no graph": parse("() => () {}"),
    "half a file": linear().SerializeToString()[:-9],
}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_model_that_does_not_fit_is_refused(tmp_path, anymal, model, capfd):
    with pytest.raises(ValueError, match=r"theirs\.onnx"):
        load_policy(save(tmp_path / "theirs.onnx", model), anymal, "cpu")
    assert capfd.readouterr() == ("", ""), "onnxruntime says it a second time"


def split(path):
    """One layer whose weights are in a file beside it, as torch 2.9 writes it, and where its tensors say they are."""
    onnx.save(linear(), path, save_as_external_data=True, location="policy.onnx.data", size_threshold=0)
    model = onnx.load(path, load_external_data=False)
    return model, [{field.key: field for field in tensor.external_data} for tensor in model.graph.initializer]


def test_weights_in_a_file_beside_it_belong_to_the_controller(tmp_path, anymal):
    path = tmp_path / "policy.onnx"
    split(path)
    policy, whole = load_policy(path, anymal, "cpu"), load_policy(save(tmp_path / "w.onnx", linear()), anymal, "cpu")
    assert torch.equal(policy(rows_of(7)), whole(rows_of(7))) and is_graph_safe(policy)
    data = path.with_name("policy.onnx.data")
    assert ControllerSpec.parse(path).files == (path, data)
    before = controller_hash(path)
    data.write_bytes(data.read_bytes()[::-1])
    assert before != controller_hash(path)
    data.write_bytes(bytes(200_000))
    with pytest.raises(ValueError, match=r"policy\.onnx\.data must have"):
        load_policy(path, anymal, "cpu")
    data.unlink()
    with pytest.raises(ValueError, match=r"policy\.onnx\.data, which is not beside it"):
        load_policy(path, anymal, "cpu")


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [("location", "../policy.onnx.data", "beside"), ("location", "/tmp/policy.onnx.data", "beside"),
     ("location", "", "beside"), ("location", "link.data", "beside"), ("location", "more.data", "beside"),
     ("length", "4", "'w'"), ("offset", "8", "'b'"), ("offset", "-4", "'w'")],
)  # fmt: skip
def test_weights_elsewhere_or_of_another_size_are_refused(tmp_path, anymal, key, value, what):
    path = tmp_path / "mine" / "policy.onnx"
    path.parent.mkdir()
    (path.parent / "link.data").symlink_to(tmp_path / "elsewhere.data")
    model, tensors = split(path)
    for fields in tensors[: 1 if value == "more.data" else 2]:  # w, then b
        fields[key].value = str(int(fields[key].value) + 8) if value == "8" else value
    with pytest.raises(ValueError, match=rf"policy\.onnx.*{what}"):
        load_policy(save(path, model), anymal, "cpu")


@pytest.mark.skipif("CUDAExecutionProvider" in onnxruntime.get_available_providers(), reason="this one can use a GPU")
def test_without_cuda_in_onnxruntime_it_computes_on_the_cpu_and_says_so(tmp_path):
    path = save(tmp_path / "policy.onnx", chain("Softsign")[0])
    with pytest.warns(UserWarning, match="onnxruntime-gpu"):
        policy = load_onnx(path, (OBSERVATIONS, ACTIONS), "cuda:0")
    assert policy(torch.zeros(3, OBSERVATIONS)).shape == (3, ACTIONS)


@pytest.mark.parametrize("normalised", [False, True])
def test_an_exported_file_is_the_controller(tmp_path, normalised):
    policy, path = MlpPolicy(rsl_rl_actor(48, 3, normalised).state_dict()), tmp_path / "new" / "policy.onnx"
    export_onnx(policy, path)
    assert [file.name for file in path.parent.iterdir()] == ["policy.onnx"]
    rows = rows_of(7)[:, :48] * 3
    with torch.inference_mode():
        expected, actions = policy(rows), load_onnx(path, policy.sizes, "cpu")(rows)
    # Both round sums of up to 48 float32 products, each in its own order: a part of the largest of them.
    assert (actions - expected).abs().max() <= 1e-5 * max(1.0, expected.abs().max())
    session = onnxruntime.InferenceSession(path)
    shapes = [(port.name, port.shape) for port in (*session.get_inputs(), *session.get_outputs())]
    assert shapes == [("observation", ["batch", 48]), ("action", ["batch", 3])]


def test_only_a_checkpoint_can_be_exported_and_to_an_onnx_file(tmp_path, anymal):
    with pytest.raises(ValueError, match=r"policy\.pt"):
        export_onnx(MlpPolicy(rsl_rl_actor(48, 3).state_dict()), tmp_path / "policy.pt")
    with pytest.raises(ValueError, match=r"a\.onnx"):
        load_actor(save(tmp_path / "a.onnx", linear()), anymal)
