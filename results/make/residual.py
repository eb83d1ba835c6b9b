"""Do small offsets of joint targets lead over terrains that no command leads over? residual.json.

Of the published archive's confirmed elites that no controller crosses, nor any on the line where it is steered, 500 are
drawn at random. The command stays plain. At most 0.3 rad are added to the joint targets that the controller asks for:
by a ``spline`` of each joint over the way to the goal, or, as a ``gait``, by splines times 1, sine and cosine of a
phase whose frequency is searched, too. A cross-entropy search (qd/faults/steer.py) looks for them, on the straight
line: else most of what it finds are legs that lead around, as commands do. Fresh episodes with and without offsets test
what it finds, as they test witnesses.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from qd.faults.judge import elite_seeds
from qd.faults.numbers import EPISODES
from qd.faults.steer import (
    LINE_M,
    SteerCfg,
    count_goals,
    cross_half,
    find_kinds,
    mix_segments,
    move_to_best,
    score_ways,
)
from qd.search.archive import WITNESSES
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.seeds import Stream
from results.make.common import Script, parse
from sim.controllers.loaders import Policy, load_policy, prepare_torch
from sim.controllers.runner import Memory, find_memory
from sim.crossing import CrossingCfg, SolverCfg, resolved
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout, RolloutResult
from sim.terrains.terrains import Terrains

TERRAINS = 500
KNOTS = 6
"""Of a spline, at equal distances from start to goal."""
LARGEST = 0.3
"""Offset of a joint target [rad]."""
FIRST_STD = 0.1
"""Of offsets in the first generation [rad]."""
LOWEST_HZ, FIRST_HZ, HIGHEST_HZ, STD_HZ = 0.5, 2.0, 4.0, 0.5
FORMS = {"spline": 1, "gait": 3}
"""How many splines a joint has."""


def find_offsets(
    genes: torch.Tensor, x: torch.Tensor, time_s: torch.Tensor, num_joints: int, largest: float = LARGEST
) -> torch.Tensor:
    """Offsets of joint targets [rad], shape (E, num_joints), of robots at ``x`` [m], ``time_s`` after their start [s].

    Genes have shape (E, splines * KNOTS * num_joints + 1): values at the knots [rad] and a frequency [Hz].
    """
    start, goal = CrossingCfg.start[0], CrossingCfg.goal[0]
    place = ((x - start) / (goal - start) * (KNOTS - 1)).clamp(0.0, KNOTS - 1.0)
    weights = (1.0 - (place[:, None] - torch.arange(KNOTS, device=x.device)).abs()).clamp(min=0.0)
    splines = torch.einsum("ek,eskj->esj", weights, genes[:, :-1].reshape(len(genes), -1, KNOTS, num_joints))
    phase = 2.0 * torch.pi * genes[:, -1] * time_s
    waves = torch.stack([torch.ones_like(phase), phase.sin(), phase.cos()], dim=1)[:, : splines.shape[1]]
    return torch.einsum("es,esj->ej", waves, splines).clamp(-largest, largest)


class OffsetPolicy:
    """A controller to whose actions offsets are added, as the genes of each episode say; it sees them as its own."""

    def __init__(self, policy: Policy, robot: RobotCfg) -> None:
        if find_memory(policy) is Memory.SHARED:
            raise ValueError("the controller must have no memory or reset(rows), got reset(), which begins all robots")
        self._policy: Any = policy
        self._robot = robot
        self._time_s = torch.zeros(0)

    def use(self, rollout: Rollout, genes: NDArray[np.float32]) -> None:
        """Takes genes, as :func:`find_offsets` takes them, a row an episode of a rollout."""
        self._episode = wp.to_torch(rollout.episode)
        self._x = wp.to_torch(rollout.sim.joint_q).reshape(len(self._episode), -1)[:, 0]
        self._genes = torch.from_numpy(genes).to(self._x.device)

    def reset(self, rows: torch.Tensor) -> None:
        """Begins an episode where ``rows``, bool, shape (num_envs,), is true."""
        if find_memory(self._policy) is Memory.PER_ROBOT:
            self._policy.reset(rows)
        if len(self._time_s) != len(rows):
            self._time_s = torch.zeros(len(rows), device=rows.device)
        self._time_s = torch.where(rows, 0.0, self._time_s)

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions, shape (num_envs, num_joints)."""
        genes = self._genes[self._episode.long().clamp(min=0)]
        offsets = find_offsets(genes, self._x, self._time_s, self._robot.num_joints)
        self._time_s = self._time_s + self._robot.control_dt
        return self._policy(observation) + offsets / self._robot.action_scale


class Crossings:
    """Episodes of a controller with offsets, one robot each, at the search's settings or with contact resolved."""

    def __init__(self, script: Script, terrains: Terrains, replicas: int, *, fine: bool = False) -> None:
        robot, solver = resolved(script.robot) if fine else (script.robot, SolverCfg())
        prepare_torch(script.device)
        self._policy = OffsetPolicy(load_policy(script.policy, script.robot, script.device), robot)
        self._terrains, self._replicas = terrains, replicas
        self._rollout = Rollout(
            robot, self._policy, num_terrains=len(terrains), replicas=replicas, device=script.device, solver=solver,
            space=terrains.space,
        )  # fmt: skip

    def __call__(self, genes: NDArray[np.floating], seeds: NDArray[np.uint32]) -> RolloutResult:
        """Results of T terrains by genes of each episode, shape (T, R, num_genes)."""
        self._policy.use(self._rollout, genes.reshape(-1, genes.shape[-1]).astype(np.float32))
        return self._rollout.evaluate(replace(self._terrains, seeds=seeds))

    def count(self, genes: NDArray[np.float32], seeds: NDArray[np.uint32], limit_m: float) -> NDArray[np.int64]:
        """Episodes without offsets and with them, genes of shape (T, num_genes), as ``Witnesses.counts`` has them.

        Shape (T, 2, 4).
        """
        repeated = np.repeat(genes[:, None], self._replicas, axis=1)
        return np.stack([count_goals(self(tried, seeds), limit_m) for tried in (0.0 * repeated, repeated)], axis=1)


def seek_offsets(
    cross: Callable[[NDArray[np.floating], NDArray[np.uint32]], RolloutResult],
    seeds: NDArray[np.uint32],
    splines: int,
    robot: RobotCfg,
    limit_m: float,
    *,
    rng: np.random.Generator,
    cfg: SteerCfg,
) -> tuple[NDArray[np.float32], list[dict[str, float]]]:
    """The best genes of each of T terrains, with a seed a generation, (T, generations), and what each generation does.

    ``crossed`` is the share of terrains that some sample has crossed so far, ``half`` that of those which at least half
    of the generation's samples cross, ``goal`` that of its episodes; all within ``limit_m`` of the straight line [m].
    """
    count, shape = len(seeds), (splines, KNOTS, robot.num_joints)
    size = int(np.prod(shape))
    mean, std = np.zeros((count, size + 1)), np.full((count, size + 1), FIRST_STD)
    mean[:, -1], std[:, -1] = FIRST_HZ, STD_HZ
    low, high = np.full(size + 1, -LARGEST), np.full(size + 1, LARGEST)
    low[-1], high[-1] = LOWEST_HZ, HIGHEST_HZ
    mix, crossed, curve = mix_segments(KNOTS, cfg), np.zeros(count, bool), list[dict[str, float]]()
    for generation in range(cfg.generations):
        noise = rng.standard_normal((count, cfg.samples, size + 1))
        knots = noise[..., :-1].reshape(count, cfg.samples, *shape)
        noise[..., :-1] = np.einsum("kl,tsclj->tsckj", mix, knots).reshape(count, cfg.samples, size)
        samples = np.clip(mean[:, None] + std[:, None] * noise, low, high)
        result = cross(samples, seeds[:, generation])
        mean, std = move_to_best(mean, std, samples, score_ways(result, robot.max_duration_s, limit_m, cfg), cfg)
        goal = result.reached_goal & (result.deviation <= limit_m)
        crossed |= goal.any(axis=1)
        shares = {"crossed": crossed, "half": goal.mean(axis=1) >= FAILING_GOAL_RATE, "goal": goal}
        row = {"samples": (generation + 1) * cfg.samples} | {key: float(of.mean()) for key, of in shares.items()}
        print(row, flush=True)
        curve.append(row)
    return mean.astype(np.float32), curve


def measure(
    script: Script, terrains: Terrains, seeds: NDArray[np.uint32], splines: int, limit_m: float, cfg: SteerCfg
) -> tuple[dict[str, Any], NDArray[np.int64]]:
    """Numbers of one form of offsets, on the line, and the kind of witness on each terrain.

    Seeds have shape (T, generations + 2).
    """
    began = time.perf_counter()
    rng = np.random.default_rng([script.seed, Stream.RESIDUAL, splines])
    crossings = Crossings(script, terrains, cfg.samples)
    genes, curve = seek_offsets(crossings, seeds[:, :-2], splines, script.robot, limit_m, rng=rng, cfg=cfg)
    del crossings  # its robots are the most
    counts = np.zeros((len(terrains), 2, 2, 4), np.int64)
    counts[:, 0] = Crossings(script, terrains, EPISODES).count(genes, seeds[:, -2], limit_m)
    if len(rows := np.flatnonzero(cross_half(counts[:, 0, 1])[:, -1])):
        crossings = Crossings(script, terrains[rows], EPISODES, fine=True)
        counts[rows, 1] = crossings.count(genes[rows], seeds[rows, -1], limit_m)
    kinds, crosses = find_kinds(counts), cross_half(counts[:, :, 1])[..., 0]
    numbers = {
        "genes": genes.shape[1],
        "crossed_coarse": int(crosses[:, 0].sum()),
        "crossed_both": int(crosses.all(axis=1).sum()),
        **{f"certified_{name}": int((kinds == kind).sum()) for kind, name in enumerate(WITNESSES) if name},
        "goals": dict(zip(("plain", "offsets"), counts[:, 0, :, 0].sum(axis=0).tolist(), strict=True)),
        "seconds": time.perf_counter() - began,
        "curve": curve,
    }
    return numbers, kinds


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Searches offsets of both forms on the same terrains."""
    script = parse(__doc__, argv, "residual.json")
    sizes = {"generations": 2, "samples": 4, "best": 2} if script.small else {"samples": 32}
    cfg = SteerCfg(least_std=0.02, **sizes)
    archive = script.read_archive()
    is_open = np.flatnonzero(archive.confirmed & ~archive.certified)
    rng = np.random.default_rng([script.seed, Stream.RESIDUAL])
    count = min(2 if script.small else TERRAINS, len(is_open))
    rows = np.sort(rng.choice(is_open, count, replace=False))
    times = cfg.generations + 2
    seeds = elite_seeds(archive, script.seed, times, stream=Stream.RESIDUAL).reshape(-1, times)[rows]
    terrains = Terrains(genes=archive.genes[rows], seeds=seeds[:, 0], space=archive.terrain_space)
    limit_m = LINE_M if archive.witnesses is None else archive.witnesses.limit_m
    forms, certified = dict[str, Any](), np.zeros(count, bool)
    for name, splines in FORMS.items():
        forms[name], kinds = measure(script, terrains, seeds, splines, limit_m, cfg)
        certified |= kinds == WITNESSES.index("line")
    return script.write({
        "steered": archive.witnesses is not None,
        "open": len(is_open),
        "tried": count,
        "certified": int(certified.sum()),
        "largest_rad": LARGEST,
        "limit_m": limit_m,
        "settings": asdict(cfg),
        "forms": forms,
    })  # fmt: skip


if __name__ == "__main__":
    main()
