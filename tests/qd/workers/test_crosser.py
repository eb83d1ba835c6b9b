"""The crossing service: results in order, its cache, invalid episodes, and results that cannot be true."""

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import SEGMENTS, Outcome
from qd.workers import crosser as service
from qd.workers.cache import Cache
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser, cross
from qd.workers.invalid import AllInvalidError, explain_invalid, find_flaw, invalid_iterations
from sim.files.command import Interrupted
from sim.robots.find import get_robot
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.stand_in import assert_same, compute_by, evaluate

ROBOT = get_robot("anymal")
POLICY = str(ROBOT.policy_file)
TWO_WORKERS = Compute(workers="2")
GENES = SUPER_GAUSSIAN.hard_random(9, 3)
SEEDS = np.arange(9, dtype=np.uint32)
TERRAINS = Terrains(genes=GENES, seeds=SEEDS)


def cross_all(
    opened, cache=None, genes=GENES, seeds=SEEDS, *, robot=ROBOT, compute=TWO_WORKERS, replicas=20, policy=POLICY,
    space=SUPER_GAUSSIAN, **kwargs
):  # fmt: skip
    with Crosser(robot, compute_by(opened, compute), cache=cache) as crosser:
        return crosser.cross(policy, Terrains(genes=genes, seeds=seeds, space=space), replicas=replicas, **kwargs)


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


def test_what_is_stopped_says_what_is_kept(tmp_path):
    robots, said = Robots(stop_after=0), []
    with Crosser(ROBOT, compute_by(robots, TWO_WORKERS), cache=tmp_path) as crosser:
        for terrains in (TERRAINS, TERRAINS[4:], replace(TERRAINS, steering=np.zeros((9, 20, SEGMENTS, 3)))):
            with pytest.raises(Interrupted) as stopped:
                crosser.cross(POLICY, terrains, replicas=20)
            said.append(str(stopped.value))
            robots.stop_after = 2  # a lot, the first time
    # Nothing was crossed; then a lot was; steered crossings are not kept, but that lot is.
    assert said[0] == "Stopped." and "crossed is kept" in said[1] and "before this step is kept" in said[2]


CHANGES = [
    {"replicas": 10}, {"engine": "resolved"}, {"reward": True}, {"penalties_from_s": 1.0}, {"space": COURSE},
    {"policy": str(get_robot("cassie").policy_file)}, {"genes": -GENES}, {"seeds": SEEDS + np.uint32(100)},
    {"robot": get_robot("cassie")}, {"compute": Compute("cuda")}, {}
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: next(iter(change), "code"))
def test_crossings_of_another_kind_or_by_other_code_are_not_found(tmp_path, monkeypatch, change):
    cross_all(Robots(), tmp_path)
    if not change:
        monkeypatch.setattr(service, "code_fingerprint", lambda rooms: "of other code")
    other = Robots()
    cross_all(other, tmp_path, **change)
    assert len(other.crossed) == len(GENES)


def test_a_reward_of_other_weights_is_not_found_and_what_has_no_reward_is(tmp_path):
    training = replace(ROBOT.training, rewards=replace(ROBOT.training.rewards, tracking_lin_vel=7.0))
    heavier = replace(ROBOT, training=training)  # as a user edits them in the robot's own file
    for reward, expected in ((True, [9, 9, 0]), (False, [9, 0, 0])):
        every = [Robots(), Robots(), Robots()]
        for opened, robot in zip(every, (ROBOT, heavier, heavier), strict=True):
            cross_all(opened, tmp_path / str(reward), robot=robot, reward=reward)
        assert [len(opened.crossed) for opened in every] == expected


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


def test_the_cache_removes_the_least_recently_used_file(tmp_path):
    block = draw_block(0)
    cache = Cache(tmp_path, max_bytes=25_000)
    for key in ("a", "b", "c"):
        cache.write(key, block)
    for second, key in enumerate(("a", "b", "c")):
        os.utime(cache.file(key), (second, second))
    assert cache.read("a") is not None  # now b is the least recently used one
    reopened = Cache(tmp_path, max_bytes=25_000)
    assert all(reopened.read(key, ["values"]) for key in ("a", "b", "c"))  # looking through is no use
    cache.write("d", block)
    assert cache.keys() == ["a", "c", "d"]
    Cache(tmp_path, max_bytes=10).write("e", block)
    assert cache.keys() == ["e"]


def draw_block(number):
    return {"values": np.random.default_rng(number).random(1000)}  # 8 kB that cannot be packed


def write_often(folder, number):
    for count in range(40):
        Cache(folder, max_bytes=20_000).write(f"key-{count % 4}", draw_block(number))


def test_processes_share_a_cache(tmp_path):
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(write_often, [tmp_path] * 2, range(2)))
    cache = Cache(tmp_path)
    stored = [cache.read(key)["values"].tolist() for key in cache.keys("key")]
    assert len(stored) == 2  # of four, for which there is no room
    assert all(block in [draw_block(number)["values"].tolist() for number in range(2)] for block in stored)


def test_a_simulation_stays_open_for_calls_that_agree():
    opened = Robots()
    with Crosser(ROBOT, compute_by(opened, TWO_WORKERS)) as crosser:
        crosser.cross(POLICY, TERRAINS[:2], replicas=20, room=9)
        crosser.cross(POLICY, TERRAINS, replicas=20)
        assert [cfg.num_terrains for cfg in opened.opened] == [4]  # two lots of a terrain a worker
        crosser.cross(POLICY, TERRAINS, replicas=20, engine="resolved")
        assert [cfg.engine for cfg in opened.opened] == ["search", "resolved"]


def test_lots_fill_the_device():
    opened = Robots()
    terrains = Terrains(genes=np.zeros((5000, 64), np.float32), seeds=np.zeros(5000, np.uint32))
    for compute in (Compute("cuda"), Compute(workers="3")):
        with Crosser(ROBOT, compute_by(opened, compute)) as crosser:
            crosser.cross(POLICY, terrains, replicas=20)
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


@pytest.mark.parametrize("flaw", [{"replicas": 0}, {"engine": "searchd"}])
def test_settings_that_mean_nothing_are_refused(flaw):
    with pytest.raises(ValueError, match="replicas must be 1 or more, engine"):
        cross({"a": "shipped"}, TERRAINS[:1], **{"replicas": 1} | flaw)


def test_invalid_episodes_are_reported_and_refused_where_there_are_no_others_unless_they_may_be(tmp_path, capsys):
    def invalid(cfg, genes, seeds):
        result = stand_in.evaluate(genes, seeds, cfg.replicas)
        return stand_in.make_result(result.penalties, invalid=np.ones(result.invalid.shape))

    cross_all(Robots(), label="flat")
    with pytest.raises(AllInvalidError):
        cross_all(Robots(invalid), tmp_path)
    assert capsys.readouterr().err == ""
    assert cross_all(Robots(), tmp_path, invalid_ok=True, label="steep").invalid.all()  # it was stored all the same
    assert "steep: 180 of 180 episodes are invalid" in capsys.readouterr().err


def test_engines_are_stored_apart_and_mujoco_c_refuses_what_it_cannot(tmp_path):
    def rule(cfg, genes, seeds):
        return stand_in.evaluate(-genes if cfg.on_mujoco_c else genes, seeds, cfg.replicas)

    cross_all(Robots(rule), tmp_path)
    for crossed in (SEEDS.tolist(), []):
        robots = Robots(rule)
        assert_same(cross_all(robots, tmp_path, engine="mujoco_c"), stand_in.evaluate(-GENES, SEEDS, 20))
        assert robots.seeds == crossed
    for asked in ({"reward": True}, {"penalties_from_s": 1.0}, {"record": True}):
        with pytest.raises(ValueError, match="mujoco_c"):
            cross_all(Robots(), engine="mujoco_c", **asked)


def test_more_than_one_in_twenty_is_reported_with_the_remedy_of_the_most_frequent_reason():
    # 1 of 20 is 5 %, 2 of 20 are 10 %.
    assert explain_invalid({"speed": 1}, 20) is None
    words = explain_invalid({"speed": 1, "action": 1}, 20)
    assert "2 of 20" in words and "10.0%" in words and "max_speed" in words


def test_of_a_searchs_iterations_those_with_many_are_summed():
    # 3 of 40 are more than 5 %, 2 of 40 are not. 3 + 40 of 80 are 53.75 %.
    rows = [
        {"episodes": 40, "invalid_episodes": 3, "invalid_reasons": {"overflow": 2, "speed": 1}},
        {"episodes": 40, "invalid_episodes": 2, "invalid_reasons": {"speed": 2}},
        {"episodes": 40, "invalid_episodes": 40, "invalid_reasons": {"state": 40}},
    ]
    words = invalid_iterations(rows)
    assert "2 of 3" in words and "43 of 80" in words and "53.8%: 40 non-finite state, 2 solver overflow" in words
    assert invalid_iterations(rows[1:2]) is None


RESULT = evaluate(np.zeros((3, 64), np.float32), np.arange(3), 4)
FLAWED = [
    {"penalties": np.ones((2, 4, 6))},
    {"penalties": np.ones((3, 4, 5))},
    {"penalties": np.full((3, 4, 6), -1.0)},
    {"penalties": np.full((3, 4, 6), np.inf)},
    {"outcome": np.full((3, 4), Outcome.INVALID, np.uint8)},  # without a reason
    {"duration_s": np.zeros((3, 4), np.float32)},
    {"physics_steps": 0},
    {"reward": np.full((3, 4), np.nan)},
    {"reward": np.zeros((3, 3))},
]


@pytest.mark.parametrize("changes", FLAWED, ids=lambda changes: next(iter(changes)))
def test_a_result_that_cannot_be_true_is_known(changes):
    assert find_flaw(RESULT, 3, 4) is None
    assert find_flaw(replace(RESULT, **changes), 3, 4) and find_flaw("all went well", 3, 4)
