"""Evaluators that stay open for the next run."""

from contextlib import contextmanager
from dataclasses import replace

import pytest

from qd.workers.evaluator import EvaluatorCfg
from qd.workers.kept_open import kept_open

CFG = EvaluatorCfg(robot="anymal", policy="p", num_terrains=100, num_replicas=20, device="cuda:0")


class Openings:
    """What was opened, and what is open."""

    def __init__(self):
        self.made, self.open = [], []

    @contextmanager
    def __call__(self, cfg):
        self.made.append(cfg)
        self.open.append(cfg)
        yield len(self.made)
        self.open.remove(cfg)


def test_the_next_run_is_crossed_by_the_simulation_of_the_last():
    openings = Openings()
    with kept_open(openings) as opened:
        numbers = []
        # Of 100 there is room for 125, of 126 for 158. One of 125 is too large for 62 or fewer, one of 158 for 78.
        for terrains in (100, 125, 126, 158, 63, 79):
            with opened(replace(CFG, num_terrains=terrains)) as number:
                numbers.append(number)
        assert numbers == [1, 1, 2, 2, 1, 2]
        with opened(replace(CFG, num_terrains=100, resolved=True)) as number:
            assert number == 3
        assert len(openings.open) == 3
    assert not openings.open and [cfg.num_terrains for cfg in openings.made] == [125, 158, 125]


def test_the_one_that_was_used_longest_ago_makes_room():
    openings = Openings()
    with kept_open(openings) as opened:
        for policy in ("a", "b", "c", "d", "a", "e", "a"):
            with opened(replace(CFG, policy=policy)):
                pass
        assert [cfg.policy for cfg in openings.made] == ["a", "b", "c", "d", "e"]
        assert sorted(cfg.policy for cfg in openings.open) == ["a", "c", "d", "e"]


def test_one_under_which_something_failed_is_not_used_again():
    openings = Openings()
    with kept_open(openings) as opened:
        with pytest.raises(KeyboardInterrupt), opened(CFG):
            raise KeyboardInterrupt
        assert not openings.open
        with opened(CFG) as number:
            assert number == 2


def test_on_the_cpu_there_is_as_much_room_as_asked_for():
    openings = Openings()
    with kept_open(openings) as opened, opened(replace(CFG, device="cpu")):
        assert openings.made[0].num_terrains == 100
