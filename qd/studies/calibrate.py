"""Penalty scales: what each raw penalty comes to on hard-random terrains, so that the six can be added and compared.

The scale of a penalty is its mean over all valid episodes or, where it is 0 in over half of them, over the others.
Scales are measured once with the shipped controller, before any search, and never tuned on an archive.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.studies.kept import Kept
from qd.workers.invalid import tell_invalid
from sim.files.command import Where, Who, naming_what_is_next, publish
from sim.files.settings import check, setting
from sim.robots.identity import identity

if TYPE_CHECKING:
    from qd.fresh import Open
    from qd.workers.evaluator import Evaluate, EvaluatorCfg
    from sim.robots.robot import RobotCfg

_CPU_TERRAINS = 16  # at once: enough to keep some cores busy, little enough memory
_LOOK = (16, 5)
"""Terrains and episodes of the look at a few before the many; a GPU crosses all of them as quickly."""
_FEW = 30
"""Episodes with a penalty that its scale should at least be a mean over."""


@dataclass(frozen=True, kw_only=True)
class Calibrate(Who, Where):
    """Measure the penalty scales of a robot with a controller, on hard-random terrains.

    Writes them beside the robot's own controller, or beside the settings file of a robot that is not shipped, where
    every search reads them.
    """

    terrains: int = setting(300, least=1)
    """Hard-random terrains."""
    replicas: int = setting(20, least=1)
    """Episodes a terrain."""
    space: str = "super_gaussian"
    """Terrain space that they are drawn from: super_gaussian, course, or file.py:CLASS."""
    seed: int = setting(0, least=0)
    """Draws terrains and starts."""
    out: Path | None = None
    """Where to write; sim/robots/<robot>.scales.json, or <name>.scales.json beside a settings file."""

    def execute(self, *, open_evaluator: "Open | None" = None) -> None:
        """Measures the scales and publishes them.

        Args:
            open_evaluator: Opens what crosses the terrains.

        Raises:
            ValueError: If something asked for cannot be had; if a penalty never occurred, once the scales of the others
                are written.
            AllInvalidError: If no episode is valid.
            EvaluatorError: If a worker is lost; what was crossed is kept.
        """
        from qd.workers import evaluator as workers
        from sim.crossing import CrossingCfg
        from sim.robots.robot import get_robot
        from sim.space import load_space

        check(self)
        robot = get_robot(self.robot or "anymal")
        if self.policy is not None and self.out is None and robot.settings_file is None:
            raise ValueError(
                "the scales kept with a robot are those of its shipped controller, got another one (--policy): "
                "name a file for its scales with --out"
            )
        device, policy = workers.resolve_device(self.device, self.workers), self.policy or str(robot.policy_file)
        workers.check_policy(policy, robot, device)
        evaluator = workers.EvaluatorCfg(
            robot=robot,
            policy=policy,
            num_terrains=self.terrains if device.startswith("cuda") else min(self.terrains, _CPU_TERRAINS),
            num_replicas=self.replicas,
            device=device,
            workers=self.workers,
            num_envs=self.num_envs,
            space=self.space,
        )
        genes = load_space(self.space).hard_random(self.terrains, self.seed)
        seeds = np.random.SeedSequence(self.seed).generate_state(self.terrains, np.uint32)
        out, opened = self.out or robot.scales_file, open_evaluator or workers.open_evaluator
        kept = Kept(out, robot, evaluator, [self.seed, self.terrains])

        def keep(crossed: Crossed) -> None:
            kept.write(penalties=crossed.penalties, invalidity=crossed.invalidity)

        def measure() -> dict[str, Any]:
            crossed = _crossed_before(kept.read(), robot, self.replicas)
            if len(crossed):
                print(f"{len(crossed)} terrains are kept from before in {kept.file}.", flush=True)
            elif device == "cpu" and math.prod(_LOOK) < self.terrains * self.replicas / 2:
                _look(opened, evaluator, genes, seeds)
            print(f"Crossing {self.terrains} hard-random terrains {self.replicas} times on {device}.", flush=True)
            if len(crossed) < self.terrains:
                with (
                    naming_what_is_next(kept.state, lambda: "The same command goes on."),
                    opened(evaluator) as evaluate,
                ):
                    crossed = _cross(evaluate, evaluator.num_terrains, genes, seeds, crossed, keep)
            tell_invalid(crossed, "hard-random terrains")
            return {
                **workers.origin_of(device, self.seed, self.workers),
                **identity(robot, policy),
                "space": self.space,
                "crossing": asdict(CrossingCfg()),
                **_measured(crossed),
            }

        report = publish(out, measure, _show)
        kept.remove()
        absent = [name for name in robot.penalties if name not in report["scales"]]
        if absent:
            raise ValueError(
                f"no scale for {', '.join(absent)}: 0 in all {_valid(report)} valid episodes. Leave it out of the "
                f"robot's penalties, and the scales in {out} fit, or calibrate on more --terrains"
            )


@dataclass(frozen=True, kw_only=True)
class Crossed:
    """What scales are measured by, of T terrains x R episodes."""

    penalties: NDArray[np.float64]
    """Raw sums, shape (T, R, P)."""
    invalidity: NDArray[np.uint8]
    """:class:`kernels.episode.Invalidity` of each episode, shape (T, R)."""
    penalty_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.invalidity)

    @property
    def invalid(self) -> NDArray[np.bool_]:
        """Shape (T, R)."""
        return self.invalidity != 0


def _crossed_before(arrays: dict[str, NDArray[Any]], robot: "RobotCfg", num_replicas: int) -> Crossed:
    """What was crossed before; nothing if the arrays do not fit."""
    nothing = Crossed(
        penalties=np.zeros((0, num_replicas, len(robot.penalties))),
        invalidity=np.zeros((0, num_replicas), np.uint8),
        penalty_names=robot.penalties,
    )
    if arrays.keys() != {"penalties", "invalidity"}:
        return nothing
    crossed = replace(nothing, **arrays)
    fits = crossed.penalties.shape == (*crossed.invalidity.shape, len(robot.penalties))
    return crossed if fits else nothing


def _look(opened: "Open", evaluator: "EvaluatorCfg", genes: NDArray[Any], seeds: NDArray[Any]) -> None:
    """Crosses a few terrains a few times, and says what is wrong already.

    Raises:
        AllInvalidError: If no episode is valid.
    """
    terrains, replicas = min(_LOOK[0], len(genes)), min(_LOOK[1], evaluator.num_replicas)
    print(f"A look at {terrains} terrains x {replicas} episodes first.", flush=True)
    with opened(replace(evaluator, num_terrains=terrains, num_replicas=replicas)) as evaluate:
        crossed = _cross(evaluate, terrains, genes[:terrains], seeds[:terrains], None, lambda part: None)
    tell_invalid(crossed, "hard-random terrains")
    scales, episodes = penalty_scales(crossed), int((~crossed.invalid).sum())
    for name in crossed.penalty_names:
        if name not in scales:
            print(
                f"Penalty '{name}' is 0 in all {episodes} of them. If it cannot occur on this robot, stop here "
                "(Ctrl-C) and leave it out of the robot's penalties.",
                flush=True,
            )


def _cross(
    evaluate: "Evaluate", at_once: int, genes: NDArray[Any], seeds: NDArray[Any], crossed: Crossed | None,
    keep: Callable[[Crossed], None],
) -> Crossed:  # fmt: skip
    """Crosses the terrains that are not yet crossed, some at once, and keeps what is crossed after each turn."""
    from qd.run.progress import share_bar

    with share_bar("calibrate") as progress:
        for first in range(0 if crossed is None else len(crossed), len(genes), at_once):
            turn = slice(first, first + at_once)

            def show(share: float, first: int = first) -> None:
                progress(min(1.0, (first + share * at_once) / len(genes)))

            result = evaluate(genes[turn], seeds[turn], show)
            before = ([crossed.penalties], [crossed.invalidity]) if crossed is not None else ([], [])
            crossed = Crossed(
                penalties=np.concatenate([*before[0], np.asarray(result.penalties, np.float64)]),
                invalidity=np.concatenate([*before[1], result.invalidity]),
                penalty_names=tuple(result.penalty_names),
            )
            keep(crossed)
    assert crossed is not None
    return crossed


def penalty_scales(crossed: Any) -> dict[str, float]:
    """Scale of each penalty over the valid episodes of crossings; a penalty that never occurred has none.

    Args:
        crossed: :class:`Crossed`, or a rollout's result.
    """
    rows: NDArray[np.float64] = np.asarray(crossed.penalties, dtype=np.float64)[~crossed.invalid]
    scales = {}
    for name, values in zip(crossed.penalty_names, rows.T, strict=True):
        hit = values > 0.0
        if hit.any():
            scales[name] = float(values[hit].mean() if hit.mean() < 0.5 else values.mean())
    return scales


def _measured(crossed: Crossed) -> dict[str, Any]:
    """The scales, and what they were measured on."""
    rows = crossed.penalties[~crossed.invalid]
    shares = (rows > 0.0).mean(axis=0).tolist()
    return {
        "terrains": len(crossed),
        "episodes": int(crossed.invalid.size),
        "invalid_episodes": int(crossed.invalid.sum()),
        "scales": penalty_scales(crossed),
        "share_of_episodes_with": dict(zip(crossed.penalty_names, shares, strict=True)),
    }


def _valid(report: dict[str, Any]) -> int:
    return report["episodes"] - report["invalid_episodes"]


def _show(report: dict[str, Any]) -> None:
    for name, scale in report["scales"].items():
        print(f"  {name:<14}{scale:12.4f}")
        hits = round(report["share_of_episodes_with"][name] * _valid(report))
        if hits < _FEW:
            print(f"  {'':<14}of {hits} episodes alone: too few for a scale to rely on; calibrate on more --terrains")
