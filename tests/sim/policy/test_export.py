"""Export as ONNX: the file is the controller, in one file, and a wrong one is never written."""

import dataclasses
import itertools

import numpy as np
import onnx
import pytest
import torch

from sim.commands import ExportPolicy
from sim.crossing import CrossingCfg
from sim.files.command import run_command
from sim.policy import export as module
from sim.policy.export import export_onnx, to_onnx
from sim.policy.loaders import MlpPolicy, load_policy
from sim.policy.onnx_file import OnnxPolicy, load_onnx
from sim.robots.find import get_robot
from sim.rollout import Rollout
from sim.terrain import crossing_terrain

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


def tell(capsys, *arguments):
    """Exit status, output and error of the command."""
    code = run_command(ExportPolicy, list(map(str, arguments)), name="export-policy")
    return code, *capsys.readouterr()


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("sizes", [(235, 12), (169, 64, 12), (48, 32, 16, 8, 3)])
def test_the_file_is_the_controller(tmp_path, sizes, normalised):
    policy, path = actor(*sizes, normalised=normalised), tmp_path / "new" / "policy.onnx"
    apart = export_onnx(policy, path)
    assert [file.name for file in path.parent.iterdir()] == ["policy.onnx"]
    loaded = load_onnx(path, policy.sizes, "cpu")
    largest = 0.0
    for batch in (1, 7):
        rows = torch.randn((batch, sizes[0]), generator=torch.Generator().manual_seed(9)) * 3
        with torch.inference_mode():
            expected, got = policy(rows), loaded(rows)
        # Both round sums of up to 235 float32 products, each in its own order: a part of the largest of them.
        assert (got - expected).abs().max() <= 1e-5 * max(1.0, expected.abs().max())
        largest = max(largest, expected.abs().max())
    assert 0.0 <= apart <= 1e-5 * largest


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


def test_the_same_controller_is_the_same_bytes():
    assert to_onnx(actor(48, 8, 3)) == to_onnx(actor(48, 8, 3))


@pytest.mark.parametrize("how", ["another weight", "NaN"])
def test_a_wrong_file_is_not_written(tmp_path, monkeypatch, how):
    right, other, path = actor(48, 8, 3), actor(48, 8, 3), tmp_path / "policy.onnx"
    export_onnx(right, path)
    before = path.read_bytes()
    with torch.no_grad():
        other.layers[0].weight[0, 0] += 0.01 if how == "another weight" else float("nan")
    wrong = to_onnx(other)
    monkeypatch.setattr(module, "to_onnx", lambda policy: wrong)
    with pytest.raises(ValueError, match=r"policy\.onnx'.*from the original's, expected at most"):
        export_onnx(right, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]


def test_a_disk_that_writes_something_else_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "write_atomically", lambda path, data: path.write_bytes(data[:-1]))
    with pytest.raises(ValueError, match=r"policy\.onnx"):
        export_onnx(actor(48, 8, 3), tmp_path / "policy.onnx")


@pytest.mark.parametrize("name", ["policy.pt", "policy"])
def test_the_name_must_say_what_it_is(tmp_path, name):
    with pytest.raises(ValueError, match=r"must end in \.onnx"):
        export_onnx(actor(48, 3), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path, monkeypatch, capsys):
    path = tmp_path / "anymal.onnx"
    code, out, _ = tell(capsys, "--robot", "anymal", "--out", path)
    assert code == 0
    assert "observation (batch, 235) -> action (batch, 12)" in out
    assert f"evaluate --robot anymal --policy {path}" in out
    assert isinstance(load_policy(path, ANYMAL, "cpu"), OnnxPolicy)
    # The file is a controller, but not one that can be written again.
    code, _, error = tell(capsys, "--policy", path, "--out", tmp_path / "again.onnx")
    assert code == 2
    assert "must be an rsl_rl checkpoint (.pt with actor_state_dict), got another kind of controller" in error
    assert not (tmp_path / "again.onnx").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--policy", "gone.pt"), "no such file"),
        (("--robot", "cat"), "cat"),
        (("--out", "policy.pt"), "must end in .onnx"),
        (("--out", "taken/policy.onnx"), "cannot write to"),
    ],
)
def test_errors_of_the_command_are_one_line(tmp_path, monkeypatch, capsys, flags, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("a file")
    code, _, error = tell(capsys, *flags)
    assert code == 2
    assert message in error
    assert len(error.splitlines()) == 1


def test_crossings_are_those_of_the_original(tmp_path):
    export_onnx(load_policy(ANYMAL.policy_file, ANYMAL, "cpu"), tmp_path / "policy.onnx")
    terrains = np.stack([crossing_terrain(*kind) for kind in (("stairs_up_down", 9, 3), ("boxes", 5, 1))])
    found = []
    for policy in (ANYMAL.policy_file, tmp_path / "policy.onnx"):
        cfg = CrossingCfg(max_duration_s=0.6, poll_every_s=0.1)
        rollout = Rollout(ANYMAL, policy, num_terrains=2, num_replicas=4, device="cpu", cfg=cfg)
        found.append(dataclasses.asdict(rollout.evaluate(terrains, np.array([7, 8]))))
    first, second = found
    np.testing.assert_array_equal(second["outcome"], first["outcome"])
    np.testing.assert_array_equal(second["fallen"], first["fallen"])
    np.testing.assert_allclose(second["duration_s"], first["duration_s"])
    # Actions differ by 1e-6, which contacts make 1.5e-5 of a penalty within 0.6 s.
    np.testing.assert_allclose(second["penalties"], first["penalties"], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(second["final_position"], first["final_position"], atol=1e-4)
    assert (first["penalties"][..., 0] > 0).all()
