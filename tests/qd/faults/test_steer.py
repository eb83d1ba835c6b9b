"""Witnesses: the search of ways on planted terrains, and what makes a way a witness."""

from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import SEGMENTS, Outcome
from qd.faults.numbers import describe_way
from qd.faults.steer import SteerCfg, find_kinds, find_ways, measure_line, score_ways, seek_witnesses
from sim.robots.find import get_robot
from sim.terrains.terrains import Terrains
from tests.qd.stand_in import result_of

WALL, BRIDGE, KERB, UNLUCKY, FIRM = range(5)


class Planted:
    """Crosses planted terrains, which the first gene names, as a robot would that goes where its way says."""

    def __init__(self) -> None:
        self.robot = get_robot("anymal")
        self.asked, self.speeds = [], []

    def cross(self, policy, terrains, *, replicas, engine="search", label, invalid_ok, progress=None, room=0):
        self.asked.append((policy, engine, len(terrains), replicas, label, progress is not None))
        steering = terrains.steering
        if steering is None:  # plain crossings of measure_line
            steering = np.full((len(terrains), replicas, SEGMENTS, 3), np.nan, np.float32)
        plain = np.isnan(steering[..., 0, 0])
        self.speeds.append(steering[..., 0].max())
        speed, offset = steering[..., 5, 0], steering[..., 5, 1]  # at the obstacle
        luck = np.stack([np.random.default_rng(int(seed)).uniform(size=replicas) for seed in terrains.seeds])
        kind = terrains.genes[:, :1].astype(int) + np.zeros_like(luck, int)
        bridge, slow = (offset > 1.5) & (offset < 2.5), (speed > 0.2) & (speed < 0.5)
        passes = (kind == BRIDGE) & bridge & ~plain | (kind == KERB) & slow & ~plain
        passes |= (kind == FIRM) | (kind == UNLUCKY) & (luck < 0.4)
        if policy == "strong":
            passes = passes | (kind == KERB)
        if engine == "resolved":
            passes &= luck < 0.9
        end = np.stack([np.where(passes, 13.6, 7.0), np.where(passes | plain, 4.0, 4.0 + offset), 0 * luck], axis=2)
        deviation = np.where(plain, 0.2 + 0.4 * luck, np.abs(steering[..., 1]).max(axis=2))
        result = result_of(np.where(passes, Outcome.GOAL, Outcome.TIME_OUT), final_position=end)
        return replace(result, deviation=deviation.astype(np.float32))


def planted(*kinds):
    genes = np.zeros((len(kinds), 64), np.float32)
    genes[:, 0] = kinds
    return Terrains(genes=genes, seeds=np.arange(len(kinds)))


def seek(kinds, walkers, limit_m=0.5):
    cfg, crosser = SteerCfg(), Planted()
    shape, rng = (len(kinds), cfg.seeds * len(walkers)), np.random.default_rng(2)
    seeds = np.random.default_rng(1).integers(2**32, size=shape, dtype=np.uint32)
    return crosser, seek_witnesses(crosser, walkers, planted(*kinds), seeds, limit_m, rng=rng, cfg=cfg)


def test_planted_terrains_get_the_right_word():
    crosser, witnesses = seek([WALL, BRIDGE, KERB, UNLUCKY], {"searched": "plain"})
    assert witnesses.kind.tolist() == [0, 1, 3, 0]
    assert witnesses.on_line.tolist() == [False, False, True, False]
    assert witnesses.walker.tolist() == ["searched"] * 4  # of all of them ways were sought
    assert 1.5 < witnesses.way[1, 5, 1] < 2.5 and 0.2 < witnesses.way[2, 5, 0] < 0.5
    assert (np.abs(witnesses.way[2, :, 1]) <= 0.5).all()
    # On the line all four in 12 generations; around, what it does not cross there.
    searches = [row for row in crosser.asked if row[-1]]  # in one bar each
    assert [(row[2], row[4]) for row in searches] == [(4, "searched on the line")] * 12 + [(3, "searched around")] * 12
    # Plain, steered, steered around, and both with contact resolved where the way led to the goal.
    tries = [row[1:3] for row in crosser.asked if not row[-1]]
    assert tries == [("search", 4), ("search", 4), ("search", 3), ("resolved", 2), ("resolved", 2)]
    goals, valid = witnesses.counts[2, :, 1, [0, 3]]
    assert valid.tolist() == [20, 20] and goals[0] == 20 and witnesses.counts[2, 0, 0].tolist() == [0, 0, 0, 20]


def test_another_walker_tries_only_what_has_no_witness_on_the_line():
    crosser, witnesses = seek([KERB, WALL, BRIDGE], {"searched": "plain", "C-G": "strong"})
    assert witnesses.kind.tolist() == [3, 0, 1] and witnesses.walker.tolist() == ["searched"] * 3
    first = next(row for row in crosser.asked if row[0] == "strong")
    assert first[2] == 2 and first[4] == "C-G on the line"


@pytest.mark.parametrize(("speed", "limit", "fastest"), [(1.5, 9.0, 1.5), (0.75, 9.0, 1.0), (0.75, 0.4, 0.4)])
def test_a_robot_goes_as_fast_as_it_is_commanded_elsewhere_and_as_its_description_lets_it(
    tmp_path, speed, limit, fastest
):
    file, crosser = tmp_path / "controller.toml", Planted()
    file.write_text(
        f'policy = "policy.pt"\naction_scale = 0.5\nobservation = [{{term = "command", limit = {limit}}}]\n'
    )
    crosser.robot = replace(crosser.robot, speed=speed)
    seeds, how = np.arange(4)[None].astype(np.uint32), {"rng": np.random.default_rng(0), "label": ""}
    find_ways(crosser, str(file), planted(WALL), seeds, limit_m=0.5, cfg=SteerCfg(generations=4), **how)
    assert max(crosser.speeds) == pytest.approx(fastest)


def counts_of(goals, plain=0, beside=None, resolved=None):
    """Of one terrain: goals of 20 on the line, beside it, with contact resolved as coarse unless given."""
    beside = goals if beside is None else beside
    row = [[plain, plain, plain, 20], [goals, beside, beside, 20]]
    return [row, row if resolved is None else resolved]


def test_kinds_by_hand():
    none = [[0, 0, 0, 20], [0, 0, 0, 0]]  # nobody crossed it with contact resolved
    rows = [
        counts_of(10), counts_of(9, beside=12), counts_of(9), counts_of(11, plain=9), counts_of(20, resolved=none),
        counts_of(0), [[[0, 0, 0, 20], [14, 14, 14, 14]]] * 2,
    ]  # fmt: skip
    # 10 of 20 against 0 of 20: p = C(20, 10) / C(40, 10) = 0.0002, times 7 / 2 under 0.05. Of the second 9 on the line
    # are under half, 12 beside it are not. 11 against 9 is luck: p = 0.38. Of the last more than a quarter is invalid.
    assert find_kinds(np.array(rows)).tolist() == [3, 2, 0, 0, 0, 0, 0]
    assert find_kinds(np.zeros((0, 2, 2, 4), np.int64)).tolist() == []


def test_the_plain_command_as_a_way_is_no_witness():
    goals = np.random.default_rng(3).binomial(20, 0.45, (1000, 2, 2))
    rows = [[counts_of(int(steered), plain=int(plain))[0] for plain, steered in both] for both in goals]
    assert not find_kinds(np.array(rows)).any()


def test_a_slow_robot_that_arrives_has_a_better_way_than_one_that_does_not():
    result = result_of([[Outcome.GOAL, Outcome.GOAL, Outcome.TIME_OUT]], duration_s=[[130.0, 90.0, 150.0]])
    late, soon, never = score_ways(result, 150.0, None, SteerCfg())[0]
    assert soon > late > 0.0 > never


def test_the_line_is_as_wide_as_plain_crossings_need():
    crosser = Planted()
    # Distances are uniform from 0.2 to 0.6 m: the 95th percentile lies at 0.58.
    assert measure_line(crosser, "plain", planted(*[FIRM] * 400)) == pytest.approx(0.58, abs=0.01)
    assert measure_line(crosser, "plain", planted(WALL, WALL)) == 0.5


def test_ways_in_words():
    way = np.zeros((SEGMENTS, 3), np.float32)
    way[:, 0] = 0.8
    way[5, 0], way[4, 1], way[-1, 1] = 0.4, -0.3, 2.0  # in the last segment the robot is sent to the goal all the same
    slowed = "at 0.8 m/s, slowed to 0.4 m/s from x = 7 to 8 m"
    assert describe_way(way) == f"{slowed}, and 0.3 m to the right from x = 7 to 8 m"
    way[:, 1] = 0
    assert describe_way(way) == slowed
    way[:, 0] = np.linspace(0.9, 1.0, SEGMENTS)
    assert describe_way(way) == "at 0.9 m/s"
