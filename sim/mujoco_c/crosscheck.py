"""Do terrains break the controller in another simulator too? ``python -m sim.mujoco_c.crosscheck --robot anymal``.

Of a pool of terrains, those are taken on which a first set of episodes succeeds in 30 to 90 %, or those that
``--elite`` names. On each of them fresh episodes are then held against more of plain MuJoCo C: the same robot file,
height grid, controller and starts, but MuJoCo's own heightfield contact, a converged solver, and a second
implementation of everything round it.
"""

import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from kernels.penalties import PENALTIES
from sim.bank import TerrainBank
from sim.files.command import chosen_elites, exit_code_of, publish
from sim.files.provenance import provenance
from sim.mujoco_c.agreement import Pair, summarise
from sim.mujoco_c.crossing import draw_starts
from sim.mujoco_c.model import crossing_model
from sim.mujoco_c.processes import run_plain
from sim.policy.spec import ControllerSpec
from sim.robots.robot import RobotCfg, get_robot
from sim.rollout import Rollout, RolloutResult
from sim.simulation import SolverCfg, resolve_device
from sim.space import SUPER_GAUSSIAN

_KEY = 20250605  # with the seed, the entropy of everything drawn here
_MAX_POOL = 6000  # a good controller leaves few that are neither easy nor hopeless
_FINE_DT = 0.001
_FINE_TIME_CONSTANT_S = 0.003


@dataclass(frozen=True, kw_only=True)
class CrosscheckCfg:
    """Hold the crossings of the parallel simulation against the same crossings in plain MuJoCo C.

    The full check is 20 terrains x 200 episodes of MuJoCo: half an hour on two cores, two minutes on 16. Look at the
    cheap one first: --terrains 4 --plain-episodes 20.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    policy: str | None = None
    """A checkpoint, a TorchScript or ONNX file, file.py:callable or module:callable; the shipped controller."""
    device: str | None = None
    """Of the parallel simulation: cpu, cuda or cuda:N; CUDA where there is one. Plain MuJoCo always runs on the CPU."""
    genes: Path | None = None
    """Pool of terrains: an archive.npz, or any .npz with genes (num_terrains, 64); drawn hard-random if left out."""
    elite: str | None = None
    """Exactly these of --genes instead of a choice by success rates: one number, several as in --elite "97 124", or
    all; --terrains and --between then count for nothing."""
    terrains: int = 20
    """Terrains to compare on."""
    between: tuple[float, float] = (0.3, 0.9)
    """Success rate in the first set of episodes that a terrain must have."""
    episodes: int = 20
    """Episodes a terrain of the parallel simulation, in the first set and in the fresh one."""
    plain_episodes: int = 200
    """Episodes a terrain of plain MuJoCo; the first of them begin exactly as the fresh ones do."""
    fine: Literal["neither", "mujoco", "both"] = "neither"
    """Who resolves its contacts: steps of 1 ms, a time constant of 3 ms, five times the work. With the file's own 5
    and 10 ms, feet sink into the ground and MuJoCo's heightfield holds them by the facets beside. `both` compares the
    simulators, `mujoco` what the file's settings come to."""
    processes: int | None = None
    """Processes of plain MuJoCo; one a core."""
    seed: int = 0
    """Draws pool, choice and starts."""
    out: Path | None = None
    """Where to write; printed alone if left out."""


def read_pool(path: Path) -> NDArray[np.float32]:
    """Genes of a pool, shape (num_terrains, 64).

    Raises:
        ValueError: If the file holds none.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            genes = content["genes"]
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"--genes {path}: expected an .npz file with an array 'genes', got: {error}") from error
    if genes.ndim == 2 and genes.dtype.kind == "f":
        with np.errstate(over="ignore"):
            genes = genes.astype(np.float32)
    if (
        genes.ndim != 2
        or genes.shape[1] != 64
        or not len(genes)
        or genes.dtype.kind != "f"
        or not np.isfinite(genes).all()
    ):
        raise ValueError(
            f"--genes {path}: 'genes' must be finite floats of shape (num_terrains, 64), got {genes.dtype} of shape "
            f"{genes.shape}"
        )
    return genes


def success_rates(result: RolloutResult) -> NDArray[np.float64]:
    """Share of each terrain's valid episodes without base collision, NaN without any; shape (num_terrains,)."""
    valid = (~result.invalid).sum(axis=1)
    return np.where(valid > 0, 1.0 - result.base_collision.sum(axis=1) / np.maximum(valid, 1), np.nan)


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


class Crosscheck:
    """One comparison: the pool, the choice, both simulators."""

    def __init__(self, cfg: CrosscheckCfg) -> None:
        """Read and load everything.

        Raises:
            ValueError: If something asked for cannot be had.
        """
        low, high = cfg.between
        if not 0.0 <= low < high <= 1.0 or min(cfg.terrains, cfg.episodes, cfg.plain_episodes) < 1:
            raise ValueError(
                "terrains, episodes and plain-episodes must be positive and between two rising rates, got "
                f"{cfg.terrains}, {cfg.episodes}, {cfg.plain_episodes} and {cfg.between}"
            )
        if (cfg.processes is not None and cfg.processes < 1) or cfg.seed < 0:
            raise ValueError(f"processes must be at least 1 and seed at least 0, got {cfg.processes} and {cfg.seed}")
        self.cfg = cfg
        self.robot = get_robot(cfg.robot)
        crossing_model(self.robot, np.zeros((2, 2)))  # MuJoCo must read it too
        self.device = resolve_device(cfg.device)
        self.policy = cfg.policy or self.robot.policy_file
        self.rng = np.random.default_rng([_KEY, cfg.seed])
        self._pool = None if cfg.genes is None else read_pool(cfg.genes)
        self._named = self._choice_named()

    def _choice_named(self) -> Choice | None:
        """The terrains that the command line names, if it does.

        Raises:
            ValueError: If there are none of these numbers.
        """
        cfg = self.cfg
        if cfg.elite is None:
            return None
        if self._pool is None:
            raise ValueError(f"--elite {cfg.elite!r} names terrains of a pool: say which (--genes, or GENES= of make)")
        index = chosen_elites(cfg.elite, len(self._pool), cfg.genes)
        return Choice(genes=self._pool[index], index=index, first=[None] * len(index), looked_at=0)

    def choose(self) -> Choice:
        """Terrains of middling difficulty, or those that are named.

        Raises:
            ValueError: If the pool has too few.
        """
        if self._named is not None:
            return self._named
        cfg, at_once = self.cfg, 200 if self.device.startswith("cuda") else 32
        pool = SUPER_GAUSSIAN.hard_random(_MAX_POOL, self.rng).astype(np.float32) if self._pool is None else self._pool
        order = self.rng.permutation(len(pool))
        rollout = Rollout(self.robot, self.policy, num_terrains=at_once, num_replicas=cfg.episodes, device=self.device)
        chosen: list[int] = []
        rates: list[float | None] = []
        looked_at = 0
        with tqdm(desc="choosing terrains", total=cfg.terrains, unit="terrain", disable=None) as bar:
            while len(chosen) < cfg.terrains and looked_at < len(pool):
                batch = order[np.arange(looked_at, looked_at + at_once) % len(pool)]
                new = min(at_once, len(pool) - looked_at)
                first = success_rates(rollout.evaluate(pool[batch], self._seeds(at_once)))[:new]
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

    def _seeds(self, count: int) -> NDArray[np.uint32]:
        return self.rng.integers(2**32, size=count, dtype=np.uint32)

    def _resolved(self, fine: bool) -> tuple[RobotCfg, float | None]:
        """The robot as a simulator steps it, and its contact time constant [s], None for the file's."""
        if not fine:
            return self.robot, None
        decimation = round(self.robot.control_dt / _FINE_DT)
        return replace(self.robot, physics_dt=_FINE_DT, decimation=decimation), _FINE_TIME_CONSTANT_S

    def run(self) -> dict[str, Any]:
        """Choose, cross in both simulators, compare; everything of the results file."""
        cfg = self.cfg
        choice = self.choose()
        genes, seeds = choice.genes, self._seeds(len(choice.index))
        robot, time_constant_s = self._resolved(cfg.fine == "both")
        rollout = Rollout(
            robot,
            self.policy,
            num_terrains=len(genes),
            num_replicas=cfg.episodes,
            device=self.device,
            solver=SolverCfg(time_constant_s=time_constant_s),
        )
        ours = rollout.evaluate(genes, seeds)
        bank = TerrainBank(len(genes), device=self.device)
        bank.set_genes(genes)
        heights: Any = bank.heights.numpy()
        starts = [
            draw_starts(self.robot, grid, int(seed), cfg.plain_episodes, self.device)
            for grid, seed in zip(heights, seeds, strict=True)
        ]
        simulated, plain_time_constant_s = self._resolved(cfg.fine != "neither")
        processes = cfg.processes or os.cpu_count() or 1
        plain = run_plain(
            simulated, str(self.policy), heights, starts, processes=processes, time_constant_s=plain_time_constant_s
        )
        pairs = [
            Pair(index=choice.index[k], first=rate, ours=ours.outcome[k], plain=plain[k].outcome)
            for k, rate in enumerate(choice.first)
        ]
        return {
            **provenance(self.device, cfg.seed),
            "robot": self.robot.name,
            "policy": ControllerSpec.parse(self.policy).label,
            "pool": "hard_random" if cfg.genes is None else str(cfg.genes),
            "looked_at": choice.looked_at,
            "ours": _settings(robot, time_constant_s),
            "mujoco_c": _settings(simulated, plain_time_constant_s),
            **summarise(pairs, cfg.seed),
            "penalties": {
                name: {"ours": float(np.nanmean(ours.penalties[..., k])), "mujoco_c": float(np.nanmean(column))}
                for k, name in enumerate(ours.penalty_names)
                for column in [np.concatenate([crossings.penalties[:, PENALTIES.index(name)] for crossings in plain])]
            },
        }


def _settings(robot: RobotCfg, time_constant_s: float | None) -> dict[str, Any]:
    return {"physics_dt": robot.physics_dt, "time_constant_s": time_constant_s or "of the robot's file"}


def _print_table(report: dict[str, Any]) -> None:
    print(f"{'terrain':>7} {'success: ours':>22} {'MuJoCo C':>9} {'':>8} {'goal: ours':>19} {'MuJoCo C':>9}")
    for row in report["terrains"]:
        cells = [f"{row['index']:>7}"]
        for kind in ("success", "goal"):
            low, high = row[kind]["interval"]
            cells.append(f"{row[kind]['ours']:>8.2f} [{low:.2f} {high:.2f}] {row[kind]['mujoco_c']:>9.2f}")
            cells.append("inside  " if row[kind]["inside"] else "outside ")
        print(" ".join(cells))
    for kind in ("success", "goal"):
        total = report[kind]
        low, high = total["bias_interval"]
        print(
            f"{kind}: {total['inside']} of {len(report['terrains'])} rates of MuJoCo C inside our interval; mean "
            f"{total['ours']:.3f} against {total['mujoco_c']:.3f}, bias {total['bias']:+.3f} [{low:+.3f} {high:+.3f}]"
        )
    print(f"invalid episodes: {report['invalid']}")
    print("mean penalties: " + json.dumps(report["penalties"]))


def run(cfg: CrosscheckCfg) -> int:
    """Compare, print the table, write the file; returns the exit status."""
    check = Crosscheck(cfg)
    publish(cfg.out, check.run, _print_table)
    return 0


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(CrosscheckCfg, description=__doc__)
    return exit_code_of(lambda: run(cfg))


if __name__ == "__main__":
    sys.exit(main())
