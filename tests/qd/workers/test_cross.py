"""The crossing service: results of every terrain in order, and what its cache finds, keeps apart and gives up."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from qd.workers import cross as service
from qd.workers.cross import Cache, Crossings, cross
from qd.workers.evaluator import Compute
from qd.workers.invalid import AllInvalidError
from sim.files.command import Interrupted
from sim.robots.find import get_robot
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.stand_in import assert_same, compute_by

ROBOT = get_robot("anymal")
POLICY = str(ROBOT.policy_file)
TWO_WORKERS = Compute(workers="2")
GENES = SUPER_GAUSSIAN.hard_random(9, 3)
SEEDS = np.arange(9, dtype=np.uint32)


def cross_all(opened, cache=None, genes=GENES, seeds=SEEDS, *, replicas=20, policy=POLICY, **kwargs):
    with Crossings(ROBOT, compute_by(opened, TWO_WORKERS), cache=cache) as crossings:
        return crossings.cross(policy, genes, seeds, replicas=replicas, **kwargs)


EXPECTED = stand_in.evaluate(GENES, SEEDS, 20)


def test_cached_crossings_are_the_same_bit_for_bit_and_take_no_time(tmp_path):
    first = cross_all(Robots(), tmp_path)
    again = Robots()
    cached = cross_all(again, tmp_path)
    assert again.opened == []
    assert_same(cached, EXPECTED)
    assert (first.wall_s, cached.wall_s, cached.robot_steps) == (4.5, 0.0, 0)  # 0.5 s a terrain of the stand-in


def test_work_that_was_stopped_goes_on_from_its_last_lot_in_other_lots_and_another_order(tmp_path):
    stopped = Robots(stop_after=4)
    with pytest.raises(Interrupted, match="the same command goes on"):
        cross_all(stopped, tmp_path)
    assert stopped.seeds == [0, 1, 2, 3]  # two lots of a terrain a worker
    order = np.array([8, 3, 5, 0, 7])
    after = Robots()
    result = cross_all(after, tmp_path, GENES[order], SEEDS[order])
    assert after.seeds == [8, 5, 7]
    assert_same(result, stand_in.evaluate(GENES[order], SEEDS[order], 20))


CHANGES = [
    {"replicas": 10}, {"how": "resolved"}, {"reward": True}, {"penalties_from_s": 1.0}, {"space": "course"},
    {"policy": str(get_robot("cassie").policy_file)}, {"genes": -GENES}, {"seeds": SEEDS + np.uint32(100)},
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: next(iter(change)))
def test_crossings_of_another_kind_are_not_found(tmp_path, change):
    cross_all(Robots(), tmp_path)
    other = Robots()
    cross_all(other, tmp_path, **change)
    assert len(other.crossed) == len(GENES)


def test_crossings_by_other_code_robot_or_kind_of_device_are_not_found(tmp_path, monkeypatch):
    cross_all(Robots(), tmp_path)
    for robot, compute in ((get_robot("cassie"), TWO_WORKERS), (ROBOT, Compute("cuda"))):
        opened = Robots()
        cross({"a": POLICY}, GENES, SEEDS, robot=robot, compute=compute_by(opened, compute), replicas=20,
              cache=tmp_path)  # fmt: skip
        assert len(opened.crossed) == len(GENES)
    monkeypatch.setattr(service, "code_fingerprint", lambda rooms: "of other code")
    changed = Robots()
    cross_all(changed, tmp_path)
    assert len(changed.crossed) == len(GENES)


def test_a_reward_of_other_weights_is_not_found_and_what_has_no_reward_is(tmp_path):
    training = replace(ROBOT.training, rewards=replace(ROBOT.training.rewards, tracking_lin_vel=7.0))
    heavier = replace(ROBOT, training=training)  # as a user edits them in the robot's own file
    for reward, times in ((True, 2), (False, 1)):
        crossed = []
        for robot in (ROBOT, heavier, heavier):
            opened = Robots()
            cross({"a": POLICY}, GENES, SEEDS, robot=robot, compute=compute_by(opened, TWO_WORKERS), replicas=20,
                  cache=tmp_path / str(reward), reward=reward)  # fmt: skip
            crossed.append(len(opened.crossed))
        assert crossed == [len(GENES) if time < times else 0 for time in range(3)]


@pytest.mark.parametrize("damage", ["flip", "rename"])
def test_a_damaged_lot_is_crossed_again_and_said_in_a_line(tmp_path, capsys, damage):
    cross_all(Robots(), tmp_path)
    lots = sorted(tmp_path.iterdir())
    content = bytearray(lots[0].read_bytes())
    content[len(content) // 2] ^= 255
    if damage == "rename":
        lots[1].replace(lots[0])
    else:
        lots[0].write_bytes(content)
    capsys.readouterr()
    again = Robots()
    assert_same(cross_all(again, tmp_path), EXPECTED)
    assert len(again.crossed) in ((1, 2) if damage != "rename" else (2, 3, 4))
    out = capsys.readouterr().out
    assert out.count("\n") == 1 and str(lots[0]) in out
    after = Robots()
    cross_all(after, tmp_path)
    assert after.crossed == []


def test_the_cache_removes_what_was_not_used_for_longest(tmp_path):
    block = block_of(0)
    cache = Cache(tmp_path, most_bytes=25_000)
    for key in ("a", "b", "c"):
        cache.write(key, block)
    for place, key in enumerate(("a", "b", "c")):
        service.os.utime(cache.file(key), (place, place))
    assert cache.read("a") is not None  # now b is the one that was not used for longest
    cache.write("d", block)
    assert cache.keys() == ["a", "c", "d"]
    Cache(tmp_path, most_bytes=10).write("e", block)
    assert cache.keys() == ["e"]


def block_of(number):
    return {"values": np.random.default_rng(number).random(1000)}  # 8 kB that cannot be packed


def write_often(folder, number):
    block = block_of(number)
    for count in range(40):
        Cache(folder, most_bytes=20_000).write(f"key-{count % 4}", block)


def test_processes_share_a_cache(tmp_path):
    with ProcessPoolExecutor(2) as pool:
        for done in [pool.submit(write_often, tmp_path, number) for number in range(2)]:
            done.result()
    cache = Cache(tmp_path)
    stored = [cache.read(key)["values"].tolist() for key in cache.keys("key")]
    assert len(stored) == 2  # of four, for which there is no room
    assert all(block in [block_of(number)["values"].tolist() for number in range(2)] for block in stored)


def test_a_simulation_stays_open_for_calls_that_agree():
    opened = Robots()
    with Crossings(ROBOT, compute_by(opened, TWO_WORKERS)) as crossings:
        crossings.cross(POLICY, GENES[:2], SEEDS[:2], replicas=20, at_most=9)
        crossings.cross(POLICY, GENES, SEEDS, replicas=20)
        assert [cfg.num_terrains for cfg in opened.opened] == [4]  # two lots of a terrain a worker
        crossings.cross(POLICY, GENES, SEEDS, replicas=20, how="resolved")
        assert [cfg.resolved for cfg in opened.opened] == [False, True]


def test_lots_fill_the_device():
    opened = Robots()
    genes, seeds = np.zeros((5000, 64), np.float32), np.zeros(5000, np.uint32)
    for compute in (Compute("cuda"), Compute(workers="3")):
        with Crossings(ROBOT, compute_by(opened, compute)) as crossings:
            crossings.cross(POLICY, genes, seeds, replicas=20)
    gpu, cpu = opened.opened
    assert (gpu.num_terrains, gpu.envs_of_worker) == (2 * (16_384 // 20), 2 * (16_384 // 20) * 20)
    assert (cpu.num_terrains, cpu.num_workers) == (6, 3)


def test_no_terrains_open_nothing_and_a_controller_whose_code_has_no_file_is_not_stored(tmp_path):
    opened = Robots()
    result = cross_all(opened, genes=GENES[:0], seeds=SEEDS[:0], reward=True)
    assert result.penalties.shape == (0, 20, 6) and result.reward.shape == result.outcome.shape == (0, 20)
    assert opened.opened == []
    cross_all(Robots(), tmp_path, policy="builtins:abs")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("flaw", [{"replicas": 0}, {"how": "searchd"}])
def test_settings_that_mean_nothing_are_refused(flaw):
    with pytest.raises(ValueError, match="replicas must be 1 or more, how one of"):
        cross({"a": "shipped"}, np.zeros((1, 64)), np.zeros(1, np.uint32), **{"replicas": 1} | flaw)


def test_a_result_without_a_valid_episode_is_refused_unless_that_is_asked_for(tmp_path):
    def invalid(cfg, genes, seeds):
        result = stand_in.evaluate(genes, seeds, cfg.num_replicas)
        return stand_in.make_result(result.penalties, invalid=np.ones(result.invalid.shape))

    with pytest.raises(AllInvalidError):
        cross_all(Robots(invalid), tmp_path)
    assert cross_all(Robots(), tmp_path, invalid_ok=True).invalid.all()  # it was stored all the same


def test_mujoco_c_is_stored_apart(tmp_path, monkeypatch):
    calls = []

    def cross_terrains(robot, policy, terrains, seeds, *, num_episodes, resolved, **_):
        calls.extend(seeds.tolist())
        for number in range(len(terrains)):
            row = slice(number, number + 1)
            yield stand_in.evaluate(-terrains[row], seeds[row], num_episodes)

    monkeypatch.setattr(service, "cross_terrains", cross_terrains)
    cross_all(Robots(), tmp_path)
    for _ in range(2):
        result = cross_all(Robots(), tmp_path, how="mujoco_c")
        assert calls == SEEDS.tolist()
        assert_same(result, stand_in.evaluate(-GENES, SEEDS, 20))
    with pytest.raises(ValueError, match="reward"):
        cross_all(Robots(), how="mujoco_c", reward=True)
