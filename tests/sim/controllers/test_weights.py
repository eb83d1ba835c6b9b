"""Weights of other people's training: checkpoints of every rsl_rl, networks that remember, graphs of one robot."""

import pytest
import torch
from rsl_rl.models import RNNModel
from tensordict import TensorDict

from sim.controllers.loaders import load_policy
from sim.controllers.runner import Memory, find_memory
from tests.builders import ACTIONS, OBSERVATIONS, rows_of, rsl_rl_actor

ACTOR = rsl_rl_actor(normalised=True).state_dict()


def renamed(**names):
    return {new + key.removeprefix(old): value for old, new in names.items() for key, value in ACTOR.items()
            if key.startswith(old)}  # fmt: skip


def old_checkpoints():
    """The same actor as rsl_rl 1 or 2, with a normaliser of its own, and 3 or 4 keep it."""
    critic = {"critic.0.weight": torch.zeros(16, 9), "critic.0.bias": torch.zeros(16)}
    layers, normaliser = renamed(mlp="actor"), renamed(obs_normalizer="actor_obs_normalizer")
    bare = {key.removeprefix("obs_normalizer."): value for key, value in ACTOR.items() if "normalizer" in key}
    rest = {"optimizer_state_dict": {}, "iter": 3, "infos": None}
    return {
        "2": {"model_state_dict": layers | critic | {"std": torch.ones(12)}, "obs_norm_state_dict": bare} | rest,
        "3": {"model_state_dict": layers | critic | normaliser | {"log_std": torch.ones(12)}} | rest,
        "5": {"actor_state_dict": ACTOR, "critic_state_dict": {}} | rest,
    }


@pytest.mark.parametrize(("version", "place"), [("2", "agent.yaml"), ("3", "params/agent.yaml"), ("5", "agent.yaml")])
def test_a_checkpoint_of_any_rsl_rl_acts_as_its_training_says(tmp_path, anymal, version, place):
    path, agent = tmp_path / "model_9.pt", tmp_path / place
    torch.save(old_checkpoints()[version], path)
    with pytest.raises(ValueError, match=r"model_9\.pt.*agent\.yaml"):  # it does not say what is between its layers
        load_policy(path, anymal, "cpu")
    agent.parent.mkdir(exist_ok=True)
    tags = "range: !!python/tuple [0, 1]\nact: !!python/name:torch.nn.Tanh\n"
    agent.write_text(f"{tags}{'actor' if version == '5' else 'policy'}:\n  class_name: X\n  activation: tanh\n")
    rows = rows_of(4)
    x = (rows - ACTOR["obs_normalizer._mean"]) / (ACTOR["obs_normalizer._std"] + 1e-2)
    for k in (0, 2, 4):
        x = x @ ACTOR[f"mlp.{k}.weight"].T + ACTOR[f"mlp.{k}.bias"]
        x = torch.tanh(x) if k < 4 else x
    torch.testing.assert_close(load_policy(path, anymal, "cpu")(rows).detach(), x, rtol=1e-5, atol=1e-5)
    agent.write_text("policy: {activation: !!python/object/apply:os.system [exit]}")
    with pytest.raises(ValueError, match="activation"):
        load_policy(path, anymal, "cpu")


@pytest.mark.parametrize(
    "key", ["student.0.weight", "estimator.0.bias", "actor.1.running_mean", "obs_normalizer.running_mean"]
)
def test_what_is_no_part_of_a_known_network_is_refused_by_name(tmp_path, anymal, key):
    content = old_checkpoints()["2"]
    part = "obs_norm_state_dict" if "normalizer" in key else "model_state_dict"
    content[part][key.removeprefix("obs_normalizer.")] = torch.zeros(3)
    for state, named in ((content, key), (content | {"obs_norm_state_dict": [1.0]}, "obs_norm_state_dict .* list")):
        torch.save(state | {"activation": "elu"}, tmp_path / "model.pt")
        with pytest.raises(ValueError, match=rf"model\.pt.*{named}"):
            load_policy(tmp_path / "model.pt", anymal, "cpu")


@pytest.fixture(scope="module", params=["lstm", "gru"])
def recurrent(request):
    """rsl_rl's own recurrent actor of two layers, with a normaliser; and what it does with 12 steps of 5 robots."""
    torch.manual_seed(3)
    rows = TensorDict({"policy": rows_of(64)}, batch_size=64)
    actor = RNNModel(rows, {"actor": ["policy"]}, "actor", ACTIONS, (16,), "elu", True, rnn_type=request.param,
                     rnn_hidden_dim=8, rnn_num_layers=2)  # fmt: skip
    actor.train()
    actor.obs_normalizer.update(rows["policy"])
    actor.eval()
    steps = rows_of(12, 5)
    with torch.inference_mode():
        expected = [actor(TensorDict({"policy": step}, batch_size=5)) for step in steps]
    return actor, steps, torch.stack(expected)


@pytest.mark.filterwarnings("ignore:.torch.jit", "ignore:.torch.onnx", "ignore:You are using the legacy")
@pytest.mark.parametrize("kind", ["checkpoint", "rsl_rl 3", "script", "onnx"])
def test_what_remembers_one_robot_remembers_any_number_apart(tmp_path, anymal, recurrent, kind):
    actor, steps, expected = recurrent
    path = tmp_path / ("policy.onnx" if kind == "onnx" else "policy.pt")
    if kind == "checkpoint":
        torch.save({"actor_state_dict": actor.state_dict(), "activation": "elu"}, path)
    elif kind == "rsl_rl 3":
        names = {"rnn.rnn.": "memory_a.rnn.", "mlp.": "actor.", "obs_normalizer.": "actor_obs_normalizer."}
        old = {new + key.removeprefix(now): value for now, new in names.items()
               for key, value in actor.state_dict().items() if key.startswith(now)}  # fmt: skip
        torch.save({"model_state_dict": old, "activation": "elu"}, path)
    elif kind == "script":
        torch.jit.script(actor.as_jit().eval()).save(str(path))
    else:
        model = actor.as_onnx(False).eval()
        torch.onnx.export(model, model.get_dummy_inputs(), str(path), input_names=model.input_names,
                          output_names=model.output_names, opset_version=18, dynamo=False)  # fmt: skip
    policy = load_policy(path, anymal, "cpu")
    assert find_memory(policy) is Memory.PER_ROBOT
    policy.reset(torch.ones(5, dtype=torch.bool))
    for step, actions in zip(steps, expected, strict=True):
        torch.testing.assert_close(policy(step), actions, rtol=1e-4, atol=1e-5)
    policy.reset(torch.tensor([False, True, False, False, True]))  # these two begin again
    again = torch.stack([policy(step) for step in steps])
    torch.testing.assert_close(again[:, [1, 4]], expected[:, [1, 4]], rtol=1e-4, atol=1e-5)
    assert (again - expected)[:, [0, 2, 3]].abs().amax() > 1e-3
    alone = []
    for count in (1, 3, 40):  # bit for bit beside any others
        policy.reset(torch.ones(count, dtype=torch.bool))
        alone.append(torch.stack([policy(step[:1].expand(count, -1))[0] for step in steps]))
    assert torch.equal(alone[0], alone[1]) and torch.equal(alone[0], alone[2])


class Exported(torch.nn.Module):
    """A layer as exporters write it, with a ``reset`` that does nothing, or a memory."""

    def __init__(self, kind: str):
        super().__init__()
        self.kind, self.layer = kind, torch.nn.Linear(OBSERVATIONS, ACTIONS)
        self.last = torch.nn.Buffer(torch.zeros(1, OBSERVATIONS))
        self.calls: int = 0

    @torch.jit.export
    def reset(self) -> None:
        if self.kind == "averages":
            self.last[:] = 0.0

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.kind == "averages":
            self.last[:] = 0.5 * self.last + 0.5 * x
            return self.layer(self.last)
        if self.kind == "counts":
            self.calls += 1
            return self.layer(x) * float(max(self.calls, 9))
        if self.kind == "the first row's":
            assert len(self.last) == 1  # whose error is of a kind of its own
            self.last[:] = 0.5 * self.last + 0.5 * x[:1]
            return self.layer(x + self.last[:1])
        return self.layer(x)


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_a_reset_that_does_nothing_is_no_memory(tmp_path, anymal):
    policies = {}
    for kind in ("plain", "averages", "the first row's", "counts"):
        torch.manual_seed(0)
        torch.jit.script(Exported(kind)).save(str(tmp_path / f"{kind}.pt"))
        if kind in ("the first row's", "counts"):
            with pytest.raises(ValueError, match=r"row's\.pt.* last|counts\.pt.* other steps"):
                load_policy(tmp_path / f"{kind}.pt", anymal, "cpu")
        else:
            policies[kind] = load_policy(tmp_path / f"{kind}.pt", anymal, "cpu")
    assert find_memory(policies["plain"]) is Memory.NONE
    assert find_memory(policies["averages"]) is Memory.PER_ROBOT
    rows = rows_of(4)
    torch.manual_seed(0)
    layer = Exported("plain").layer
    torch.testing.assert_close(policies["averages"](rows), layer(rows / 2).detach(), rtol=1e-4, atol=1e-5)
