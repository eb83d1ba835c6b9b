"""Which change of a contract makes a dog trot, and where a recorded log differs from its contract."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qd.why import describe_ranked, describe_row, describe_setting, propose_changes, rank_changes, write_out
from sim.controllers.described import read_controller
from sim.controllers.trace import compare_log
from sim.files.npz import npz_bytes
from sim.robots.find import get_robot
from sim.trials import MEASURES, Variant, walk_variants
from tests.sim.dogs import write_toml

DESCRIPTION = """policy = "trot.pt"
action_scale = 0.5
observation = [
  {term = "clock", period_s = 0.33333333}, {term = "command", scale = 2.5}, {term = "ang_vel", scale = 0.25},
]
"""
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit")


class Trot(torch.nn.Module):
    """Diagonal legs in turn by the clock, hips as wide as the commanded speed; what it feels of turning is no use."""

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        diagonal = torch.tensor([1.0, -1.0, -1.0, 1.0])
        knee = -0.5 * (rows[:, 0:1] * diagonal).clamp(min=0.0)
        hip = 0.35 * rows[:, 2:3] * rows[:, 1:2] * diagonal - 0.5 * knee
        return 2.0 * torch.stack([hip, knee], dim=2).flatten(1) + 0.0 * rows[:, 5:6]


@pytest.fixture
def dog(tmp_path) -> tuple[Variant, Path]:
    """A dog that trots by robot.toml, controller.toml and a network."""
    file = write_toml(tmp_path / "dog", "default_joint_pos = {'.*hip' = 0.6, '.*knee' = -1.2}\nspeed = 0.4\n")
    description, weights = (file.with_name(name) for name in ("controller.toml", "trot.pt"))
    description.write_text(DESCRIPTION)
    torch.jit.script(Trot()).save(str(weights))
    robot = get_robot(str(file))
    return Variant(controller=write_out(read_controller(description), robot), robot=robot), weights


def test_changes_are_of_one_thing_and_say_what_to_write(dog):
    base, _ = dog
    lines = {change.text: describe_setting(base, change.variant) for change in propose_changes(base)}
    expected = {
        "command x 2.0": 'in controller.toml write as term 2 of observation {term = "command", scale = 5.0, ',
        "command x (2.0, 2.0, 0.25)": 'term = "command", scale = [5.0, 5.0, 0.625], ',
        "signs of yz of ang_vel": 'term 3 of observation {term = "ang_vel", scale = [0.25, -0.25, -0.25]}',
        "action_scale x 2.0": "in controller.toml write action_scale = 1.0",
        "sign of the action of FL_knee": "action_scale = [0.5, -0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]",
        "order of FL_hip and FL_knee": 'joints = ["FL_knee", "FL_hip", "FR_hip", ',
        "stiffness x 0.5": "in robot.toml write stiffness = 30.0",
        "decimation": "in robot.toml write decimation = ",
        "drive_delay_steps": "in robot.toml write drive_delay_steps = ",
    }
    assert {name: text for name, text in expected.items() if text not in lines[name]} == {}


def test_a_repair_is_among_the_changes_of_what_was_planted(dog):
    base, _ = dog
    kinds = ("command x 0.5", "order of FL_hip and HR_knee", "stiffness x 2.0", "action_delay_steps", "default")
    for change in propose_changes(base):
        if change.text.startswith(kinds):
            assert base in [repair.variant for repair in propose_changes(change.variant)], change.text


@pytest.mark.slow
def test_robots_side_by_side_walk_as_each_does_alone(dog):
    base, weights = dog
    stiffer = replace(base, robot=replace(base.robot, stiffness=(120.0,) * 8, damping=(2.0,) * 8))
    changes = ({"drive_delay_steps": 3}, {"decimation": 2})
    late, faster = (replace(base, robot=replace(base.robot, **change)) for change in changes)
    timed = {"device": "cpu", "seconds": 1.5, "replicas": 2}
    variants = [replace(base, gains=(2.0, 1.0, 1.0)), late, base, faster]
    together = walk_variants(variants, weights, **timed)
    alone = [walk_variants([variant], weights, **timed)[0] for variant in (stiffer, late, base, faster)]
    assert together.shape == (4, 2, len(MEASURES)) and (together[..., 0] == 1.0).all()
    np.testing.assert_allclose(together, np.stack(alone), rtol=1e-4)
    assert len({*together[:, 0, 1].round(3)}) == 4


@pytest.mark.slow
def test_the_first_line_names_what_was_planted():
    robot = get_robot("anymal")
    base = Variant(controller=write_out(describe_row(robot), robot), robot=robot)
    planted = next(change.variant for change in propose_changes(base) if change.text == "action_scale x 2.0")
    ranked = rank_changes(planted, robot.policy_file, device="cpu")
    assert ranked[0].variant == base
    assert "action_scale = 0.5" in next(describe_ranked(planted, ranked))


def test_a_log_is_compared_column_by_column(dog, tmp_path):
    base, weights = dog
    rng, count = np.random.default_rng(0), 6
    ang_vel, command = rng.normal(size=(2, count, 3)).astype(np.float32)
    angle = 2.0 * np.pi * 0.02 * np.arange(count)[:, None] / 0.33333333
    observation = np.hstack([np.sin(angle), np.cos(angle), 2.5 * command, 0.25 * ang_vel]).astype(np.float32)
    action = Trot()(torch.as_tensor(observation)).numpy()
    log = {"observation": observation, "action": action, "command": command, "ang_vel": ang_vel}
    cases = {
        "agrees": (log, []),
        "scale": ({**log, "ang_vel": 4.0 * ang_vel}, ["observation 5 (ang_vel 0) at step 0", "4 times the log's"]),
        "lacks": ({name: log[name] for name in ("observation", "action")}, []),
        "network": ({**log, "action": np.roll(action, 1, axis=1)}, ["action 0 (FL_hip) at step 0"]),
        "width": ({**log, "observation": observation[:, :4]}, ["observation has 4 columns", "are 8"]),
    }
    description = str(weights.with_name("controller.toml"))
    for name, (arrays, texts) in cases.items():
        file = tmp_path / f"{name}.npz"
        file.write_bytes(npz_bytes(arrays))
        lines = compare_log(file, description, base.robot)
        assert len(lines) == bool(texts) and all(text in lines[0] for text in texts), (name, lines)
    header = ",".join(f"{name}_{k}" for name, values in log.items() for k in range(values.shape[1]))
    columns = np.hstack([*log.values()])[:, ::-1]  # whose names say their order
    header = ",".join(header.split(",")[::-1])
    np.savetxt(tmp_path / "log.csv", columns, delimiter=",", header=header, comments="")
    assert compare_log(tmp_path / "log.csv", description, base.robot) == []


@pytest.mark.parametrize(
    ("name", "shape", "field"),
    [
        ("action", (3, 8), "observation"),
        ("torque", (3, 8), "torque"),
        ("joint_pos", (3, 7), "joint_pos"),
        ("ang_vel", (3, 3), "finite"),
        ("observation", (0, 8), "steps"),
    ],
)
def test_a_log_that_says_something_else_is_refused(dog, tmp_path, name, shape, field):
    file = tmp_path / "log.npz"
    observation = {} if field == "observation" else {"observation": np.zeros((3, 8))}
    file.write_bytes(npz_bytes({**observation, name: np.full(shape, np.nan if field == "finite" else 0.0)}))
    with pytest.raises(ValueError, match=field):
        compare_log(file, str(dog[1].with_name("controller.toml")), dog[0].robot)
