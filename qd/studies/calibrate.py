"""Penalty scales: what each raw penalty comes to where a crossing fails, so that the six can be added and compared.

The scale of a penalty is its mean over those episodes on hard-random terrains that did not reach the goal: one typical
failure costs about 1 of each kind. Scales are measured once with the shipped controller, before any search, and never
tuned on an archive.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.workers.invalid import tell_invalid
from qd.workers.kept import Kept
from sim.files.command import OnGround, Where, Who, naming_what_is_next, publish
from sim.files.records import identity
from sim.files.settings import check, setting

if TYPE_CHECKING:
    from qd.fresh import Open
    from qd.workers.evaluator import Evaluate, EvaluatorCfg
    from sim.robots.robot import RobotCfg

_CPU_TERRAINS = 16  # at once: enough to keep some cores busy, little enough memory
_LOOK = (16, 5)
"""Terrains and episodes of the look at a few before the many; a GPU crosses all of them as quickly."""
_ENOUGH = 200
"""Failing episodes that scales are means over; with fewer, even of the most terrains, all episodes are."""
_FEW = 30
"""Of those episodes, how many at least a penalty should occur in."""


@dataclass(frozen=True, kw_only=True)
class Calibrate(Who, OnGround, Where):
    """Measure the penalty scales of a robot with a controller, on hard-random terrains.

    It writes them beside the robot's own controller, or beside the settings file of a robot that is not shipped. Every
    search reads them there.
    """

    terrains: int = setting(1_000, least=1)
    """Hard-random terrains to begin with. As many again are drawn until 200 episodes have missed the goal."""
    most_terrains: int = setting(5_000, least=1)
    """Largest number of terrains. With fewer failing episodes even then, all episodes give the scales."""
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
            ValueError: If a flag's value cannot be used; if a penalty never occurred, once the scales of the others
                are written.
            AllInvalidError: If no episode is valid.
            EvaluatorError: If a worker is lost; what was crossed is kept.
        """
        from qd.workers import evaluator as workers
        from sim.crossing import CrossingCfg
        from sim.robots.find import get_robot
        from sim.spaces.registry import load_space

        check(self)
        robot = get_robot(self.robot or "anymal")
        if self.policy is not None and self.out is None and robot.settings_file is None:
            raise ValueError(
                "the scales kept with a robot are those of its shipped controller, got another one (--policy): "
                "name a file for its scales with --out"
            )
        space = load_space(self.space, self.ground)
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
            space=space.name,
        )
        # Both are drawn row by row: of 5,000 the first 1,000 are those that 1,000 would be.
        genes = space.hard_random(self._most, self.seed)
        seeds = np.random.SeedSequence(self.seed).generate_state(self._most, np.uint32)
        out, opened = self.out or robot.scales_file, open_evaluator or workers.open_evaluator
        kept = Kept.beside(out, evaluator, [self.seed, self.terrains, self._most])

        def keep(crossed: Crossed) -> None:
            arrays = {name: getattr(crossed, name) for name in _KEPT}
            kept.write(**arrays)

        def measure() -> dict[str, Any]:
            crossed = _crossed_before(kept.read(), robot, self.replicas)
            if len(crossed):
                print(f"{len(crossed)} terrains are kept from before in {kept.file}.", flush=True)
            elif device == "cpu" and math.prod(_LOOK) < self.terrains * self.replicas / 2:
                _look(opened, evaluator, genes[: self.terrains], seeds)
            if self._wanted(crossed) > len(crossed):
                with (
                    naming_what_is_next(kept.state, lambda: "The same command goes on."),
                    opened(evaluator) as evaluate,
                ):
                    while (wanted := self._wanted(crossed)) > len(crossed):
                        _tell_turn(crossed, wanted, self.replicas, device)
                        at_once, part = evaluator.num_terrains, (genes[:wanted], seeds[:wanted])
                        crossed = _cross(evaluate, at_once, *part, crossed, keep)
            tell_invalid(crossed, "hard-random terrains")
            return {
                **workers.origin_of(device, self.seed, self.workers),
                **identity(robot, policy),
                "space": space.name,
                "crossing": asdict(CrossingCfg()),
                **_measured(crossed),
            }

        report = publish(out, measure, _show)
        kept.remove()
        absent = [name for name in robot.penalties if name not in report["scales"]]
        if absent:
            raise ValueError(
                f"no scale for {', '.join(absent)}: 0 in all {_words(report)}. Leave it out of the robot's penalties, "
                f"and the scales in {out} fit, or calibrate on more --terrains"
            )

    @property
    def _most(self) -> int:
        return max(self.terrains, self.most_terrains)

    def _wanted(self, crossed: "Crossed") -> int:
        """Terrains to cross before it is asked again whether there are enough failing episodes."""
        begun = -(-max(1, len(crossed)) // self.terrains) * self.terrains
        few = not crossed.scaled_by_failing and not crossed.invalid.all()
        more = self.terrains if few and len(crossed) == begun else 0
        return min(begun + more, self._most)


@dataclass(frozen=True, kw_only=True)
class Crossed:
    """What scales are measured by, of T terrains x R episodes."""

    penalties: NDArray[np.float64]
    """Raw sums, shape (T, R, P)."""
    invalidity: NDArray[np.uint8]
    """:class:`kernels.episode.Invalidity` of each episode, shape (T, R)."""
    reached_goal: NDArray[np.bool_]
    """Shape (T, R)."""
    penalty_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.invalidity)

    @property
    def invalid(self) -> NDArray[np.bool_]:
        """Shape (T, R)."""
        return self.invalidity != 0

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Valid, and did not reach the goal; shape (T, R)."""
        return ~self.invalid & ~self.reached_goal

    @property
    def scaled_by_failing(self) -> bool:
        """Whether enough episodes failed that scales are means over them alone."""
        return int(self.failing.sum()) >= _ENOUGH


_KEPT = ("penalties", "invalidity", "reached_goal")


def _crossed_before(arrays: dict[str, NDArray[Any]], robot: "RobotCfg", num_replicas: int) -> Crossed:
    """What was crossed before; nothing if the arrays do not fit."""
    nothing = Crossed(
        penalties=np.zeros((0, num_replicas, len(robot.penalties))),
        invalidity=np.zeros((0, num_replicas), np.uint8),
        reached_goal=np.zeros((0, num_replicas), bool),
        penalty_names=robot.penalties,
    )
    if arrays.keys() != set(_KEPT):
        return nothing
    crossed = replace(nothing, **arrays)
    shape = (len(crossed), num_replicas)
    fits = crossed.penalties.shape == (*shape, len(robot.penalties))
    return crossed if fits and crossed.invalidity.shape == crossed.reached_goal.shape == shape else nothing


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
    valid = ~crossed.invalid
    for name, mean in _means(crossed, valid).items():
        if not mean:
            print(
                f"Penalty '{name}' is 0 in all {valid.sum()} of them. If it cannot occur on this robot, stop here "
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
            part = Crossed(
                penalties=np.asarray(result.penalties, np.float64),
                invalidity=result.invalidity,
                reached_goal=result.reached_goal,
                penalty_names=tuple(result.penalty_names),
            )
            crossed = part if crossed is None else _joined(crossed, part)
            keep(crossed)
    assert crossed is not None
    return crossed


def _joined(before: Crossed, part: Crossed) -> Crossed:
    return replace(before, **{name: np.concatenate([getattr(before, name), getattr(part, name)]) for name in _KEPT})


def _tell_turn(crossed: Crossed, wanted: int, replicas: int, device: str) -> None:
    """Says what is crossed next, and why more than was asked for."""
    if len(crossed):
        print(f"{crossed.failing.sum()} of {crossed.invalid.size} episodes did not reach the goal so far.", flush=True)
    more = wanted - len(crossed)
    print(
        f"Crossing {more} {'more ' if len(crossed) else ''}hard-random terrains {replicas} times on {device}.",
        flush=True,
    )


def penalty_scales(crossed: Crossed) -> dict[str, float]:
    """Scale of each penalty; one that never occurred has none.

    Returns:
        By name the mean over the failing episodes, or over all valid ones if too few failed.
    """
    means = _means(crossed, crossed.failing if crossed.scaled_by_failing else ~crossed.invalid)
    return {name: mean for name, mean in means.items() if mean}


def _means(crossed: Crossed, episodes: NDArray[np.bool_]) -> dict[str, float | None]:
    """Mean of each penalty over some episodes, None where there are none."""
    rows = crossed.penalties[episodes]
    means = rows.mean(axis=0).tolist() if len(rows) else [None] * len(crossed.penalty_names)
    return dict(zip(crossed.penalty_names, means, strict=True))


def _measured(crossed: Crossed) -> dict[str, Any]:
    """The scales, and what they were measured on."""
    by_failing = crossed.scaled_by_failing
    rows = crossed.penalties[crossed.failing if by_failing else ~crossed.invalid]
    shares = (rows > 0.0).mean(axis=0).tolist()
    return {
        "terrains": len(crossed),
        "episodes": int(crossed.invalid.size),
        "invalid_episodes": int(crossed.invalid.sum()),
        "failing_episodes": int(crossed.failing.sum()),
        "scaled_by": "failing" if by_failing else "all",
        "scales": penalty_scales(crossed),
        "share_of_episodes_with": dict(zip(crossed.penalty_names, shares, strict=True)),
    }


def _num_scaled_by(report: dict[str, Any]) -> int:
    """Episodes that the scales are means over."""
    if report["scaled_by"] == "failing":
        return report["failing_episodes"]
    return report["episodes"] - report["invalid_episodes"]


def _words(report: dict[str, Any]) -> str:
    """The episodes that the scales are means over, in words."""
    kind = "episodes that did not reach the goal" if report["scaled_by"] == "failing" else "valid episodes"
    return f"{_num_scaled_by(report)} {kind}"


def _show(report: dict[str, Any]) -> None:
    if report["scaled_by"] == "all":
        print(
            f"Only {report['failing_episodes']} of {report['episodes']} episodes did not reach the goal, expected at "
            f"least {_ENOUGH}: scales are means over all. Scales of failures need more --most-terrains."
        )
    print(f"Means over {_words(report)}, of {report['terrains']} terrains:")
    for name, scale in report["scales"].items():
        print(f"  {name:<14}{scale:12.4f}")
        hits = round(report["share_of_episodes_with"][name] * _num_scaled_by(report))
        if hits < _FEW:
            print(f"  {'':<14}of {hits} episodes alone: too few for a scale to rely on; calibrate on more --terrains")
