"""Whether terrains break the controller in plain MuJoCo C too: the choice of terrains, and the comparison."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from kernels.episode import Outcome
from kernels.penalties import PENALTIES
from sim.bank import terrains_of
from sim.commands import Crosscheck
from sim.files.command import chosen_elites
from sim.files.intervals import bootstrap_interval, value_words, wilson_interval
from sim.files.provenance import provenance
from sim.ground import GroundMaps
from sim.mujoco_c.crossing import cross_plain
from sim.mujoco_c.model import crossing_model, refuse_softness
from sim.rates import crossing_rates, hits_of
from sim.robots.identity import identity
from sim.robots.robot import RobotCfg, get_robot
from sim.rollout import Rollout
from sim.simulation import SolverCfg, resolve_device, resolved
from sim.space import SUPER_GAUSSIAN, load_space, on_ground, read_pool
from sim.terrain import NUM_COLS, NUM_ROWS

_KEY = 20250605  # with the seed, the entropy of everything drawn here
_MAX_POOL = 6000  # a good controller leaves few that are neither easy nor hopeless


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Terrains of a pool that are neither too easy nor too hard to tell two simulators apart."""

    genes: NDArray[np.float32]
    """Shape (num_terrains, 64)."""
    index: list[int]
    """Where they stand in the pool."""
    first: list[float | None]
    """Success rates of the first set of episodes, by which they were chosen; None of those that were named."""
    looked_at: int
    """Terrains of the pool that were tried."""


class Comparison:
    """The pool, the choice, both simulators."""

    def __init__(self, cfg: Crosscheck) -> None:
        """Read and load everything.

        Raises:
            ValueError: If a flag's value cannot be used.
        """
        self.cfg = cfg
        self.robot = get_robot(cfg.robot)
        self.device = resolve_device(cfg.device)
        self.policy = cfg.policy or self.robot.policy_file
        self.rng = np.random.default_rng([_KEY, cfg.seed])
        if cfg.genes is not None and cfg.ground is not None:
            raise ValueError("a pool has ground of its own or none, got --ground beside --genes: leave --ground out")
        named = load_space(on_ground(cfg.space, cfg.ground) or SUPER_GAUSSIAN.name)
        self._pool, self.space = (None, named) if cfg.genes is None else read_pool(cfg.genes)
        refuse_softness(self.space)
        shape = self.space.ground_shape
        ground = None if shape is None else GroundMaps.plain(1, shape)
        crossing_model(self.robot, np.zeros((NUM_ROWS, NUM_COLS)), ground=ground)  # MuJoCo must read it too
        self._named: list[int] | None = None
        if cfg.elite is not None:
            if self._pool is None:
                raise ValueError(f"--elite {cfg.elite!r} names terrains of a pool: give the pool too (--genes)")
            self._named = chosen_elites(cfg.elite, len(self._pool), cfg.genes)

    def choose(self) -> Choice:
        """Terrains of middling difficulty, or those that are named.

        Raises:
            ValueError: If the pool has too few.
        """
        cfg, at_once, named = self.cfg, 200 if self.device.startswith("cuda") else 32, self._named
        pool = self.space.hard_random(_MAX_POOL, self.rng) if self._pool is None else self._pool
        if named is not None:
            return Choice(genes=pool[named], index=named, first=[None] * len(named), looked_at=0)
        order = self.rng.permutation(len(pool))
        rollout = self._rollout(self.robot, at_once)
        chosen: list[int] = []
        rates: list[float | None] = []
        looked_at = 0
        with tqdm(desc="choosing terrains", total=cfg.terrains, unit="terrain", disable=None) as bar:
            while len(chosen) < cfg.terrains and looked_at < len(pool):
                batch = order[np.arange(looked_at, looked_at + at_once) % len(pool)]
                new = min(at_once, len(pool) - looked_at)
                result = rollout.evaluate(pool[batch], self._seeds(at_once))
                first = crossing_rates(result.outcome[:new], "success")
                hits = np.flatnonzero((first >= cfg.between[0]) & (first <= cfg.between[1]))
                hits = hits[: cfg.terrains - len(chosen)]
                chosen += batch[hits].tolist()
                rates += first[hits].tolist()
                looked_at += new
                bar.update(len(hits))
        if len(chosen) < cfg.terrains:
            raise ValueError(
                f"only {len(chosen)} of {looked_at} terrains have a success rate within {cfg.between}, expected "
                f"{cfg.terrains}: give a larger --genes, fewer --terrains or a wider --between"
            )
        return Choice(genes=pool[chosen], index=chosen, first=rates, looked_at=looked_at)

    def _rollout(self, robot: RobotCfg, num_terrains: int, time_constant_s: float | None = None) -> Rollout:
        return Rollout(
            robot,
            self.policy,
            num_terrains=num_terrains,
            num_replicas=self.cfg.episodes,
            device=self.device,
            solver=SolverCfg(time_constant_s=time_constant_s),
            space=self.space,
        )

    def _seeds(self, count: int) -> NDArray[np.uint32]:
        return self.rng.integers(2**32, size=count, dtype=np.uint32)

    def _resolved(self, fine: bool) -> tuple[RobotCfg, float | None]:
        """The robot as a simulator steps it, and its contact time constant [s], None for the file's."""
        if not fine:
            return self.robot, None
        robot, solver = resolved(self.robot)
        return robot, solver.time_constant_s

    def run(self) -> dict[str, Any]:
        """Choose, cross in both simulators, compare; everything of the results file."""
        cfg = self.cfg
        choice = self.choose()
        genes, seeds = choice.genes, self._seeds(len(choice.index))
        robot, time_constant_s = self._resolved(cfg.fine == "both")
        ours = self._rollout(robot, len(genes), time_constant_s).evaluate(genes, seeds)
        simulated, plain_time_constant_s = self._resolved(cfg.fine != "neither")
        heights, ground = terrains_of(genes, self.space, device=self.device)
        plain = cross_plain(
            simulated,
            str(self.policy),
            heights,
            seeds,
            num_episodes=cfg.plain_episodes,
            device=self.device,
            processes=cfg.workers or os.cpu_count() or 1,
            time_constant_s=plain_time_constant_s,
            ground=ground,
        )
        plain_penalties = np.concatenate([crossings.penalties for crossings in plain])
        pairs = [
            Pair(index=choice.index[k], first=rate, ours=ours.outcome[k], plain=plain[k].outcome)
            for k, rate in enumerate(choice.first)
        ]
        return {
            **provenance(self.device, cfg.seed),
            **identity(self.robot, self.policy),
            "space": self.space.name,
            "pool": "hard_random" if cfg.genes is None else str(cfg.genes),
            "looked_at": choice.looked_at,
            "ours": _settings(robot, time_constant_s),
            "mujoco_c": _settings(simulated, plain_time_constant_s),
            **summarise(pairs, cfg.seed),
            "penalties": {
                name: {
                    "ours": float(np.nanmean(ours.penalties[..., k])),
                    "mujoco_c": float(np.nanmean(plain_penalties[:, PENALTIES.index(name)])),
                }
                for k, name in enumerate(ours.penalty_names)
            },
        }


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Crossings of one terrain in both simulators."""

    index: int
    """Where the terrain stands in its pool."""
    first: float | None
    """Success rate of the set of episodes by which the terrain was chosen; None if it was named."""
    ours: NDArray[np.uint8]
    """:class:`kernels.episode.Outcome` of the parallel simulation, shape (num_episodes,)."""
    plain: NDArray[np.uint8]
    """The same of plain MuJoCo, shape (num_plain_episodes,)."""


def _hits(outcome: NDArray[np.uint8], kind: str) -> tuple[int, int]:
    hits, counted = hits_of(outcome, kind)
    return int(hits.sum()), int(counted.sum())


def _compare(pair: Pair, kind: str) -> dict[str, Any]:
    low, high = wilson_interval(*_hits(pair.ours, kind))
    plain_rate = float(crossing_rates(pair.plain, kind))
    return {
        "ours": float(crossing_rates(pair.ours, kind)),
        "interval": [low, high],
        "mujoco_c": plain_rate,
        "mujoco_c_interval": list(wilson_interval(*_hits(pair.plain, kind))),
        "inside": low <= plain_rate <= high,
    }


def summarise(pairs: Sequence[Pair], seed: int) -> dict[str, Any]:
    """Rates side by side, a row a terrain, and the bias of the mean: MuJoCo C's rate minus ours.

    Raises:
        ValueError: If no terrain has a valid episode in both; one that has none is left out and named.
    """
    left_out = [pair.index for pair in pairs if not _hits(pair.ours, "goal")[1] or not _hits(pair.plain, "goal")[1]]
    invalid = {
        "ours": int(sum((pair.ours == Outcome.INVALID).sum() for pair in pairs)),
        "mujoco_c": int(sum((pair.plain == Outcome.INVALID).sum() for pair in pairs)),
    }
    pairs = [pair for pair in pairs if pair.index not in left_out]
    if not pairs:
        raise ValueError("no terrain has a valid episode in both simulators: nothing to compare")
    rows = [
        {
            "index": pair.index,
            "first_success": pair.first,
            "episodes": [len(pair.ours), len(pair.plain)],
            "success": _compare(pair, "success"),
            "goal": _compare(pair, "goal"),
        }
        for pair in pairs
    ]
    totals = {}
    for kind in ("success", "goal"):
        ours = np.array([row[kind]["ours"] for row in rows])
        plain = np.array([row[kind]["mujoco_c"] for row in rows])
        totals[kind] = {
            "inside": int(sum(row[kind]["inside"] for row in rows)),
            "ours": float(ours.mean()),
            "mujoco_c": float(plain.mean()),
            "bias": float((plain - ours).mean()),
            "bias_interval": bootstrap_interval(plain - ours, seed),
        }
    return {**totals, "invalid": invalid, "left_out": left_out, "terrains": rows}


def _settings(robot: RobotCfg, time_constant_s: float | None) -> dict[str, Any]:
    return {"physics_dt": robot.physics_dt, "time_constant_s": time_constant_s or "of the robot's file"}


def print_comparison(report: dict[str, Any]) -> None:
    """Prints a row a terrain, and the means."""
    words = {"goal": "goal", "success": "no base collision"}
    print(" ".join([f"{'terrain':>7}", *(f"{f'{what}: ours':>24} {'MuJoCo C':>9} {'':>8}" for what in words.values())]))
    for row in report["terrains"]:
        cells = [f"{row['index']:>7}"]
        for kind in words:
            ours = value_words(row[kind]["ours"], row[kind]["interval"], ".2f")
            cells.append(f"{ours:>24} {row[kind]['mujoco_c']:>9.2f}")
            cells.append("inside  " if row[kind]["inside"] else "outside ")
        print(" ".join(cells))
    for kind, what in words.items():
        total = report[kind]
        bias = value_words(total["bias"], total["bias_interval"], "+.3f")
        print(
            f"{what}: {total['inside']} of {len(report['terrains'])} rates of MuJoCo C inside our interval; mean "
            f"{total['ours']:.3f} against {total['mujoco_c']:.3f}, bias {bias}"
        )
    print(f"invalid episodes: {report['invalid']}")
    print("mean penalties: " + json.dumps(report["penalties"]))
