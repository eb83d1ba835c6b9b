"""Routes and stands: what is commanded and what counts as off it, against a second writing, and how episodes end."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from kernels.episode import Kind, Outcome, make_episodes
from kernels.route import follow_routes
from qd.check import ensure_stray
from qd.show.crossed import draw_time_line
from qd.workers.compute import Compute
from sim.crossing import CrossingCfg, make_task, make_trail
from sim.files.atomic import read_json
from sim.mujoco_c.crossing import MujocoC
from sim.mujoco_c.model import Routes
from sim.robots.find import get_robot, read_stray
from sim.rollout import Rollout
from sim.terrains.conditions.kinds import condition_column, nominal_row
from sim.terrains.spaces.registry import get_space, load_space
from sim.terrains.terrains import GroundMaps, Terrains

ROBOT = get_robot("anymal")
SPACE = get_space("super_gaussian+command")
LIMIT = 0.3


def row_of(kind: Kind, **values: float) -> np.ndarray:
    row = nominal_row()
    row[-1] = kind
    for name, value in values.items():
        row[condition_column(name)] = value
    return row


TURN = {"segment_1_x": 0.8, "segment_1_turn": 0.5, "segment_2_x": 0.05, "segment_2_y": 0.3, "segment_3_turn": 0.05}


def test_commands_and_strays_are_those_of_a_second_writing():
    pushes = {"push_x": 1.0, "push_time": 4.0, "push_3_y": 0.5, "push_3_time": 9.0}
    rows = np.stack([row_of(Kind.ROUTE, **TURN), row_of(Kind.ROUTE, **pushes), row_of(Kind.STAND)])
    rng, steps, dt = np.random.default_rng(0), 600, ROBOT.control_dt
    task = make_task(CrossingCfg(stray_m=LIMIT), ROBOT)
    episodes, trail = make_episodes(3, "cpu"), make_trail(3, ROBOT, "cpu")
    episodes.outcome.zero_()
    qpos = np.zeros((3, 7 + ROBOT.num_joints))
    yaw, told = np.zeros(3), wp.zeros((3, 3), dtype=float, device="cpu")
    plain = [Routes(ROBOT, row.astype(float), 1, LIMIT) for row in rows]
    most = np.zeros(3, int)
    for step in range(steps):
        qpos[:, 3:7] = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
        joint_q = wp.array(qpos[:, [0, 1, 2, 4, 5, 6, 3, *range(7, qpos.shape[1])]], dtype=float, device="cpu")
        episodes.steps.assign(np.full(3, step * ROBOT.decimation))
        follow_routes(joint_q, wp.array(rows, dtype=float, device="cpu"), task, dt, episodes, trail, told)
        commands = told.numpy()
        for k, routes in enumerate(plain):
            command = routes.command(qpos[k : k + 1], step * dt)
            np.testing.assert_allclose(commands[k], command[0], atol=1e-6)
            assert episodes.strayed.numpy()[k] == routes.strayed[0]
        most = np.maximum(most, episodes.strayed.numpy())
        drifts = commands[:, :2] + [[0.05, 0.0], [0.0, 0.25], [0.0, 0.0]] + rng.normal(0.0, 0.1, (3, 2))
        qpos[:, 0] += dt * (np.cos(yaw) * drifts[:, 0] - np.sin(yaw) * drifts[:, 1])
        qpos[:, 1] += dt * (np.sin(yaw) * drifts[:, 0] + np.cos(yaw) * drifts[:, 1])
        yaw = yaw + dt * commands[:, 2]
    assert most[0] == 0 and 50 < most[1] <= steps - 100 - 2 * 50  # the second after a push does not count
    assert np.abs(commands[2]).max() == 0.0


@pytest.mark.parametrize(("space", "values"), [("command", {"segment_2_turn": 0.8}), ("stand", {})])
def test_a_short_episode_ends_as_in_mujoco_c(space, values):
    robot = dataclasses.replace(ROBOT, max_duration_s=3.0)
    space = load_space(f"super_gaussian+{space}")
    genes = np.zeros((1, space.num_genes), np.float32)
    genes[:, :64] = get_space("super_gaussian").without(genes[:, :64], range(8))
    for name, value in values.items():
        segment = space.conditions.index(name.rpartition("_")[0])
        genes[0, 64 + 3 * segment + 2] = value
    terrains = Terrains(genes=genes, seeds=np.array([5], np.uint32), space=space)
    how = {"num_terrains": 1, "replicas": 2, "device": "cpu", "space": space}
    ours = Rollout(robot, robot.policy_file, **how).evaluate(terrains)
    plain = MujocoC(robot, str(robot.policy_file), replicas=2)
    plain.put(terrains)
    theirs = plain.take()
    assert ours.reached_goal.all() and theirs.reached_goal.all()
    np.testing.assert_allclose(ours.final_position[..., :2], theirs.final_position[..., :2], atol=0.15)
    if values:  # it turned to the left
        assert (ours.final_position[0, :, 1] > 4.15).all()


def test_how_far_a_route_may_be_missed_is_measured_once(tmp_path, monkeypatch):
    assert 0.2 < read_stray(ROBOT) < 1.0
    monkeypatch.setattr("qd.check._ROUTES", 2)
    scales = tmp_path / "dog.scales.json"
    scales.write_text("{}")
    monkeypatch.setattr(type(ROBOT), "scales_file", scales)
    with pytest.raises(ValueError, match=r"dog\.scales\.json must say .* super_gaussian\+command"):
        read_stray(ROBOT)
    short = dataclasses.replace(ROBOT, max_duration_s=3.0)
    ensure_stray(short, None, Compute("cpu"))
    measured = read_json(scales)["stray_m"]
    assert 0.02 < measured < 1.0 and read_stray(ROBOT) == measured
    assert 0.02 < read_stray(ROBOT, resolved=True) < 1.0 and read_stray(ROBOT, resolved=True) != measured
    monkeypatch.setattr("qd.check.measure_stray", lambda *given: pytest.fail("it is measured again"))
    ensure_stray(short, None, Compute("cpu"))


def test_what_is_asked_for_is_one_thing():
    with pytest.raises(ValueError, match="leave \\+stand or \\+command out"):
        load_space("super_gaussian+command+stand")
    ground = GroundMaps(**vars(GroundMaps.plain(1)) | {"conditions": row_of(Kind.ROUTE)[None]})
    rollout = Rollout(ROBOT, ROBOT.policy_file, num_terrains=1, replicas=1, device="cpu", with_conditions=True)
    flat = np.zeros((1, *rollout.sim.bank.heights.shape[1:]), np.float32)
    with pytest.raises(ValueError, match="stray_m"):
        rollout.evaluate(Terrains(heights=flat, seeds=np.zeros(1, np.uint32), ground=ground))


def test_what_acts_on_a_robot_is_known_by_its_time():
    space = load_space("super_gaussian+command+push+payload")
    genes = space.without(np.zeros((1, space.num_genes), np.float32), range(8))[0]
    assert space.time_line(genes, 20.0) == []
    first = {name: 64 + int(np.cumsum([0, 3, 3, 3, 3])[k]) for k, name in enumerate(space.conditions[:5])}
    genes[first["payload"]] = genes[first["push"]] = genes[first["push"] + 2] = 0.5
    genes[first["segment_2"] + 2] = 0.8
    spans = [(first, last) for _, first, last in space.time_line(genes, 20.0)]
    assert spans == [(0.0, 20.0), (9.0, 9.0), (4.0, 8.0)]
    recording = SimpleNamespace(outcome=np.array([[Outcome.GOAL]]))
    (axes,) = draw_time_line(space.time_line(genes, 20.0), recording).axes
    assert [label.get_text().partition(" ")[0] for label in axes.get_yticklabels()] == ["payload", "pushed", "part"]
