"""Conditions in the parallel simulation, against plain MuJoCo C and against what they mean."""

import dataclasses

import mujoco
import numpy as np
import pytest
import warp as wp

from sim.crossing import CrossingCfg
from sim.mujoco_c.crossing import EpisodeStates, draw_starts
from sim.mujoco_c.model import Starts, crossing_model
from sim.robots.compiled import robot_spec
from sim.robots.find import get_robot
from sim.robots.training import NoiseCfg
from sim.rollout import Rollout
from sim.terrains.bank import make_terrains
from sim.terrains.conditions.kinds import CONDITIONS, condition_column, condition_genes, nominal_row, round_steps
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.registry import get_space, load_space, space_key
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import GroundMaps, Terrains
from tests.sim.dogs import write_dog
from tests.sim.plain_mujoco import cross_and_keep

CROSSED = [name for name, condition in CONDITIONS.items() if not (condition.asks or condition.needs_arms)]
SPACE = get_space("+".join(("super_gaussian", *CROSSED)))
EPISODES = 3
FLAT_GENES = np.zeros(SUPER_GAUSSIAN.num_genes, np.float32)


def under_conditions(rows: np.ndarray, seeds: np.ndarray) -> Terrains:
    return Terrains(genes=rows, seeds=seeds, space=SPACE)


def genes(**values: float) -> np.ndarray:
    """A row of flat ground under some conditions by their names; the others are nominal."""
    rows = [CONDITIONS[name].to_genes(values) for name in CROSSED]
    return np.concatenate([FLAT_GENES, *rows], dtype=np.float32)


CASES = {
    "payload": {"payload": 0.15, "payload_x": -0.15, "payload_y": 0.1},
    "motors": {"strength": 0.7},
    "delay": {"delay": 0.02},
    "lag": {"lag": 0.02},
    "push": {"push_x": -0.4, "push_y": 0.6, "push_time": 0.1},
    "grip": {"friction": 0.5},
    "push_1": {"push_1_x": -0.4, "push_1_y": 0.6, "push_1_time": 0.1, "push_1_link": 2},
}


@pytest.fixture(scope="module")
def shared(anymal):
    """A rollout that has conditions, built once."""
    sizes = {"num_terrains": 1, "replicas": EPISODES, "device": "cpu", "space": SPACE}
    return Rollout(anymal, anymal.policy_file, **sizes)


def begin(rollout, row, seed):
    """Begins the episodes of a row of genes anew; returns their order among the robots."""
    rollout.clear()
    rollout.put(under_conditions(row[None], np.array([seed], np.uint32)))
    return np.argsort(rollout.episode.numpy())


@pytest.mark.parametrize("case", CASES)
def test_moving_under_a_condition_is_the_same_motion_as_in_mujoco_c(anymal, shared, case):
    row, seconds = genes(**CASES[case]), 0.2 if case == "grip" else 0.3  # later each slips in its way
    conditions = SPACE.condition_rows(row[None])[0]
    for name, value in CASES[case].items():
        assert conditions[condition_column(name)] == pytest.approx(value, rel=1e-5)
    order = begin(shared, row, 1000)
    heights = shared.sim.bank.heights.numpy()[0]
    assert not heights.any()
    for _ in range(round(seconds / anymal.control_dt)):
        shared.control_step()
    ours = shared.sim.joint_q.numpy()[order]
    starts = draw_starts(anymal, heights, 1000, EPISODES)
    grounds = map(under, (conditions, nominal_row()))
    crossed = [cross_and_keep(anymal, anymal.policy_file, heights, starts, seconds, ground=at) for at in grounds]
    plain, nominal = (episodes.qpos for episodes, *_ in crossed)
    np.testing.assert_allclose(ours[:, :3], plain[:, :3], atol=1e-3)
    np.testing.assert_allclose(ours[:, 7:], plain[:, 7:], atol=0.02)
    columns = [0, 1, 2, *range(7, ours.shape[1])]
    apart, changed = np.abs(ours - plain)[:, columns], np.abs(plain - nominal)[:, columns]
    assert apart.max() < 0.25 * changed.max()  # or nothing was tested


def under(conditions):
    return dataclasses.replace(GroundMaps.plain(1), conditions=conditions[None])


CFG = CrossingCfg(start=(10.0, 4.0))  # 3.5 m to the goal


def test_nominal_conditions_change_no_bit(robot):
    short = dataclasses.replace(robot, max_duration_s=0.4)
    sizes = {"num_terrains": 2, "replicas": 2, "device": "cpu"}
    terrains, seeds = SUPER_GAUSSIAN.hard_random(2, 3), np.array([1, 2], np.uint32)
    without = Rollout(short, robot.policy_file, **sizes).evaluate(Terrains(genes=terrains, seeds=seeds))
    nominal = np.concatenate([terrains, np.tile(genes()[64:], (2, 1))], axis=1)
    plain = Rollout(short, robot.policy_file, **sizes, space=SPACE).evaluate(under_conditions(nominal, seeds))
    np.testing.assert_array_equal(plain.penalties, without.penalties)
    np.testing.assert_array_equal(plain.final_position, without.final_position)


def test_an_episode_depends_on_its_own_conditions_alone(anymal, device):
    """Beside others, in another slot, by a robot that walked under other conditions before."""
    short = dataclasses.replace(anymal, max_duration_s=1.0)
    seen = {"drift": 0.1, "map_delay": 0.1, "holes": 0.3, "wander": 0.3}
    many = [genes(), *(genes(**case) for case in CASES.values()), genes(noise=2.0), genes(**seen)]
    rows, seeds = np.stack(many), np.full(len(many), 5, np.uint32)
    sizes = {"replicas": 2, "device": device, "space": SPACE, "cfg": CFG}
    alone = Rollout(short, anymal.policy_file, num_terrains=len(rows), **sizes).evaluate(under_conditions(rows, seeds))
    few = Rollout(short, anymal.policy_file, num_terrains=len(rows), num_envs=3, **sizes)
    order = np.random.default_rng(0).permutation(len(rows))
    for _ in range(2):
        result = few.evaluate(under_conditions(rows[order], seeds))
        if device == "cpu":
            np.testing.assert_array_equal(result.final_position, alone.final_position[order])
            np.testing.assert_array_equal(result.penalties, alone.penalties[order])
    ends = alone.final_position[:, 0]
    apart = np.linalg.norm(ends[:, None] - ends, axis=2) + np.eye(len(rows))
    assert apart.min() > 1e-4  # each condition does something


def test_heights_may_come_with_conditions_and_cross_as_genes_do(anymal):
    row = genes(payload=0.2, push_x=-0.5, push_time=0.2, friction=0.5)
    seeds, heights = np.array([3], np.uint32), np.zeros((1, NUM_ROWS, NUM_COLS), np.float32)
    short = dataclasses.replace(anymal, max_duration_s=0.5)
    sizes = {"num_terrains": 1, "replicas": EPISODES, "device": "cpu"}
    by_genes = Rollout(short, anymal.policy_file, **sizes, space=SPACE).evaluate(under_conditions(row[None], seeds))
    rollout = Rollout(short, anymal.policy_file, **sizes, with_conditions=True)
    ground = under(SPACE.condition_rows(row[None])[0])
    by_heights = rollout.evaluate(Terrains(heights=heights, seeds=seeds, ground=ground))
    np.testing.assert_array_equal(by_heights.penalties, by_genes.penalties)
    assert (rollout.evaluate(Terrains(heights=heights, seeds=seeds)).penalties != by_genes.penalties).any()
    again = make_terrains(row[None], SPACE)[1]
    np.testing.assert_array_equal(again.rows, ground.rows)
    assert (again.friction == 1.0).all()  # the factor is a condition, and no patch's
    joined = again.joined(GroundMaps.plain(2))
    np.testing.assert_array_equal(joined.rows, [again.rows[0], nominal_row(), nominal_row()])
    np.testing.assert_array_equal(joined[1:].rows, [nominal_row(), nominal_row()])
    plain = Rollout(short, anymal.policy_file, **sizes, with_ground=True)
    with pytest.raises(ValueError, match="terrains have conditions"):
        plain.evaluate(Terrains(heights=heights, seeds=seeds, ground=ground))
    for wrong in ({"delay": 0.5}, {"strength": 0.0}, {"noise": -1.0}):
        (name, value), changed = next(iter(wrong.items())), nominal_row()
        changed[condition_column(name)] = value
        with pytest.raises(ValueError, match=name):
            under(changed)


def test_noise_is_as_wide_as_it_is_said_to_be_and_old_observations_are_shown(anymal, shared):
    seen = {}
    for name, row in {"none": genes(), "noise": genes(noise=2.0), "lag": genes(lag=0.04)}.items():
        order = begin(shared, row, 7)
        rows = [shared._observation.numpy()[order].copy()]
        for _ in range(4):
            shared._action.fill_(0.1)  # the same motion, whatever is seen
            shared.sim.launch(shared._step_graph)
            shared.sim.launch(shared._turn_graph)
            rows.append(shared._observation.numpy()[order].copy())
        seen[name] = np.array(rows)
    added, widths = seen["noise"] - seen["none"], 2.0 * NoiseCfg().column_widths(anymal.column_sizes)
    assert (np.abs(added) <= widths + 1e-5).all() and not added[..., widths == 0.0].any()
    share = (added / np.where(widths > 0.0, widths, 1.0))[..., widths > 0.0]
    assert share.std() == pytest.approx(1 / np.sqrt(3), rel=0.05) and abs(share.mean()) < 0.05
    assert np.abs(np.corrcoef(share.reshape(15, -1)) - np.eye(15)).max() < 0.35  # another one in each step and episode
    np.testing.assert_array_equal(seen["lag"][:3], np.repeat(seen["none"][:1], 3, axis=0))
    np.testing.assert_array_equal(seen["lag"][3:], seen["none"][1:3])


def test_old_observations_grow_no_older_behind_the_goal(anymal):
    """Robots that are paid walk on behind it, as well as before."""
    how = {"num_terrains": 2, "replicas": 1, "device": "cpu", "space": SPACE, "cfg": CrossingCfg(reward=True)}
    result = Rollout(anymal, anymal.policy_file, **how).evaluate(
        under_conditions(np.stack([genes(), genes(lag=0.04)]), np.array([5, 5], np.uint32))
    )
    nominal, lagged = result.reward[:, 0]
    assert result.reached_goal.all() and 0.8 * nominal < lagged < nominal


def test_weak_motors_give_a_share_of_what_they_gave_at_their_limits_too(anymal, device):
    rows = np.stack([genes(), genes(strength=0.6)])
    rollout = Rollout(anymal, anymal.policy_file, num_terrains=2, replicas=1, device=device, space=SPACE)
    rollout.put(under_conditions(rows, np.array([3, 3], np.uint32)))
    sim, order = rollout.sim, np.argsort(rollout.episode.numpy())
    for angle in (0.1, 50.0):  # the second asks for more than there is
        sim.targets.assign(np.float32(np.tile([0.0] * 7 + [angle] * 12, (2, 1))))
        with wp.ScopedDevice(device):
            sim.dynamics.find()
            sim.physics_step()
        strong, weak = sim.joint_torque.numpy()[order][:, 6:]
        if angle == 50.0:
            limits = sim.solver.mjw_model.actuator_forcerange.numpy()[0, :, 1]
            np.testing.assert_allclose(np.sort(np.abs(strong)), np.sort(limits), rtol=1e-5)
            np.testing.assert_allclose(weak, 0.6 * strong, rtol=1e-5)
        assert (np.abs(weak) < np.abs(strong)).all()


def vary(robot, model, **values):
    """Changes a model of MuJoCo C as conditions do."""
    row = SPACE.condition_rows(genes(**values)[None])[0]
    EpisodeStates(robot, model, Starts(qpos=np.zeros((0, 7)), qvel=np.zeros((0, 6))), row.astype(float))


def test_a_payload_is_a_point_mass_on_the_base(anymal):
    plain, loaded = (crossing_model(anymal, np.zeros((161, 321), np.float32)) for _ in range(2))
    vary(anymal, loaded, payload=0.2, payload_x=0.1, payload_y=-0.2)
    mass = plain.body_subtreemass[1]
    assert loaded.body_subtreemass[1] == pytest.approx(1.2 * mass)
    moved = loaded.body_ipos[1] - plain.body_ipos[1]
    np.testing.assert_allclose(moved * loaded.body_mass[1], 0.2 * mass * np.array([0.1, -0.2, 0.0]), rtol=1e-5)
    # Against MuJoCo's own sum: a body of nothing but this mass, fixed to the base.
    spec = robot_spec(anymal)
    base = spec.bodies[1]
    point = {"mass": 0.2 * mass, "ipos": [0.0] * 3, "inertia": [1e-9] * 3, "explicitinertial": True}
    base.add_body(name="payload", pos=plain.body_ipos[1] + [0.1, -0.2, 0.0], **point)
    theirs, inertias = spec.compile(), []
    for model in (loaded, theirs):
        data = mujoco.MjData(model)
        data.qpos[2:7] = 1.0, *np.array([0.5, 0.5, -0.5, 0.5])
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        inertias.append(full)
    np.testing.assert_allclose(inertias[0], inertias[1], atol=1e-5)


def test_a_payload_is_where_it_is_on_a_base_whose_inertia_lies_at_its_origin(tmp_path):
    """MuJoCo takes the frame of such a body for that of its inertia."""
    robot = get_robot(str(write_dog(tmp_path)))
    model = crossing_model(robot, np.zeros((NUM_ROWS, NUM_COLS), np.float32))
    assert model.body_sameframe[1]
    vary(robot, model, payload=0.2, payload_x=0.1, payload_y=-0.2)
    data = mujoco.MjData(model)
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.xipos[1] - data.xpos[1], model.body_ipos[1], atol=1e-9)
    assert np.abs(model.body_ipos[1]).max() > 0.03


def test_a_negative_payload_leaves_a_body_that_can_be(robot, device):
    """Less of the base itself, wherever the payload would be, and no less than half of it."""
    light = {"payload": -0.05, "payload_x": 0.2, "payload_y": 0.2}
    rollout = Rollout(robot, robot.policy_file, num_terrains=1, replicas=1, device=device, space=SPACE)
    begin(rollout, genes(**light), 1)
    tree = rollout.sim.dynamics.tree
    plain = crossing_model(robot, np.zeros((NUM_ROWS, NUM_COLS), np.float32))
    share = 1.0 - min(0.5, 0.05 * plain.body_subtreemass[1] / plain.body_mass[1])
    assert tree.body_mass.numpy()[0, 1] == pytest.approx(share * plain.body_mass[1], rel=1e-5)
    np.testing.assert_allclose(tree.body_inertia.numpy()[0, 1], share * plain.body_inertia[1], rtol=1e-5)
    np.testing.assert_allclose(tree.body_ipos.numpy()[0, 1], plain.body_ipos[1], atol=1e-6)
    vary(robot, plain, **light)
    np.testing.assert_allclose(plain.body_inertia[1], tree.body_inertia.numpy()[0, 1], rtol=1e-5)


def test_times_are_rounded_alike_in_both():
    for seconds, dt, steps in ((0.03, 0.02, 2), (0.01, 0.02, 1), (0.0125, 0.005, 3), (0.06, 0.024, 3), (0.0, 0.02, 0)):
        assert round_steps(seconds, dt) == steps


def test_a_robot_whose_step_is_not_ours_has_no_conditions(anymal, monkeypatch):
    monkeypatch.setattr("sim.solver.is_supported", lambda *_: False)
    with pytest.raises(ValueError, match="robot 'anymal' cannot have conditions"):
        Rollout(anymal, anymal.policy_file, num_terrains=1, replicas=1, device="cpu", space=SPACE)


def test_a_kind_of_condition_is_a_part_that_is_absent_where_it_changes_nothing():
    rows = SPACE.uniform_random(3, 1)
    assert len(SPACE.parts(rows[0])) == 8 + len(CROSSED) and SPACE.num_genes == 64 + len(condition_genes(CROSSED))
    only = SPACE.without(rows, [8 + list(CONDITIONS).index("push")])
    changed = SPACE.condition_rows(only) != SPACE.condition_rows(rows)
    first = condition_column("push_x")
    assert changed[:, [first, first + 1]].all() and changed[:, :first].sum() == 0
    described = SPACE.describe(genes(payload=0.08, payload_x=-0.12, delay=0.02, friction=0.7)).splitlines()[-1]
    payload = "payload of 8.0% of the robot's mass, 0.12 m behind the centre of the base"
    assert described == f"{payload}, actions 20 ms late, friction times 0.70"
    assert SPACE.describe(genes()).splitlines()[-1] == "nominal conditions"
    pushed = SPACE.condition_text(genes(push_x=-0.3, push_y=1.2, push_time=4.0))
    assert pushed == "pushed by 0.3 m/s back and 1.2 m/s to the left after 4 s"
    assert SPACE.condition_text(genes(push_x=0.04, push_y=-1.2)) == "pushed by 1.2 m/s to the right after 6 s"
    assert SPACE.condition_text(genes(delay=0.002, lag=0.009)) == "nominal conditions"  # no whole steps
    assert SPACE.condition_text(genes(delay=0.0126, lag=0.033)) == "actions 15 ms late, observations 40 ms old"
    on_ice = get_space("course+friction+push")
    assert (on_ice.ground, on_ice.conditions, on_ice.num_genes) == (("friction",), ("push",), 36 + 32 + 3)
    assert space_key("course+push", None) == "course+push"
    with pytest.raises(ValueError, match=r"each .* once, got course\+push\+push: give course\+push$"):
        load_space("course+push+push")


def test_values_and_genes_are_each_others_inverse():
    for gene in condition_genes():
        assert gene.to_value(gene.absent) == nominal_row()[condition_column(gene.name)]
        count = round((gene.high - gene.low) / gene.step) + 1 if gene.step else 9
        values = np.linspace(gene.low, gene.high, count)
        np.testing.assert_allclose(gene.to_value(gene.to_gene(values)), values, atol=1e-12)
        np.testing.assert_allclose(gene.to_value([-5.0, 5.0]), [gene.low, gene.high])
