"""Actuator networks: the torques of their module, in both simulators."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from sim.crossing import resolved
from sim.mujoco_c.crossing import EpisodeStates
from sim.mujoco_c.model import Starts, crossing_model
from sim.robots.find import get_robot
from sim.robots.robot import robot_digest
from sim.robots.user import PackedRobot, pack_robot
from tests.sim.dogs import write_dog
from tests.sim.scenes import FLAT, put, simulate, standing


class Lstm(torch.nn.Module):
    """Two layers of four units and a dense layer, with scales, laid out as legged_gym's."""

    def __init__(self):
        super().__init__()
        self.lstm, self.linear = torch.nn.LSTM(2, 4, 2, batch_first=True), torch.nn.Linear(4, 1)
        self.in_scale = torch.nn.Buffer(torch.tensor([[[3.0, 0.3]]]))
        self.out_scale = torch.nn.Buffer(torch.tensor([15.0]))

    def forward(self, x: torch.Tensor, state: tuple[torch.Tensor, torch.Tensor]):
        x, state = self.lstm(self.in_scale * x, state)
        return self.out_scale * self.linear(x).squeeze(), state


def make_dense(*sizes: int, activation: type[torch.nn.Module] = torch.nn.ELU):
    layers = [(torch.nn.Linear(*pair), activation()) for pair in pairwise(sizes)]
    return torch.nn.Sequential(*[part for layer in layers for part in layer][:-1])


def read_dog(folder, module, settings="", more=""):
    """A dog with the module as its drives."""
    folder.mkdir(exist_ok=True)
    torch.jit.save(torch.jit.script(module), folder / "net.pt")
    file = write_dog(folder, more=f'\n    actuator_net=ActuatorNetCfg(file="net.pt", {settings}),{more}')
    file = file.rename(folder / "net_dog.py")  # other tests import a dog
    file.write_text("from sim.robots.robot import ActuatorNetCfg\n" + file.read_text())
    return get_robot(str(file))


@pytest.mark.parametrize("kind", ["lstm", "dense"])
@torch.no_grad()
def test_torques_are_those_of_the_module_in_both(tmp_path, device, kind):
    torch.manual_seed(0)
    module, settings = {
        "lstm": (Lstm(), "decimation=2, torque_scale=-2.0"),
        "dense": (make_dense(4, 6, 8, 1), "pos_scale=-2.0, input_order='vel_pos', input_idx=(0, 3)"),
    }[kind]
    robot = read_dog(tmp_path, module, settings, "\n    drive_delay_steps=1,")
    finer = resolved(robot)[0].actuator_net
    assert finer is not None and finer.decimation == {"lstm": 10, "dense": 5}[kind]  # of 1 ms
    pose, targets = standing(robot, 2, z=5.0), np.random.default_rng(0).normal(size=(9, 2, 8))
    sim = simulate(robot, np.repeat(FLAT[None], 2, axis=0), device)
    for step in range(18):
        if step in (0, 9):  # an episode begins
            put(sim, pose)
            starts = Starts.of_newton(pose, np.zeros((2, 14)), np.zeros(3))
            plain = EpisodeStates(robot, crossing_model(robot, FLAT), starts)
            past, state, due = torch.zeros(4, 16, 2), (torch.zeros(2, 16, 4), torch.zeros(2, 16, 4)), pose[:, 7:]
        now = np.stack([due - plain.qpos[:, 7:], plain.qvel[:, 6:]], axis=-1).reshape(1, 16, 2)
        past = torch.cat([torch.tensor(now, dtype=torch.float32), past[:-1]])
        due = targets[step % 9]
        sim.targets.assign(np.float32(np.hstack([pose[:, :7], due])))
        plain.targets[:] = due
        sim.physics_step(follows=step % 9 > 0)
        plain.step(np.arange(2))
        if kind == "dense":
            (error, velocity), (old_error, old_velocity) = (past[ago].T for ago in (0, 3))
            expected = module(torch.stack([velocity, old_velocity, -2 * error, -2 * old_error], dim=1))
        elif step % 9 % 2 == 0:
            answer, state = module(past[0][:, None], state)
            expected = (-2.0 * answer).clip(-30.0, 30.0)
        torques = np.array([data.qfrc_actuator[6:] for data in plain.data])
        np.testing.assert_allclose(torques, expected.reshape(2, 8), atol=1e-3)
        np.testing.assert_allclose(sim.joint_torque.numpy()[:, 6:], torques, atol=0.02)


def test_its_file_is_hashed_and_goes_along(tmp_path):
    robot = read_dog(tmp_path / "a", make_dense(2, 1))
    packed = pack_robot(robot)
    assert isinstance(packed, PackedRobot)
    packed = packed.unpacked(tmp_path / "b")
    assert robot_digest(packed) == robot_digest(robot)
    assert robot_digest(read_dog(tmp_path / "a", make_dense(2, 1))) != robot_digest(packed)


@pytest.mark.parametrize(
    ("module", "settings", "more", "match"),
    [
        (make_dense(2, 1), "input_idx=(0, 1)", "", "input_idx"),
        (make_dense(2, 2), "", "", "actuator_net.file"),
        (make_dense(2, 4, 1, activation=torch.nn.GELU), "", "", "actuator_net.file"),
        (make_dense(2, 1), "", "stiffness=(60.0,) * 8, damping=(2.0,) * 8,", "stiffness"),
    ],
)
def test_what_is_no_network_of_drives_is_refused(tmp_path, module, settings, more, match):
    with pytest.raises(ValueError, match=match):
        read_dog(tmp_path, module, settings, more)
