"""Controllers from files: what is accepted (that nothing in them runs: tests/kills); and the runner that calls them."""

import numpy as np
import pytest
import torch
import warp as wp

from sim.controllers.loaders import load_policy, prepare_torch
from sim.controllers.runner import PolicyRunner
from tests.builders import ACTIONS, OBSERVATIONS, rsl_rl_actor, save_checkpoint

STATE = rsl_rl_actor().state_dict()
CHECKPOINTS = {
    "another robot's rows": rsl_rl_actor(48).state_dict(),
    "NaN": STATE | {"mlp.0.bias": STATE["mlp.0.bias"] * float("nan")},
    "no bias": {name: value for name, value in STATE.items() if name != "mlp.2.bias"},
    "a layer that does not fit": STATE | {"mlp.2.weight": torch.zeros(16, 31)},
    "no multilayer perceptron": {"rnn.weight": torch.zeros(2)},
}


@pytest.mark.parametrize("state", CHECKPOINTS.values(), ids=CHECKPOINTS)
def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path, anymal, state):
    with pytest.raises(ValueError, match=r"model\.pt"):
        load_policy(save_checkpoint(tmp_path / "model.pt", state), anymal, "cpu")


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_a_damaged_or_foreign_file_is_refused(tmp_path, anymal):
    path = save_checkpoint(tmp_path / "model.pt", STATE)
    load_policy(path, anymal, "cpu")
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 4  # among the weights
    for content in (b"", whole[: len(whole) // 2], whole[:-9], bytes(flipped), b"\x80\x02.", b"hello\n"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"model\.pt") as raised:
            load_policy(path, anymal, "cpu")
        assert "internal miniz" not in str(raised.value) and ":callable" not in str(raised.value)
    for content in ({"model_state_dict": {}, "iter": 3}, torch.zeros(3)):
        torch.save(content, path)
        with pytest.raises(ValueError, match=r"model\.pt"):
            load_policy(path, anymal, "cpu")
    for other in (torch.nn.Linear(169, 10), torch.nn.LSTM(OBSERVATIONS, ACTIONS)):  # which returns its state too
        torch.jit.script(other).save(str(path))
        with pytest.raises(ValueError, match=r"model\.pt"):
            load_policy(path, anymal, "cpu")
    with pytest.raises(ValueError, match=r"gone\.pt"):
        load_policy(tmp_path / "gone.pt", anymal, "cpu")


def runner_of(policy, observation, action):
    """A runner in the middle of episodes: none begins."""
    return PolicyRunner(policy, observation, action, wp.zeros(len(action), dtype=int, device=action.device))


def test_a_robots_action_is_the_same_bit_for_bit_beside_any_others(anymal):
    """Torch itself rounds otherwise in batches of a few rows; how few is the processor's matter."""
    rows = np.random.default_rng(4).normal(size=(100, OBSERVATIONS)).astype(np.float32)
    policy, actions = load_policy(anymal.policy_file, anymal, "cpu"), {}
    prepare_torch("cpu")
    for count in (*range(1, 40), 100):
        action = wp.zeros((count, ACTIONS), dtype=float, device="cpu")
        runner_of(policy, wp.array(rows[:count], dtype=float, device="cpu"), action)()
        actions[count] = action.numpy()
        with torch.inference_mode():  # as one that calls it in Python does
            np.testing.assert_array_equal(policy(torch.from_numpy(rows[:count])), actions[count])
    assert len(np.unique(actions[100])) == 100 * ACTIONS
    for count, action in actions.items():
        np.testing.assert_array_equal(action, actions[100][:count], err_msg=f"{count} robots")


def test_a_controller_may_keep_and_change_its_row():
    rows = []

    def policy(row):
        rows.append(row)
        row += 1.0
        return row[:, :ACTIONS]

    observation, action = (wp.full((5, size), 0.5, dtype=float, device="cpu") for size in (OBSERVATIONS, ACTIONS))
    runner = runner_of(policy, observation, action)
    runner()
    np.testing.assert_array_equal(observation.numpy(), 0.5)
    observation.fill_(-1.0)
    runner()
    assert [float(row[0, 0]) for row in rows] == [1.5, 0.0]
    np.testing.assert_array_equal(action.numpy(), 0.0)


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (lambda row: torch.zeros(1, ACTIONS), r"\(1, 12\)"),
        (lambda row: torch.zeros(5, ACTIONS, dtype=torch.complex64), "complex64"),
        (lambda row: torch.zeros(5, ACTIONS, device="meta"), "meta"),
        (lambda row: torch.zeros(5, ACTIONS).to_sparse(), "sparse"),
        (lambda row: None, "NoneType"),
        (lambda row: row.no_such_name, r"AttributeError: .*test_loaders\.py, line \d+\)$"),
    ],
)
def test_what_goes_wrong_in_a_crossing_is_named(policy, words):
    observation, action = (wp.zeros((5, size), dtype=float, device="cpu") for size in (OBSERVATIONS, ACTIONS))
    with pytest.raises(ValueError, match=words):
        runner_of(policy, observation, action)()
