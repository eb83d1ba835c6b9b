"""The command-following task as a whole, and its terrains: tiles of the curriculum, mixes with elites, exchanges."""

import ctypes
from dataclasses import asdict

import numpy as np
import pytest
import torch
import tyro

from kernels.episode import Kind, Outcome
from sim.robots.find import get_robot
from sim.terrains.bank import make_terrains
from sim.terrains.conditions.kinds import condition_column, nominal_row
from sim.terrains.hand_crafted import CROSSING_TYPES, NUM_COLS, NUM_LEVELS, NUM_ROWS, training_tiles
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import GroundMaps
from tests.sim.dogs import STAND, mjcf, write_dog
from tests.train.conftest import CURRICULUM, NUM_ENVS
from train.cfg import CurriculumCfg, FinetuneCfg, NoiseCfg, PpoCfg, RecipeCfg, TaskCfg, TrainCfg
from train.commands import TrainCommand
from train.ppo.learner import CommandVecEnv
from train.task.task import CommandTask
from train.task.tiles import Mix, Tiles, TrainingElites, make_tiles

ACTION = slice(36, 48)


def joint_q(task: CommandTask) -> torch.Tensor:
    return torch.from_dlpack(task.sim.joint_q)


def test_a_standing_robot_keeps_standing(shared_task):
    task = shared_task
    task.restart_all(torch.zeros(task.num_envs, device=task.device))
    for _ in range(50):
        task.step(torch.zeros(task.num_envs, 12, device=task.device))
    assert (task.end == int(Outcome.RUNNING)).all()
    assert (task.episode_steps == 50).all()
    assert task.observation.isfinite().all() and task.observation.shape == (task.num_envs, 235)
    assert (task.observation[:, 8] < -0.8).all()  # projected gravity's z: upright
    sums = task.read_statistics()
    assert sums["steps"] == 50 * task.num_envs and sums["episodes"] == 0
    assert sums["tracking_lin_vel"] > 0 > sums["torques"]
    assert all(value == 0 for value in task.read_statistics().values())  # reading clears


def test_only_ended_episodes_restart(shared_task):
    task = shared_task
    task.restart_all(torch.full((task.num_envs,), 3, device=task.device))
    action = torch.full((task.num_envs, 12), 0.25, device=task.device)
    for _ in range(3):
        task.step(action)
    joint_q(task)[1, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0], device=task.device)  # on its back
    joint_q(task)[4, 0] = float("nan")
    before = joint_q(task).clone()
    task.step(action)
    ended = torch.tensor([False, True, False, False, True, False], device=task.device)
    assert (task.end != 0).equal(ended)
    assert task.end[4] == int(Outcome.INVALID)
    assert task.episode_steps.tolist() == [4, 0, 4, 4, 0, 4]
    assert (task.observation[ended, ACTION] == 0).all() and (task.observation[~ended, ACTION] == 0.25).all()
    start = torch.tensor([8.0, 4.0], device=task.device)
    assert ((joint_q(task)[ended, :2] - start).abs() <= 1.0).all()
    assert ((joint_q(task) - before)[~ended, :3].abs() < 0.1).all()
    assert task.observation.isfinite().all() and task.reward.isfinite().all()
    assert task.reward[4] == 0.0
    assert task.levels.tolist()[4] == 3  # an invalid state says nothing of the level


def test_an_exchange_counts_anew_and_forgets_nothing_that_is_yet_to_be_told(shared_task):
    task = shared_task
    task.restart_all(torch.zeros(task.num_envs, device=task.device))
    for _ in range(3):
        task.step(torch.zeros(task.num_envs, 12, device=task.device))
    task.read_statistics()
    joint_q(task)[1, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0], device=task.device)  # on its back
    task.step(torch.zeros(task.num_envs, 12, device=task.device))
    assert task.counts()["steps"].tolist() == [4] * 6 and task.counts()["episodes"].sum() == 1
    task.exchange(task.tiles)
    assert all((values == 0).all() for values in task.counts().values())
    task.step(torch.zeros(task.num_envs, 12, device=task.device))
    assert task.counts()["steps"].tolist() == [1] * 6 and task.counts()["episodes"].sum() == 0
    sums = task.read_statistics()
    assert sums["steps"] == 2 * 6 and sums["episodes"] == 1  # one step before the exchange, one after
    assert task.counts()["steps"].tolist() == [1] * 6


def test_robots_stand_on_the_tile_of_their_level(shared_task):
    task = shared_task
    levels = torch.arange(task.num_envs, device=task.device)
    task.restart_all(levels)
    columns = task.tiles.assign_columns(task.num_envs)
    np.testing.assert_array_equal(task.sim.terrain_of_env.numpy(), np.arange(task.num_envs) * 3 + columns)
    assert task.level_by_type().keys() == dict.fromkeys(task.tiles.type_of_column).keys()
    # Default height over the highest ground beneath: the scan sees nothing above the base's height less .5 m.
    assert (joint_q(task)[:, 2] > 0.6 - 0.25 * 9).all()
    assert (task.observation[:, 48:] > -0.6).all()  # ground no higher than .1 m + noise above base - .5 m, times 5


def rollout(task: CommandTask, steps: int) -> tuple[np.ndarray, ...]:
    generator = torch.Generator().manual_seed(0)
    rows = []
    for _ in range(steps):
        action = torch.randn(task.num_envs, 12, generator=generator) * 3.0
        task.step(action.to(task.device))
        rows.append([task.observation.clone(), task.reward.clone(), task.end.clone()])
    return tuple(torch.stack(part).cpu().numpy() for part in zip(*rows, strict=True))


def test_same_seed_same_numbers(make_task):
    task, same = make_task(seed=5), make_task(seed=5)
    numbers, again = rollout(task, 60), rollout(same, 60)
    if task.device == "cpu":
        for values, repeated in zip(numbers, again, strict=True):
            np.testing.assert_array_equal(values, repeated)
    else:  # the solver adds in any order there, and falling robots drift apart
        np.testing.assert_allclose(numbers[0][:2], again[0][:2], atol=1e-2)
    assert numbers[2].any()  # restarts are among what is repeated
    assert int(task.counter) == int(same.counter)
    assert (rollout(make_task(seed=6), 1)[0] != numbers[0][0]).any()


def test_load_and_friction_are_drawn_from_their_ranges(make_task):
    # 0.5 to 1.25: of 64 robots the least and the most lie within .05 of the ends (by this seed; the chance is 97 %).
    model = make_task(num_envs=64, added_base_mass=(2.0, 3.0)).sim.solver.mjw_model
    mass = model.body_mass.numpy()[:, 1]
    assert ((mass >= 28.37) & (mass <= 29.38)).all() and len(np.unique(mass)) == 64
    friction = model.geom_friction.numpy()[:, model.geom_bodyid.numpy() > 0, 0]
    assert 0.5 <= friction.min() < 0.55 and 1.2 < friction.max() <= 1.25
    assert len(np.unique(friction[:, 0])) == 64


def test_commands_speeds_and_levels_are_as_the_settings_say(make_task):
    task = make_task(lin_vel_x=(0.5, 0.6), lin_vel_y=(-0.3, -0.2), command_interval_s=0.04, push_interval_s=0.0)
    speeds = torch.from_dlpack(task.sim.joint_qd)[:, :6].abs()
    assert 0.4 < speeds.max() < 0.7  # .5 of the base, a little more of its centre of mass
    commands = []
    for _ in range(6):
        commands.append(task.observation[:, 9:11] / 2.0)
        task.step(torch.zeros(task.num_envs, 12, device=task.device))
    forward, sideward = torch.stack(commands).unbind(-1)
    assert (forward >= 0.5).all() and (forward <= 0.6).all() and (sideward >= -0.3).all() and (sideward <= -0.2).all()
    assert len(forward[:, 0].unique()) == 3  # a new one every two steps
    task.restart_all(torch.ones(task.num_envs, device=task.device))
    joint_q(task)[:2, 0] += torch.tensor([4.5, 3.5], device=task.device)  # half a tile is 4 m
    joint_q(task)[:2, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0], device=task.device)  # on their backs
    task.step(torch.zeros(task.num_envs, 12, device=task.device))
    assert task.levels.tolist() == [2, 0, 1, 1, 1, 1]


def test_observations_are_noisy_within_their_widths(make_task):
    # Half widths in the units of the observation: .1 m/s * 2, .2 rad/s * .25, .05 of gravity, nothing on the command,
    # .01 rad, 1.5 rad/s * .05, nothing on the action, .1 m * 5.
    widths = [
        (slice(0, 3), 0.2), (slice(3, 6), 0.05), (slice(6, 9), 0.05), (slice(9, 12), 0.0), (slice(12, 24), 0.01),
        (slice(24, 36), 0.075), (ACTION, 0.0), (slice(48, 235), 0.5),
    ]  # fmt: skip
    none = NoiseCfg(lin_vel=0.0, ang_vel=0.0, gravity=0.0, joint_pos=0.0, joint_vel=0.0, scan=0.0)
    noisy, clean = make_task(), make_task(noise=none)
    noise = []
    for _ in range(40):
        for task in (noisy, clean):
            task.step(torch.zeros(task.num_envs, 12, device=task.device))
        noise.append(noisy.observation - clean.observation)
    most, least = torch.stack(noise).amax((0, 1)), torch.stack(noise).amin((0, 1))
    for columns, width in widths:
        for largest in (most[columns], -least[columns]):  # of 240 uniform draws
            assert largest.min() >= 0.9 * width and 0.97 * width <= largest.max() <= width + 1e-5, columns


def test_crossings_begin_along_the_way_with_the_goal_where_it_is(make_task):
    task = make_task(num_envs=12, crosses=True, start_spread=8.0)
    x, y = joint_q(task)[:, 0], joint_q(task)[:, 1]
    assert (x >= 1.9).all() and (x <= 10.1).all() and x.min() < 4.0 and x.max() > 7.0
    assert ((y - 4.0).abs() <= 0.1).all()
    step = torch.zeros(12, 12, device=task.device)
    task.step(step)
    joint_q(task)[0, :2] = torch.tensor([13.6, 4.0], device=task.device)
    *_, extras = CommandVecEnv(task).step(step)
    assert task.end[0] == int(Outcome.GOAL) and (task.end[1:] == 0).all()
    assert extras["time_outs"].tolist() == [True] + [False] * 11  # no failure: its value goes on
    assert joint_q(task)[0, 0] <= 10.1  # it began anew, along the way


def test_robots_are_trained_under_the_conditions_of_their_terrains(device):
    rows = np.tile(nominal_row(), (2, 1))
    rows[1, [condition_column(name) for name in ("payload", "push_y", "push_time")]] = 0.2, 1.5, 0.1
    rows[1, [condition_column(name) for name in ("estimate", "wander")]] = 0.0, 0.5  # only what wanders is seen
    ground = GroundMaps(**vars(GroundMaps.plain(2)) | {"conditions": rows})
    tiles = Tiles(heights=np.zeros((2, 161, 321), np.float32), type_of_column=("a", "b"), ground=ground)
    cfg = TaskCfg(curriculum=CURRICULUM, push_interval_s=1e6, added_base_mass=(5.0, 5.0), friction=(1.0, 1.0))
    task = CommandTask(get_robot("anymal"), cfg, num_envs=4, device=device, seed=0, tiles=tiles)
    masses = task.sim.dynamics.tree.body_mass.numpy()[:, 1]
    whole = task.sim.solver.mjw_model.body_subtreemass.numpy()[0, 1]
    assert masses[:2] == pytest.approx(masses[0]) and masses[2:] == pytest.approx(masses[0] + 0.2 * whole)
    sideways, seen = [], []
    for _ in range(10):
        sideways.append(torch.from_dlpack(task.sim.joint_qd)[:, 1].clone())
        seen.append(task.observation[2:, :2].clone())
        task.step(torch.zeros(4, 12, device=task.device))
    jump = torch.stack(sideways).diff(dim=0)
    # The push of 0.1 s is made once the first five control steps have ended, before the sixth begins.
    assert (jump[4, 2:] > 0.7).all() and (jump[:4].abs() < 0.5).all() and (jump[4, :2].abs() < 0.5).all()
    wanders = torch.stack(seen).diff(dim=0)  # straight on, by numbers of the episode that stay the same in its steps
    assert wanders.abs().min() > 1e-5 and (wanders - wanders[0]).abs().max() < 1e-5
    task.exchange(Tiles(heights=tiles.heights, type_of_column=("a", "b")))
    assert task.sim.dynamics.tree.body_mass.numpy()[:, 1] == pytest.approx(masses[0])


def test_robots_are_trained_on_routes_and_to_stand(anymal, device):
    rows = np.tile(nominal_row(), (3, 1))
    rows[:, -1] = Kind.CROSS, Kind.ROUTE, Kind.STAND
    first = condition_column("segment_1_x")
    rows[1, first : first + 6] = 0.5, -0.2, 0.4, 0.0, 0.0, 0.0  # then a stop
    ground = GroundMaps(**vars(GroundMaps.plain(3)) | {"conditions": rows})
    tiles = Tiles(heights=np.zeros((3, 161, 321), np.float32), type_of_column=("a", "b", "c"), ground=ground)
    cfg = TaskCfg(crosses=True, curriculum=CURRICULUM, episode_s=1.0, push_interval_s=1e6)
    task = CommandTask(anymal, cfg, num_envs=3, device=device, seed=0, tiles=tiles)
    commands, ends = [], []
    for _ in range(50):
        commands.append(task.observation[:, 9:12].cpu() / torch.tensor([2.0, 2.0, 0.25]))
        task.step(torch.zeros(3, 12, device=task.device))
        ends.append(task.end.tolist())
    crossing, route, stand = torch.stack(commands, dim=1)
    assert (crossing[:, 0] > 0.6).all() and not stand.any()
    expected = torch.tensor([0.5 * 0.75, -0.2 * 0.75, 0.4])
    assert torch.allclose(route[:10], expected.expand(10, 3)) and not route[10:20].any()
    assert torch.allclose(route[20:], torch.tensor([0.75, 0.0, 0.0]).expand(30, 3))
    assert ends[-1] == [Outcome.TIME_OUT, Outcome.GOAL, Outcome.GOAL] and not np.any(ends[:-1])


def test_what_no_task_can_do_is_refused(shared_task):
    with pytest.raises(ValueError, match=r"\(6, 12\), got \(6, 11\)"):
        shared_task.step(torch.zeros(6, 11, device=shared_task.device))
    for changes in ({"friction": (-0.1, 1.0)}, {"lin_vel_x": (1.0, -1.0)}, {"episode_s": 0.01}):
        with pytest.raises(ValueError, match=f"task.{next(iter(changes))} "):
            TrainCfg(num_envs=6, task=TaskCfg(**changes)).check(get_robot("anymal"))


def test_a_robot_whose_file_has_it_in_the_ground_overflows_nothing_while_the_step_is_captured(tmp_path, capfd):
    # At the file's pose the dog lies 0.2 m deep, with more contacts than fit.
    model = mjcf().replace(f'pos="0 0 {STAND}"', 'pos="0 0 -0.2"')
    dog = get_robot(str(write_dog(tmp_path, model=model)))
    task = CommandTask(dog, TaskCfg.of(dog, curriculum=CURRICULUM), num_envs=NUM_ENVS, device="cpu", seed=0)
    assert task.sim.contacts.count.numpy().max() < dog.nconmax
    ctypes.CDLL(None).fflush(None)  # kernels print through C
    assert "contacts" not in capfd.readouterr().out


def test_nothing_handed_out_changes_later(shared_task):
    env = CommandVecEnv(shared_task)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (6, 12, 1000)
    handed = [env.get_observations()["policy"], env.episode_length_buf]
    actions = torch.zeros(6, 12, device=env.device)
    observations, rewards, dones, extras = env.step(actions)
    assert observations["policy"].shape == (6, 235) and rewards.shape == dones.shape == (6,)
    handed += [observations["policy"], rewards, dones, extras["time_outs"], actions]
    copies = [tensor.clone() for tensor in handed]
    for _ in range(3):
        env.step(torch.ones(6, 12, device=env.device))
    assert all(tensor.equal(copy) for tensor, copy in zip(handed, copies, strict=True))
    assert not env.get_observations()["policy"].equal(handed[0])


def test_time_outs_are_the_dones_of_the_clock(shared_task):
    env = CommandVecEnv(shared_task)
    shared_task.restart_all(torch.zeros(6, device=env.device))
    env.episode_length_buf = torch.tensor([0, 998, 999, 999, 5, 5], device=env.device)
    joint_q = torch.from_dlpack(shared_task.sim.joint_q)
    joint_q[3:5, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0], device=env.device)  # on their backs
    _, _, dones, extras = env.step(torch.zeros(6, 12, device=env.device))
    assert dones.tolist() == [False, False, True, True, True, False]
    assert extras["time_outs"].tolist() == [False, False, True, False, False, False]
    assert env.episode_length_buf.tolist() == [1, 999, 0, 0, 0, 6]


def test_the_command_line_begins_with_the_robots_settings():
    flags = ["--task.rewards.no-fly", "0.5", "--robot=cassie", "--task.push-speed", "0.25", "--iterations", "7"]
    cfg = tyro.cli(TrainCommand, args=flags, default=TrainCommand.defaults(flags))
    expected = TaskCfg.of(get_robot("cassie"))
    assert (cfg.robot, cfg.iterations, cfg.task.push_speed) == ("cassie", 7, 0.25)
    assert asdict(cfg.task.rewards) == asdict(expected.rewards) | {"no_fly": 0.5}
    assert (cfg.task.only_positive, cfg.task.rewards.termination) == (False, -200.0)
    assert cfg.ppo == PpoCfg(init_noise_std=0.5, desired_kl=0.02, entropy=0.005)


def test_falls_are_paid_for_and_clipped_nowhere(make_task):
    # Nobody balances them: within two seconds all are down, each for -200 * .02 s = -4 in the step it ends with.
    task = make_task(robot="cassie", start_joint_range=0.1, start_velocity_range=0.1, push_interval_s=0.0)
    task.restart_all(torch.zeros(task.num_envs))
    assert task.observation.shape == (task.num_envs, 169)
    falls, total = 0, 0.0
    for _ in range(120):
        task.step(torch.zeros(task.num_envs, 12, device=task.device))
        fell, reward = (task.end != 0).cpu().numpy(), task.reward.cpu().numpy()
        assert (reward[fell] < -3.5).all() and np.isfinite(reward).all() and task.observation.isfinite().all()
        falls += int(fell.sum())
        total += float(reward.sum())
    sums = task.read_statistics()
    assert falls >= task.num_envs
    assert sums["base_collision"] + sums["tilt"] == falls
    assert sums["termination"] == pytest.approx(-200.0 * 0.02 * falls)
    assert sums["collision"] == 0.0 > sums["joint_deviation"]  # no limbs
    assert sums["dof_pos_limits"] <= 0.0 < sums["no_fly"]
    assert total == pytest.approx(sum(sums[name] for name in asdict(task.cfg.rewards)), rel=1e-4)
    assert sums["overflow"] == sums["invalid"] == 0


ELITES = SUPER_GAUSSIAN.hard_random(7, 0)


def make_mix(*, kind="generated", terrains=6, elites=ELITES, seed=0, draw="uniform", **changes) -> Mix:
    given = {"genes": (elites if kind == "generated" else ELITES[:0],), "spaces": (SUPER_GAUSSIAN,), **changes}
    cfg = FinetuneCfg(mix=kind, terrains=terrains, seed=seed, recipe=RecipeCfg(draw=draw))
    return Mix(cfg=cfg, elites=TrainingElites(**given), device="cpu")


def counts(goals, episodes, invalid=None):
    """What became of the episodes of 12 robots on 6 terrains, two on each."""
    return {
        "goal": np.repeat(np.float32(goals), 2),
        "episodes": np.repeat(np.float32(episodes), 2),
        "invalid": np.repeat(np.float32([0] * 6 if invalid is None else invalid), 2),
    }


def test_half_is_hand_crafted_and_half_are_elites():
    mix = make_mix()
    tiles = mix.next()
    assert (tiles.num_levels, tiles.num_columns, tiles.ground) == (1, 6, None)
    assert tiles.type_of_column == (*CROSSING_TYPES[:3], *["generated"] * 3)
    np.testing.assert_array_equal(tiles.heights[3:], make_terrains(ELITES[mix.rows], SUPER_GAUSSIAN)[0])
    assert len(set(mix.rows)) == 3
    # Robots begin a crossing at x = 2 on flat ground before the feature.
    assert (tiles.heights[:3, :, :80] == 0.0).all() and np.abs(tiles.heights[:3, :, 100:220]).max() > 0.0


def test_the_other_mixes():
    assert make_mix(kind="hand-crafted").next().type_of_column == CROSSING_TYPES
    mix = make_mix(kind="hard-random", terrains=5, genes=(), spaces=(COURSE,))
    first, second = mix.next(), mix.next()
    assert first.type_of_column == (*CROSSING_TYPES[:2], *["hard-random"] * 3)
    assert not first.heights[2:, :, :81].any() and np.abs(first.heights[2:]).max() > 0.1  # flat up to x = 4 m
    assert not any(np.array_equal(before, after) for before in first.heights[2:] for after in second.heights[2:])


def test_hand_crafted_terrains_are_as_low_as_the_space():
    spaces = map(get_space, ("super_gaussian@0.05", "super_gaussian"))
    low, usual = (make_mix(kind="hand-crafted", spaces=(space,)).next().heights for space in spaces)
    np.testing.assert_allclose(low, usual / 5, rtol=1e-5)


def test_exchanges_differ_and_follow_from_the_seed():
    mix, same, other = make_mix(), make_mix(), make_mix(seed=1)
    first = mix.next().heights
    np.testing.assert_array_equal(first, same.next().heights)
    assert not np.array_equal(first, other.next().heights)
    second = mix.next().heights
    assert not np.array_equal(first[:3], second[:3])
    np.testing.assert_array_equal(second, same.next().heights)


def test_few_elites_come_more_than_once_but_none_is_left_out():
    # 20 terrains of 7 elites: each twice, and 6 of them a third time.
    mix = make_mix(terrains=40)
    mix.next()
    assert sorted(np.bincount(mix.rows, minlength=7)) == [2, 3, 3, 3, 3, 3, 3]


def test_what_is_remembered_of_an_elite_is_its_last_exchange():
    mix = make_mix()
    mix.next()
    first = mix.rows.copy()
    mix.next(counts([9, 9, 9, 4, 0, 2], [9, 9, 9, 4, 9, 4], invalid=[0, 0, 0, 0, 4, 0]))
    np.testing.assert_array_equal(mix.episodes[first], [8, 10, 8])  # of both robots, but for the invalid ones
    np.testing.assert_array_equal(mix.crossed[first], [8, 0, 4])
    np.testing.assert_allclose(mix.success()[first], [1.0, 0.0, 0.5])
    assert mix.episodes.sum() == 26
    second = mix.rows.copy()
    mix.next(counts([0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1]))  # no episode ended on the second of them
    assert mix.episodes[second[0]] == 2 and mix.crossed[second[0]] == 2
    assert mix.episodes[second[1]] == dict(zip(first, [8, 10, 8], strict=True)).get(second[1], 0)  # as before


def test_a_resume_between_exchanges_counts_what_was_before_it_too():
    rate = np.linspace(0.0, 1.0, 7)
    straight, cut = (make_mix(draw="learnable", goal_rate=rate.copy()) for _ in range(2))
    straight.next(), cut.next()
    again = make_mix(draw="learnable", goal_rate=np.zeros(7))  # what the archive says by now is another thing
    tiles = again.restore(cut.state(counts([0, 0, 0, 3, 2, 1], [4] * 6)))
    np.testing.assert_array_equal(tiles.heights, cut.terrains().heights)
    exchanged = again.next(counts([0, 0, 0, 1, 0, 0], [1] * 6))
    np.testing.assert_array_equal(exchanged.heights, straight.next(counts([0, 0, 0, 4, 2, 1], [5] * 6)).heights)
    assert again.episodes.max() == 10 and again.crossed.max() == 8
    later = counts([1] * 6, [2] * 6)
    assert again.state(later) == straight.state(later)  # and nothing of it is left for the next


@pytest.mark.parametrize(
    ("draw", "crossed", "likely", "share"),
    [
        # Two of seven without replacement, weights .1 (five of them) and 1.1 (two): a likely one comes first with
        # 1.1/2.7, second with 5 * .1/2.7 * 1.1/2.6 after another kind and 1.1/2.7 * 1.1/1.6 after its like: .77.
        ("failing", [10, 10, 10, 10, 10, 0, 0], [5, 6], 0.77),
        ("learnable", [0, 0, 0, 0, 0, 5, 5], [5, 6], 0.77),
        # One has 1.1 and six .1: it comes first with 1.1/1.7, second with .6/1.7 * 1.1/1.6: .89 in all.
        ("learnable", [0, 0, 5, 0, 0, 10, 10], [2], 0.89),
    ],
)
def test_elites_are_drawn_by_how_often_they_were_crossed(draw, crossed, likely, share):
    drawn = np.zeros(7)
    for seed in range(300):
        mix = make_mix(draw=draw, terrains=4, seed=seed)
        mix.swap = 0
        mix.episodes[:], mix.crossed[:] = 10, crossed
        drawn[mix.draw_rows()] += 1
    assert drawn[likely].mean() / 300 == pytest.approx(share, abs=0.06)
    others = np.delete(drawn, likely)
    assert others.mean() / 300 == pytest.approx((2 - share * len(likely)) / len(others), abs=0.05)


def test_parts_are_drawn_in_equal_shares_however_learnable_they_are():
    genes, rate = SUPER_GAUSSIAN.hard_random(60, 0), np.repeat([0.0, 0.5], [40, 20])
    parts = {"genes": (genes[:40], genes[40:]), "spaces": (SUPER_GAUSSIAN,) * 2}
    mix = make_mix(terrains=12, draw="learnable", goal_rate=rate, **parts)
    rows = [mix.draw_rows() for mix.swap in range(300)]
    assert 0.45 < (np.concatenate(rows) < 40).mean() < 0.58  # a quarter and less by how learnable they are


def test_elites_of_several_spaces_are_drawn_together_each_with_its_own_ground():
    numbers = {"super_gaussian+friction": 3, "course": 4, "course+softness": 2}
    spaces = (*map(get_space, numbers), SUPER_GAUSSIAN)
    genes = [space.hard_random(count, 1) for space, count in zip(spaces, numbers.values(), strict=False)]
    genes.append(ELITES[:0])  # an archive of which all is held out
    mix = make_mix(terrains=18, genes=tuple(genes), spaces=spaces)
    tiles = mix.next()
    assert mix.num_elites == 9 and sorted(mix.rows) == list(range(9)) and tiles.ground is not None
    whole = [make_terrains(part, space) for part, space in zip(genes[:3], spaces, strict=False)]
    np.testing.assert_array_equal(tiles.heights[9:], np.concatenate([heights for heights, _ in whole])[mix.rows])
    assert (tiles.ground.friction[:9] == 1.0).all()  # hand-crafted ones
    slips, sinks = (tiles.ground.friction[9:] < 1).any((1, 2)), (tiles.ground.time_constant_s[9:] > 0).any((1, 2))
    np.testing.assert_array_equal(slips, mix.rows < 3)
    np.testing.assert_array_equal(sinks, mix.rows >= 7)
    np.testing.assert_array_equal(tiles.ground.friction[9:][slips], whole[0][1].friction[mix.rows[slips]])


def test_elites_that_fail_under_conditions_are_trained_on_under_them():
    spaces = get_space("super_gaussian+payload+push"), COURSE
    genes = spaces[0].hard_random(3, 1), COURSE.hard_random(2, 1)
    tiles = make_mix(terrains=10, genes=genes, spaces=spaces).next()
    expected = np.concatenate([spaces[0].condition_rows(genes[0]), COURSE.condition_rows(genes[1])])
    mix = make_mix(terrains=10, genes=genes, spaces=spaces)
    mix.next()
    np.testing.assert_array_equal(tiles.ground.rows[5:], expected[mix.rows])
    # Hand-crafted ones: nominal.
    np.testing.assert_array_equal(tiles.ground.rows[:5], COURSE.condition_rows(np.zeros((5, 36))))


def test_tiles_of_the_curriculum():
    tiles = make_tiles(CurriculumCfg(num_columns=5, noise_columns=2), seed=3)
    assert tiles.heights.shape == (NUM_LEVELS * 7, NUM_ROWS, NUM_COLS)
    assert (tiles.num_levels, tiles.num_columns) == (NUM_LEVELS, 7)
    assert tiles.type_of_column[-2:] == ("noise", "noise")
    without_noise = tiles.heights.reshape(NUM_LEVELS, 7, NUM_ROWS, NUM_COLS)[:, :5].reshape(-1, NUM_ROWS, NUM_COLS)
    np.testing.assert_array_equal(without_noise, training_tiles(5, np.random.default_rng(3).spawn(2)[0])[0])
    # Noise grows with the level.
    for level in range(NUM_LEVELS):
        tile = tiles.heights[level * 7 + 6]
        bound = 0.02 + 0.08 * level / 10
        assert 0.9 * bound < np.abs(tile).max() <= bound
    assert (tiles.heights[5] != tiles.heights[6]).any()
    # Every column gets its share.
    assert np.bincount(tiles.assign_columns(700)).tolist() == [100] * 7
    assert set(np.bincount(tiles.assign_columns(703))) == {100, 101}
    assert tiles.assign_columns(3).max() < 7
    # Of noise alone, and none at all.
    assert make_tiles(CurriculumCfg(num_columns=0, noise_columns=1), seed=0).type_of_column == ("noise",)
    with pytest.raises(ValueError, match="num_columns"):
        make_tiles(CurriculumCfg(num_columns=0, noise_columns=0), seed=0)
