"""Controllers of one's own: code in a file, adapters for another observation, memory, and what their names mean."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from sim.crossing import CrossingCfg
from sim.mujoco_c.model import surface_heights, to_mujoco
from sim.policy.adapters import read_row
from sim.policy.loaders import load_policy
from sim.policy.spec import ControllerSpec, controller_hash
from sim.rollout import Rollout
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import rsl_rl_actor, save_checkpoint
from tests.kernels import oracle
from tests.sim.policies import stretch
from tests.sim.scenes import positions, velocities

SHORT = CrossingCfg(max_duration_s=0.4, poll_every_s=0.1)
JOINTS = 12
THEIR_ORDER = [9, 10, 11, 6, 7, 8, 3, 4, 5, 0, 1, 2]
"""Their k-th joint is our joint THEIR_ORDER[k]."""
ADAPTER = """
import torch
from sim.policy.adapters import read_row

ORDER = [9, 10, 11, 6, 7, 8, 3, 4, 5, 0, 1, 2]
BACK = [ORDER.index(joint) for joint in range(12)]


def adapt(actor, robot):
    def act(row):
        sensed = read_row(row, robot)
        parts = [
            sensed.scan.flip(2).flatten(1), sensed.joint_pos[:, ORDER], sensed.joint_vel[:, ORDER], sensed.ang_vel,
            sensed.gravity, sensed.command, sensed.last_action[:, ORDER], sensed.lin_vel,
        ]
        return actor(torch.cat(parts, dim=1))[:, BACK]

    return act
"""


@pytest.fixture
def write(tmp_path):
    def write(text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def theirs_of(ours, robot):
    """The same actor for the row of ADAPTER: its first layer's columns moved, scaled and shifted, its actions moved."""
    state = {name: value.clone() for name, value in ours.state_dict().items()}
    columns = torch.arange(robot.observation_size)
    base, position, rate, action, scan = columns.split([12, 12, 12, 12, robot.num_scan_points])
    scan = scan.reshape(len(robot.scan_x), len(robot.scan_y)).flip(1).flatten()
    order = torch.tensor(THEIR_ORDER)
    places = [scan, position[order], rate[order], base[3:6], base[6:9], base[9:12], action[order], base[:3]]
    scales = [5.0] * len(scan) + [1.0] * 12 + [0.05] * 12 + [0.25] * 3 + [1.0] * 3 + [2.0, 2.0, 0.25] + [1.0] * 12
    scales = torch.tensor(scales + [2.0] * 3)
    offset = torch.zeros(robot.observation_size)  # of our row from their scaled one
    offset[position] = -torch.tensor(robot.default_joint_pos)
    offset[scan] = -0.5 * 5.0
    weight, bias = state["mlp.0.weight"], state["mlp.0.bias"]
    state["mlp.0.bias"] = bias + weight @ offset
    state["mlp.0.weight"] = weight[:, torch.cat(places)] * scales
    last = max(int(name.split(".")[1]) for name in state if name.startswith("mlp."))
    for kind in ("weight", "bias"):
        state[f"mlp.{last}.{kind}"] = state[f"mlp.{last}.{kind}"][order]
    return state


class AsModule(torch.nn.Module):
    """An actor as plain torch."""

    def __init__(self, policy):
        super().__init__()
        self.layers = policy.layers

    def forward(self, row):
        return self.layers(row)


def saved(folder, kind, state, anymal):
    path = save_checkpoint(folder / "theirs.pt", state)
    if kind == "rsl_rl":
        return path
    module = AsModule(load_policy(path, anymal, "cpu")).eval()
    path = folder / f"theirs.{kind}"
    if kind == "ts":
        torch.jit.trace(module, torch.zeros(4, 235)).save(str(path))
    else:
        torch.onnx.export(
            module, (torch.zeros(4, 235),), str(path), dynamic_shapes=({0: torch.export.Dim("batch")},),
            external_data=False, verbose=False,
        )  # fmt: skip
    return path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["rsl_rl", "ts", "onnx"])
def test_an_actor_of_another_row_acts_the_same_through_its_adapter(tmp_path, write, anymal, device, kind):
    ours = rsl_rl_actor()
    direct = load_policy(save_checkpoint(tmp_path / "ours.pt", ours.state_dict()), anymal, device)
    theirs = saved(tmp_path, kind, theirs_of(ours, anymal), anymal)
    adapted = load_policy(f"{write(ADAPTER)}:adapt@{theirs}", anymal, device)
    rows = 2.0 * torch.randn(64, 235, generator=torch.Generator().manual_seed(3))
    rows = rows.to("cuda" if device.startswith("cuda") else "cpu")
    with torch.inference_mode():
        expected = direct(rows)
        atol = 5e-3 if device.startswith("cuda") else 1e-4  # a GPU multiplies with the ten bits of TF32
        torch.testing.assert_close(adapted(rows), expected, rtol=1e-4, atol=atol)
        wrong = load_policy(theirs, anymal, device)(rows)  # the sizes are right, the meaning is not
    assert (wrong - expected).abs().max() > 0.1


def test_a_crossing_through_an_adapter_is_the_same_crossing(tmp_path, write, anymal, device):
    ours = rsl_rl_actor()
    specs = (
        str(save_checkpoint(tmp_path / "ours.pt", ours.state_dict())),
        f"{write(ADAPTER)}:adapt@{save_checkpoint(tmp_path / 'theirs.pt', theirs_of(ours, anymal))}",
    )
    ends = []
    for spec in specs:
        rollout = Rollout(anymal, spec, num_terrains=2, num_replicas=2, device=device, cfg=SHORT)
        result = rollout.evaluate(SUPER_GAUSSIAN.hard_random(2, 5), np.arange(2, dtype=np.uint32))
        ends.append((result.penalties, result.final_position))
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=2e-3)
    assert np.abs(velocities(rollout.sim)).max() > 0.1


def test_what_is_sensed_is_the_state_in_physical_units(anymal, device):
    rollout = Rollout(anymal, stretch, num_terrains=2, num_replicas=2, device=device, cfg=SHORT)
    rollout.evaluate(SUPER_GAUSSIAN.hard_random(2, 6), np.arange(2, dtype=np.uint32))
    sensed = read_row(wp.to_torch(rollout._observation), anymal)
    q, qd = positions(rollout.sim), velocities(rollout.sim)
    heights = np.array(rollout.sim.bank.heights.numpy(), dtype=np.float64)
    assert sensed.scan.shape == (4, 17, 11)
    qvel = to_mujoco(q, qd, np.array(rollout.sim.sensors.base_com)).qvel
    for env in range(4):
        rotation = oracle.rotation_matrix(q[env, 3:7])
        lin_vel, ang_vel = rotation.T @ qvel[env, :3], qvel[env, 3:6]
        for got, expected in (
            (sensed.lin_vel, lin_vel), (sensed.ang_vel, ang_vel), (sensed.gravity, -rotation[2]),
            (sensed.joint_pos, q[env, 7:]), (sensed.joint_vel, qd[env, 6:]),
            (sensed.last_action, rollout._last_action.numpy()[env]), (sensed.command, rollout._command.numpy()[env]),
        ):  # fmt: skip
            np.testing.assert_allclose(got[env].cpu(), expected, rtol=1e-3, atol=1e-3)
        heading = rotation[:2, 0] / np.linalg.norm(rotation[:2, 0])
        # The point 0.8 m ahead and 0.3 m to the left is [16, 8].
        x, y = q[env, :2] + 0.8 * heading + 0.3 * np.array([-heading[1], heading[0]])
        ground = surface_heights(heights[rollout.sim.terrain_of_env.numpy()[env]], np.array([x]), np.array([y]))[0]
        assert float(sensed.scan[env, 16, 8]) == pytest.approx(np.clip(q[env, 2] - ground, -0.5, 1.5), abs=1e-3)
    assert float(sensed.lin_vel.abs().max()) > 0.1


def test_rows_of_another_robot_are_refused(anymal):
    with pytest.raises(ValueError, match=r"shape \(num_envs, 235\), got \(3, 48\)"):
        read_row(torch.zeros(3, 48), anymal)


class Counts:
    """Returns how often it was asked since it was last told to forget."""

    def __init__(self):
        self.steps = self.resets = 0

    def reset(self):
        self.steps, self.resets = 0, self.resets + 1

    def __call__(self, row):
        self.steps += 1
        return torch.full((len(row), JOINTS), 0.01 * self.steps, device=row.device)


def test_memory_is_cleared_before_every_evaluation(anymal, device):
    policy = Counts()
    rollout = Rollout(anymal, policy, num_terrains=1, num_replicas=2, device=device, cfg=SHORT)
    genes, seeds = SUPER_GAUSSIAN.hard_random(1, 2), np.zeros(1, np.uint32)
    first, second = (rollout.evaluate(genes, seeds) for _ in range(2))
    assert (policy.resets, policy.steps) == (2, 20)
    repeats = {"rtol": 1e-2, "atol": 1e-3} if device.startswith("cuda") else {"rtol": 0.0}  # a GPU adds in any order
    np.testing.assert_allclose(first.penalties, second.penalties, **repeats)


def test_code_in_a_file_is_a_controller(write, anymal):
    write("import torch\nSHARE = 0.125\n", "neighbour_of_mine.py")
    path = write(
        "import torch, neighbour_of_mine\n"
        "def act(row):\n    return torch.full((len(row), 12), neighbour_of_mine.SHARE, device=row.device)\n"
        "class Legs:\n    faultline_factory = True\n"
        "    def __init__(self, robot, device):\n        self.joints = robot.num_joints\n"
        "    def __call__(self, row):\n        return torch.zeros(len(row), self.joints)\n"
    )
    assert (load_policy(f"{path}:act", anymal, "cpu")(torch.zeros(2, 235)) == 0.125).all()
    assert load_policy(f"{path}:Legs", anymal, "cpu").joints == JOINTS
    path.write_text(path.read_text().replace("neighbour_of_mine.SHARE", "0.5"))
    assert (load_policy(f"{path}:act", anymal, "cpu")(torch.zeros(2, 235)) == 0.5).all()  # as it is now


@pytest.mark.parametrize(
    ("source", "call", "message"),
    [
        ("act = 3", "act", "int"),
        ("def adapt(actor, robot): raise KeyError('gone')", "adapt@{}", "KeyError"),
        ("def adapt(actor, robot): return 3", "adapt@{}", "int"),
        ("def adapt(actor, robot): return actor", "adapt@{}", r"\(4, 235\)"),
        ("def adapt(actor, robot): return actor", "adapt@gone.pt", r"gone\.pt"),
    ],
)
def test_what_is_wrong_with_code_is_said(tmp_path, write, anymal, source, call, message):
    actor = save_checkpoint(tmp_path / "small.pt", rsl_rl_actor(48).state_dict())
    with pytest.raises(ValueError, match=message):
        load_policy(f"{write(source)}:{call.format(actor)}", anymal, "cpu")


@pytest.mark.parametrize(
    ("text", "place", "name", "file", "label"),
    [
        ("a/policy.pt", None, None, "a/policy.pt", "policy.pt"),
        ("my.module:Class.act", "my.module", "Class.act", None, "my.module:Class.act"),
        ("/a b/mine.py:act", "/a b/mine.py", "act", None, "mine.py:act"),
        ("c/mine.py:adapt@d/model:7.pt", "c/mine.py", "adapt", "d/model:7.pt", "mine.py:adapt@model:7.pt"),
        ("mine:adapt@d/model.pt", "mine", "adapt", "d/model.pt", "mine:adapt@model.pt"),
        ("C-G@7.pt", None, None, "C-G@7.pt", "C-G@7.pt"),
    ],
)
def test_names_are_taken_apart(text, place, name, file, label):
    spec = ControllerSpec.parse(text)
    assert (spec.place, spec.name, spec.file, spec.label) == (place, name, file, label)
    assert str(spec) == text
    assert spec.runs_code == (place is not None)
    assert str(ControllerSpec.parse(Path(text))) == text


def test_a_file_of_that_name_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert ControllerSpec.parse("mine:act").runs_code
    (tmp_path / "mine:act").write_bytes(b"x")
    assert not ControllerSpec.parse("mine:act").runs_code


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
