"""Controllers from files and callables: what is accepted, and that nothing else runs."""

import dataclasses
import os
import pickle
import sys

import numpy as np
import pytest
import torch
import warp as wp
from tensordict import TensorDict

from sim.policy.loaders import load_policy, prepare_torch
from sim.policy.runner import PolicyRunner
from tests.builders import ACTIONS, OBSERVATIONS, rsl_rl_actor, save_checkpoint


def near(device: str) -> dict[str, float]:
    """Tolerances of a small network: float32, or on a GPU the ten bits of TF32."""
    return {"rtol": 2e-3, "atol": 5e-3} if device.startswith("cuda") else {"rtol": 1e-5, "atol": 1e-5}


@pytest.mark.parametrize("normalised", [False, True])
def test_an_rsl_rl_checkpoint_acts_as_rsl_rl_does(tmp_path, anymal, device, normalised):
    actor = rsl_rl_actor(normalised=normalised)
    policy = load_policy(save_checkpoint(tmp_path / "model_7.pt", actor.state_dict()), anymal, device)
    rows = torch.randn(9, OBSERVATIONS) * 2
    with torch.inference_mode():
        expected = actor(TensorDict({"policy": rows}, batch_size=9))
        got = policy(rows.to("cuda" if device.startswith("cuda") else "cpu"))
    torch.testing.assert_close(got.cpu(), expected, **near(device))


@pytest.mark.filterwarnings("ignore:.torch.jit")
@pytest.mark.parametrize("suffix", [".pt", ".ts"])
def test_torchscript_loads(tmp_path, anymal, device, suffix):
    module = torch.nn.Sequential(torch.nn.Linear(OBSERVATIONS, ACTIONS), torch.nn.Tanh())
    path = tmp_path / f"policy{suffix}"
    torch.jit.trace(module, torch.zeros(4, OBSERVATIONS)).save(str(path))
    policy = load_policy(str(path), anymal, device)
    rows = torch.randn(5, OBSERVATIONS)
    got = policy(rows.to("cuda" if device.startswith("cuda") else "cpu"))
    torch.testing.assert_close(got.detach().cpu(), module(rows).detach(), **near(device))


def test_a_factory_is_given_robot_and_device(anymal):
    policy = load_policy("tests.sim.policies:Controller", anymal, "cpu")
    assert policy.num_joints == ACTIONS
    assert (policy(torch.zeros(2, OBSERVATIONS)) == 0.25).all()


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [(48, 12, "48 observations"), (235, 10, "10 actions")],
)
def test_a_checkpoint_of_another_robot_is_named(tmp_path, anymal, observations, actions, message):
    path = save_checkpoint(tmp_path / "other.pt", rsl_rl_actor(observations, actions).state_dict())
    with pytest.raises(ValueError, match=message):
        load_policy(path, anymal, "cpu")


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_torchscript_of_another_robot_is_named(tmp_path, anymal):
    path = tmp_path / "policy.ts"
    torch.jit.trace(torch.nn.Linear(169, 10), torch.zeros(4, 169)).save(str(path))
    with pytest.raises(ValueError, match=r"\(4, 235\)"):
        load_policy(path, anymal, "cpu")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("too_few_actions", r"\(num_envs, 12\).*got \(4, 11\)"),
        ("list_of_actions", "got list"),
        ("not_finite", "not finite"),
        ("fails", "expected 48 columns"),
        ("NOT_CALLABLE", "must be callable, got int"),
        ("no_such_name", "cannot be imported.*no_such_name"),
    ],
)
def test_a_callable_that_does_not_fit_is_named(anymal, name, message):
    with pytest.raises(ValueError, match=message):
        load_policy(f"tests.sim.policies:{name}", anymal, "cpu")


def test_a_checkpoint_with_nan_is_refused(tmp_path, anymal):
    state = rsl_rl_actor().state_dict()
    state["mlp.0.bias"] = state["mlp.0.bias"] * float("nan")
    with pytest.raises(ValueError, match="not finite"):
        load_policy(save_checkpoint(tmp_path / "nan.pt", state), anymal, "cpu")


class Bomb:
    """Unpickling it creates the file it names."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("how", ["torch", "pickle", "inside a checkpoint"])
def test_code_in_a_file_does_not_run(tmp_path, anymal, how):
    proof, path = tmp_path / "it_ran", tmp_path / "bomb.pt"
    if how == "pickle":
        path.write_bytes(pickle.dumps(Bomb(str(proof))))
    elif how == "torch":
        torch.save(Bomb(str(proof)), path)
    else:
        save_checkpoint(path, rsl_rl_actor().state_dict(), infos=Bomb(str(proof)))
    with pytest.raises(ValueError, match=r"bomb\.pt"):
        load_policy(path, anymal, "cpu")
    assert not proof.exists()
    pickle.loads(pickle.dumps(Bomb(str(proof))))
    assert proof.exists(), "the bomb is a dud: this test proves nothing"


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, anymal, share):
    path = save_checkpoint(tmp_path / "model.pt", rsl_rl_actor().state_dict())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=r"model\.pt"):
        load_policy(path, anymal, "cpu")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"model_state_dict": {"actor.0.weight": torch.zeros(2, 2)}, "iter": 3}, "model_state_dict, iter"),
        ({"actor_state_dict": {"rnn.weight": torch.zeros(2)}}, "mlp.0.weight"),
        ([1, 2, 3], "list"),
        (torch.zeros(3), "Tensor"),
    ],
)
def test_a_foreign_file_is_named(tmp_path, anymal, content, message):
    torch.save(content, tmp_path / "foreign.pt")
    with pytest.raises(ValueError, match=message):
        load_policy(tmp_path / "foreign.pt", anymal, "cpu")


@pytest.mark.parametrize("damage", ["no bias", "a layer that does not fit", "no tensor", "a short bias"])
def test_a_checkpoint_with_a_damaged_layer_is_refused(tmp_path, anymal, damage):
    state = dict(rsl_rl_actor().state_dict())
    if damage == "no bias":
        del state["mlp.2.bias"]
    elif damage == "a layer that does not fit":
        state["mlp.2.weight"] = torch.zeros(16, 31)
    elif damage == "no tensor":
        state["mlp.2.weight"] = "lost"
    else:
        state["mlp.2.bias"] = torch.zeros(3)
    path = save_checkpoint(tmp_path / "damaged.pt", state)
    with pytest.raises(ValueError, match=r"damaged\.pt"):
        load_policy(path, anymal, "cpu")


@pytest.mark.parametrize("opcodes", [b"\x80\x02.", b"\x80\x02\x86.", b"\x80\x02K", b"hello world\n"])
def test_a_broken_stream_of_opcodes_is_refused(tmp_path, anymal, opcodes):
    (tmp_path / "broken.pt").write_bytes(opcodes)
    with pytest.raises(ValueError, match=r"broken\.pt"):
        load_policy(tmp_path / "broken.pt", anymal, "cpu")


@pytest.mark.parametrize(
    ("source", "line"),
    [
        ("def policy(:", None),
        ("1 / 0", 1),
        ("def policy(observation):\n raise ValueError", 2),
        ("def policy(o): return o @ o", 1),
        ("class policy: pass", None),
        ("\ndef policy(robot, device): pass", None),
        ("class policy:\n faultline_factory = True\n def __init__(self, robot): pass", None),
        ("def act(o): pass", None),
        ("def policy(robot, device): raise KeyError('gone')\npolicy.faultline_factory = True", 1),
    ],
)
def test_code_that_fails_is_named(tmp_path, anymal, monkeypatch, source, line):
    (tmp_path / "theirs.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "theirs", raising=False)
    place = "" if line is None else rf"theirs\.py, line {line}\)"
    with pytest.raises(ValueError, match=rf"policy 'theirs:policy'.*{place}"):
        load_policy("theirs:policy", anymal, "cpu")


def test_the_size_comes_from_the_robot(tmp_path, anymal):
    small = dataclasses.replace(anymal, scan_x=(0.0,), scan_y=(0.0,))
    path = save_checkpoint(tmp_path / "small.pt", rsl_rl_actor(49).state_dict())
    assert load_policy(path, small, "cpu").sizes == (49, 12)


def runner_of(policy, observation, action):
    """A runner in the middle of episodes: none begins."""
    return PolicyRunner(policy, observation, action, wp.zeros(len(action), dtype=int, device=action.device))


def test_the_runner_writes_actions_into_its_buffer(anymal, device):
    observation = wp.full((5, OBSERVATIONS), 0.5, dtype=float, device=device)
    action = wp.zeros((5, ACTIONS), dtype=float, device=device)
    policy = load_policy(anymal.policy_file, anymal, device)
    runner = runner_of(policy, observation, action)
    runner()
    with torch.inference_mode():
        expected = policy(wp.to_torch(observation))
    torch.testing.assert_close(wp.to_torch(action), expected)
    observation.fill_(-1.0)
    runner()
    assert not torch.allclose(wp.to_torch(action), expected)


def test_a_robots_action_is_the_same_bit_for_bit_beside_any_others(anymal):
    """Torch itself rounds otherwise in batches of a few rows; how few is the processor's matter."""
    rows = np.random.default_rng(4).normal(size=(200, OBSERVATIONS)).astype(np.float32)
    policy, actions = load_policy(anymal.policy_file, anymal, "cpu"), {}
    prepare_torch("cpu")
    for count in (*range(1, 40), 64, 100, 200):
        action = wp.zeros((count, ACTIONS), dtype=float, device="cpu")
        runner_of(policy, wp.array(rows[:count], dtype=float, device="cpu"), action)()
        actions[count] = action.numpy()
        with torch.inference_mode():  # as one that calls it in Python does
            np.testing.assert_array_equal(policy(torch.from_numpy(rows[:count])), actions[count])
    assert len(np.unique(actions[200])) == 200 * ACTIONS
    for count, action in actions.items():
        np.testing.assert_array_equal(action, actions[200][:count], err_msg=f"{count} robots")


def test_what_remembers_gets_a_row_a_robot():
    class Counter(torch.nn.Module):
        def reset(self, rows):
            self.rows = len(rows)

        def forward(self, row):
            assert len(row) == self.rows
            return row[:, :ACTIONS]

    observation, action = (wp.ones((5, size), dtype=float, device="cpu") for size in (OBSERVATIONS, ACTIONS))
    runner_of(Counter(), observation, action)()
    np.testing.assert_array_equal(action.numpy(), 1.0)


def test_a_controller_may_keep_and_change_its_row(anymal):
    kept = []

    def policy(row):
        kept.append(row)
        row += 1.0
        return row[:, :ACTIONS]

    observation = wp.full((5, OBSERVATIONS), 0.5, dtype=float, device="cpu")
    action = wp.zeros((5, ACTIONS), dtype=float, device="cpu")
    runner = runner_of(policy, observation, action)
    runner()
    np.testing.assert_array_equal(observation.numpy(), 0.5)
    observation.fill_(-1.0)
    runner()
    assert [float(row[0, 0]) for row in kept] == [1.5, 0.0]
    np.testing.assert_array_equal(action.numpy(), 0.0)


def fails(_):
    raise RuntimeError("enough\nof it")


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda row: torch.zeros(1, ACTIONS), r"shape \(5, 12\), got \(1, 12\)"),
        (lambda row: torch.zeros(5, ACTIONS, dtype=torch.int64), "plain floats, got torch.int64"),
        (lambda row: torch.zeros(5, ACTIONS, dtype=torch.complex64), "plain floats, got torch.complex64"),
        (lambda row: torch.zeros(5, ACTIONS, device="meta"), "plain floats, got .* on meta"),
        (lambda row: torch.zeros(5, ACTIONS).to_sparse(), "plain floats, got .*sparse"),
        (lambda row: None, "got NoneType"),
        (fails, r"fails failed .* of shape \(5, 235\): RuntimeError: enough \(.*test_loaders.py, line \d+\)$"),
    ],
)
def test_what_goes_wrong_in_a_crossing_is_named(policy, message):
    observation, action = (wp.zeros((5, size), dtype=float, device="cpu") for size in (OBSERVATIONS, ACTIONS))
    with pytest.raises(ValueError, match=message):
        runner_of(policy, observation, action)()
