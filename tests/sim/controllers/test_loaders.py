"""Controllers from files and from code: what is accepted (that nothing in files runs: tests/kills), what they remember,
what their names mean; and the runner that calls them."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from rsl_rl.models import RNNModel
from tensordict import TensorDict

from sim.controllers.described import read_row
from sim.controllers.formats.onnx import export_onnx
from sim.controllers.formats.rsl_rl import MlpPolicy
from sim.controllers.loaders import load_policy, prepare_torch
from sim.controllers.runner import Memory, PolicyRunner, find_memory
from sim.controllers.spec import ControllerSpec, controller_hash, describe_controllers, label_suffix, parse_controllers
from tests.builders import ACTIONS, OBSERVATIONS, rows_of, rsl_rl_actor, save_checkpoint, seen

ADAPTER = "def adapt(actor, robot): "
STATE = rsl_rl_actor().state_dict()
ACTOR = rsl_rl_actor(normalised=True).state_dict()
CHECKPOINTS = {
    "another robot's rows": rsl_rl_actor(48).state_dict(),
    "NaN": STATE | {"mlp.0.bias": STATE["mlp.0.bias"] * float("nan")},
    "no bias": {name: value for name, value in STATE.items() if name != "mlp.2.bias"},
    "a layer that does not fit": STATE | {"mlp.2.weight": torch.zeros(16, 31)},
    "no multilayer perceptron": {"rnn.weight": torch.zeros(2)},
}


def runner_on(policy, rows, device="cpu"):
    """A runner, the rows that it sees, its actions, and where episodes begin: nowhere at first."""
    with wp.ScopedDevice(device):
        seen, begins = wp.array(rows, dtype=float), wp.zeros(len(rows), dtype=int)
        action = wp.zeros((len(rows), ACTIONS), dtype=float)
    return PolicyRunner(policy, seen, action, begins), seen, action, begins


def recurrent_actor(width, *, rnn_type="lstm", layers=1, normalised=False):
    """rsl_rl's own recurrent actor, with a normaliser that has seen 64 rows if it has one."""
    torch.manual_seed(3)
    rows = TensorDict({"policy": rows_of(64)[:, :width]}, batch_size=64)
    options = {"rnn_type": rnn_type, "rnn_hidden_dim": 8, "rnn_num_layers": layers}
    actor = RNNModel(rows, {"actor": ["policy"]}, "actor", ACTIONS, (16,), "elu", normalised, **options)
    return seen(actor, rows) if normalised else actor.eval()


def rename(state, names):
    """The tensors whose names begin with a key of ``names``, which becomes its value."""
    return {new + key.removeprefix(old): value for old, new in names.items() for key, value in state.items()
            if key.startswith(old)}  # fmt: skip


def old_checkpoints():
    """The same actor as rsl_rl 1 or 2, with a normaliser of its own, and 3 or 4 keep it."""
    critic = {"critic.0.weight": torch.zeros(16, 9), "critic.0.bias": torch.zeros(16)}
    layers = rename(ACTOR, {"mlp.": "actor."}) | critic
    bare = rename(ACTOR, {"obs_normalizer.": ""})
    named = rename(ACTOR, {"obs_normalizer.": "actor_obs_normalizer."})
    rest = {"optimizer_state_dict": {}, "iter": 3, "infos": None}
    return {
        "2": {"model_state_dict": layers | {"std": torch.ones(12)}, "obs_norm_state_dict": bare} | rest,
        "3": {"model_state_dict": layers | named | {"log_std": torch.ones(12)}} | rest,
        "5": {"actor_state_dict": ACTOR, "critic_state_dict": {}} | rest,
    }


@pytest.mark.parametrize("state", CHECKPOINTS.values(), ids=CHECKPOINTS)
def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path, anymal, state):
    with pytest.raises(ValueError, match=r"model\.pt"):
        load_policy(save_checkpoint(tmp_path / "model.pt", state), anymal, "cpu")


class Writes(torch.nn.Module):
    def forward(self, rows):
        return rows[:, :12] + torch.from_file("written", True, 12)


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_a_damaged_or_foreign_file_is_refused(tmp_path, anymal):
    path = save_checkpoint(tmp_path / "model.pt", STATE)
    load_policy(path, anymal, "cpu")
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 4  # among the weights
    contents = [b"", whole[: len(whole) // 2], whole[:-9], bytes(flipped), b"\x80\x02.", b"hello\n"]
    for content in ({"model_state_dict": {}, "iter": 3}, {"model_state_dict": 3}, torch.zeros(3)):
        torch.save(content, path)
        contents.append(path.read_bytes())
    for other in (torch.nn.Linear(169, 10), torch.nn.LSTM(OBSERVATIONS, ACTIONS), Writes()):
        torch.jit.script(other).save(str(path))
        contents.append(path.read_bytes())
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"model\.pt") as raised:
            load_policy(path, anymal, "cpu")
        assert "internal miniz" not in str(raised.value) and ":callable" not in str(raised.value)
    assert not Path("written").exists()
    with pytest.raises(ValueError, match=r"gone\.pt"):
        load_policy(tmp_path / "gone.pt", anymal, "cpu")


@pytest.mark.parametrize(("version", "file"), [("2", "agent.yaml"), ("3", "params/agent.yaml"), ("5", "agent.yaml")])
def test_a_checkpoint_of_any_rsl_rl_acts_as_its_training_says(tmp_path, anymal, version, file):
    path, agent = tmp_path / "model_9.pt", tmp_path / file
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


@pytest.mark.parametrize("key", ["student.0.weight", "actor.1.running_mean", "obs_normalizer.running_mean"])
def test_what_is_no_part_of_a_known_network_is_refused_by_name(tmp_path, anymal, key):
    content = old_checkpoints()["2"]
    table = "obs_norm_state_dict" if "normalizer" in key else "model_state_dict"
    content[table][key.removeprefix("obs_normalizer.")] = torch.zeros(3)
    for state, named in ((content, key), (content | {"obs_norm_state_dict": [1.0]}, "obs_norm_state_dict .* list")):
        torch.save(state | {"activation": "elu"}, tmp_path / "model.pt")
        with pytest.raises(ValueError, match=rf"model\.pt.*{named}"):
            load_policy(tmp_path / "model.pt", anymal, "cpu")


@pytest.fixture(scope="module", params=["lstm", "gru"])
def recurrent(request):
    """rsl_rl's own recurrent actor of two layers, with a normaliser; and what it does with 12 steps of 5 robots."""
    actor = recurrent_actor(OBSERVATIONS, rnn_type=request.param, layers=2, normalised=True)
    steps = rows_of(12, 5)
    with torch.inference_mode():
        expected = [actor(TensorDict({"policy": step}, batch_size=5)) for step in steps]
    return actor, steps, torch.stack(expected)


@pytest.mark.filterwarnings("ignore:.torch.jit", "ignore:.torch.onnx", "ignore:You are using the legacy")
@pytest.mark.parametrize("kind", ["checkpoint", "script", "onnx"])
def test_what_remembers_one_robot_remembers_any_number_apart(tmp_path, anymal, recurrent, kind):
    actor, steps, expected = recurrent
    path = tmp_path / ("policy.onnx" if kind == "onnx" else "policy.pt")
    if kind == "checkpoint":  # of rsl_rl 3
        names = {"rnn.rnn.": "memory_a.rnn.", "mlp.": "actor.", "obs_normalizer.": "actor_obs_normalizer."}
        torch.save({"model_state_dict": rename(actor.state_dict(), names), "activation": "elu"}, path)
    elif kind == "script":
        torch.jit.script(actor.as_jit().eval()).save(str(path))
    else:
        model = actor.as_onnx(False).eval()
        names = {"input_names": model.input_names, "output_names": model.output_names}
        torch.onnx.export(model, model.get_dummy_inputs(), str(path), **names, opset_version=18, dynamo=False)
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
    """A layer as exporters write it, with a ``reset`` that does nothing."""

    def __init__(self, kind: str):
        super().__init__()
        self.kind, self.layer = kind, torch.nn.Linear(OBSERVATIONS, ACTIONS)
        self.last = torch.nn.Buffer(torch.zeros(1, OBSERVATIONS))
        self.calls: int = 0

    @torch.jit.export
    def reset(self) -> None:
        pass

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.kind == "counts":
            self.calls += 1
            return self.layer(x) * float(max(self.calls, 9))
        if self.kind == "the first row's":
            assert len(self.last) == 1  # whose error is of a kind of its own
            self.last[:] = 0.5 * self.last + 0.5 * x[:1]
            return self.layer(x + self.last[:1])
        return self.layer(x)


class Student(torch.nn.Module):
    """A layer over two steps that are no buffer, with a second output."""

    def __init__(self):
        super().__init__()
        self.past, self.layer = torch.zeros(1, 2, OBSERVATIONS), torch.nn.Linear(OBSERVATIONS, ACTIONS)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.past = torch.cat([self.past[:, 1:], x[:, None]], dim=1)
        return self.layer(self.past.mean(1)), self.past


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_tensors_that_are_no_buffers_are_memory_and_the_first_output_acts(tmp_path, anymal):
    student = Student()
    torch.jit.script(student).save(str(tmp_path / "student.pt"))
    with pytest.warns(UserWarning, match=r"student\.pt' returns 2 values"):
        policy, rows = load_policy(tmp_path / "student.pt", anymal, "cpu"), rows_of(4)
    assert find_memory(policy) is Memory.PER_ROBOT
    policy.reset(torch.ones(4, dtype=torch.bool))
    for mean in (rows / 2, rows):
        torch.testing.assert_close(policy(rows), student.layer(mean).detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("ignore:.torch.jit")
def test_a_reset_that_does_nothing_is_no_memory(tmp_path, anymal):
    def load(kind):
        torch.jit.script(Exported(kind)).save(str(tmp_path / f"{kind}.pt"))
        return load_policy(tmp_path / f"{kind}.pt", anymal, "cpu")

    assert find_memory(load("plain")) is Memory.NONE
    for kind, named in (("the first row's", r"row's\.pt.* last"), ("counts", r"counts\.pt.* other steps")):
        with pytest.raises(ValueError, match=named):
            load(kind)


def test_a_robots_action_is_the_same_bit_for_bit_beside_any_others(anymal):
    """Torch itself rounds otherwise in batches of a few rows; how few is the processor's matter."""
    rows = np.random.default_rng(4).normal(size=(100, OBSERVATIONS)).astype(np.float32)
    policy, actions = load_policy(anymal.policy_file, anymal, "cpu"), {}
    prepare_torch("cpu")
    for count in (100, *range(1, 40)):
        runner, _, action, _ = runner_on(policy, rows[:count])
        runner()
        actions[count] = action.numpy()
        np.testing.assert_array_equal(actions[count], actions[100][:count], err_msg=f"{count} robots")
        with torch.inference_mode():  # as one that calls it in Python does
            np.testing.assert_array_equal(policy(torch.from_numpy(rows[:count])), actions[count])
    assert len(np.unique(actions[100])) == 100 * ACTIONS


def test_a_controller_may_keep_and_change_its_row():
    rows = []

    def policy(row):
        rows.append(row)
        return row.add_(1.0)[:, :ACTIONS]

    runner, observation, action, _ = runner_on(policy, np.full((5, OBSERVATIONS), 0.5))
    runner()
    np.testing.assert_array_equal(observation.numpy(), 0.5)
    observation.fill_(-1.0)
    runner()
    assert [float(row[0, 0]) for row in rows] == [1.5, 0.0]
    np.testing.assert_array_equal(action.numpy(), 0.0)


@pytest.mark.parametrize(
    ("policy", "named"),
    [
        (lambda row: torch.zeros(1, ACTIONS), r"\(1, 12\)"),
        (lambda row: torch.zeros(5, ACTIONS, dtype=torch.complex64), "complex64"),
        (lambda row: torch.zeros(5, ACTIONS, device="meta"), "meta"),
        (lambda row: torch.zeros(5, ACTIONS).to_sparse(), "sparse"),
        (lambda row: None, "NoneType"),
        (lambda row: row.no_such_name, r"AttributeError: .*test_loaders\.py, line \d+\)$"),
    ],
)
def test_what_goes_wrong_in_a_crossing_is_named(policy, named):
    runner, *_ = runner_on(policy, np.zeros((5, OBSERVATIONS)))
    with pytest.raises(ValueError, match=named):
        runner()


@pytest.fixture
def write(tmp_path):
    return lambda text, name="mine.py": (tmp_path / name).write_text(text) and tmp_path / name


def test_a_row_is_read_in_physical_units(anymal):
    """What it has beside the terms of a description, whose numbers are tested there."""
    sensed = read_row(torch.arange(OBSERVATIONS, dtype=torch.float32)[None], anymal)
    np.testing.assert_allclose(sensed.joint_pos[0], np.arange(12, 24) + np.array(anymal.default_joint_pos), rtol=1e-6)
    np.testing.assert_array_equal(sensed.last_action[0], np.arange(36, 48))
    # Of 17 x 11 points that 0.8 m ahead and 0.3 m to the left is [16, 8]: height = column / 5 + 0.5.
    assert float(sensed.scan[0, 16, 8]) == pytest.approx((48 + 16 * 11 + 8) / 5 + 0.5)
    with pytest.raises(ValueError, match="row"):
        read_row(torch.zeros(2, 48), anymal)


@pytest.mark.parametrize("kind", ["pt", "onnx"])
def test_an_adapter_is_given_a_file_of_any_sizes_and_the_robot(tmp_path, write, anymal, kind):
    state, path = rsl_rl_actor(9, 6).state_dict(), tmp_path / f"theirs.{kind}"
    save_checkpoint(path, state) if kind == "pt" else export_onnx(MlpPolicy(state), path)
    code = write(ADAPTER + "return lambda row: robot.action_scale * actor(row[:, 3:12]).repeat(1, 2)")
    rows = torch.randn(5, OBSERVATIONS, generator=torch.Generator().manual_seed(3))
    with torch.inference_mode():
        actions = load_policy(f"{code}:adapt@{path}", anymal, "cpu")(rows)
        expected = anymal.action_scale * MlpPolicy(state)(rows[:, 3:12]).repeat(1, 2)
    torch.testing.assert_close(actions, expected, rtol=1e-5, atol=1e-6)


def test_code_in_a_file_is_a_controller(write, anymal):
    write("import torch\nSHARE = 0.125\n", "neighbour_of_mine.py")
    path = write(
        "import torch, neighbour_of_mine\n"
        "def act(row):\n    return torch.full((len(row), 12), neighbour_of_mine.SHARE, device=row.device)\n"
        "class Legs:\n    faultline_factory = True\n"
        "    def __init__(self, robot, device):\n        self.joints, self.device = robot.num_joints, device\n"
        "    def __call__(self, row):\n        return torch.zeros(len(row), self.joints, device=self.device)\n"
    )
    assert (load_policy(f"{path}:act", anymal, "cpu")(torch.zeros(2, OBSERVATIONS)) == 0.125).all()
    assert load_policy(f"{path}:Legs", anymal, "cpu").joints == ACTIONS
    path.write_text(path.read_text().replace("neighbour_of_mine.SHARE", "0.5"))
    assert (load_policy(f"{path}:act", anymal, "cpu")(torch.zeros(2, OBSERVATIONS)) == 0.5).all()  # as it is now


@pytest.mark.parametrize(
    ("source", "call", "words"),
    [
        ("def act(:", "act", "cannot be imported"),
        ("act = 3", "act", "int"),
        ("class act: pass", "act", "faultline_factory"),
        ("def act(robot, device): pass", "act", "'device'"),
        ("def act(o): raise SystemExit", "act", r"mine\.py, line 1\)"),
        ("def act(o): return o[:, :12] * float('nan')", "act", "not finite"),
        (ADAPTER + "raise KeyError('gone')", "adapt@{}", r"gone.*mine\.py, line 1\)"),
        (ADAPTER + "return 3", "adapt@{}", "int"),
        (ADAPTER + "return actor", "adapt@{}", "48 columns, robot 'anymal' gives 235"),
    ],
)
def test_code_that_fails_is_named(tmp_path, write, anymal, source, call, words):
    actor = save_checkpoint(tmp_path / "small.pt", rsl_rl_actor(48).state_dict())
    with pytest.raises(ValueError, match=rf"policy '.*{words}"):
        load_policy(f"{write(source)}:{call.format(actor)}", anymal, "cpu")


@pytest.mark.parametrize(
    ("text", "module", "name", "file", "label"),
    [
        ("a/C-G@7.pt", None, None, "a/C-G@7.pt", "C-G@7.pt"),
        ("/a b/mine.py:Class.act", "/a b/mine.py", "Class.act", None, "mine.py:Class.act"),
        ("c/mine.py:adapt@d/model:7.pt", "c/mine.py", "adapt", "d/model:7.pt", "mine.py:adapt@model:7.pt"),
    ],
)
def test_names_are_taken_apart(tmp_path, text, module, name, file, label):
    spec = ControllerSpec.parse(text)
    assert (spec.module, spec.name, spec.file, spec.label) == (module, name, file, label)
    assert str(spec) == text and spec.runs_code == (module is not None)
    (tmp_path / "mine.py:act").write_bytes(b"x")  # a file of that name is a file
    assert ControllerSpec.parse(tmp_path / "mine.py:act").module is None


def test_the_hash_is_of_all_that_is_in_files(tmp_path, write):
    file, code = tmp_path / "m.pt", write("x = 1")
    file.write_bytes(b"weights")
    plain = controller_hash(file)
    assert plain == hashlib.sha256(b"weights").hexdigest()
    digests = [controller_hash(text) for text in (f"{code}:a", f"{code}:b", f"{code}:a@{file}")]
    assert len({plain, *digests}) == 4 and None not in digests
    code.write_text("x = 2")
    assert controller_hash(f"{code}:a") != digests[0]
    assert controller_hash("builtins:abs") is None  # no file
    assert controller_hash(f"{code}:a@{tmp_path / 'gone.pt'}") is None


def test_controllers_have_names(anymal, tmp_path):
    shipped = str(anymal.policy_file)
    assert parse_controllers([], anymal) == {"base": shipped}
    given = ["C-G@1=a b/c.pt base=shipped", "mine=m.py:act"]
    assert parse_controllers(given, anymal) == {"C-G@1": "a b/c.pt", "base": shipped, "mine": "m.py:act"}
    for wrong in ("a.pt", "a=", "a=x a=y", "a/b=x"):
        with pytest.raises(ValueError, match="policies"):
            parse_controllers([wrong], anymal)
    copy = tmp_path / "C-G 1.pt"
    copy.write_bytes(anymal.policy_file.read_bytes())
    about = describe_controllers({"mine": str(copy), "other": "a.pt"}, anymal)
    assert [about[name]["policy"] for name in about] == ["shipped", "a.pt"]
    assert label_suffix(str(copy)) == "-C-G-1"
    assert label_suffix(str(tmp_path / "go2" / "controller.toml")) == "-go2"
