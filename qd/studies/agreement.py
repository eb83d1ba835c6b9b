"""How far rates at the search's settings lie from contact resolved and from MuJoCo C, on terrains selected by neither.

A terrain that was chosen by its rate at some settings owes a part of that rate to chance, which does not come again
(regression to the mean): compared on such terrains, any other settings seem to differ. So hard-random terrains and
elites are drawn at random here, and those that fail are chosen by one set of episodes and judged by another.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.fitness import FAILING_GOAL_RATE
from qd.run.directory import RUNS, published_or_newest
from qd.run.progress import share_bar
from qd.workers.evaluator import (
    EvaluatorCfg,
    check_policy,
    open_evaluator,
    origin_of,
    parse_workers,
    resolve_device,
)
from qd.workers.invalid import refuse_all_invalid
from qd.workers.kept import Kept
from sim.files.command import InSpace, Where, Who, chosen_elites, naming_what_is_next, publish
from sim.files.intervals import value_words
from sim.files.records import without_machine
from sim.files.settings import check, setting

if TYPE_CHECKING:
    from qd.fresh import Open
    from qd.show.elites import Found
    from qd.workers.evaluator import Evaluate
    from sim.robots.robot import RobotCfg
    from sim.space import TerrainSpace

_KEY = 20261123  # with the seed, the entropy of everything drawn here, and nowhere else
_HARD_RANDOM, _ELITES, _FIRST, _SECOND = range(4)  # streams of it
_MOST_AT_ONCE = {"cuda": 500, "cpu": 16}  # terrains, after which what was crossed is kept
_TWICE = ("search", "again")
_PLAIN = ("mujoco_c", "mujoco_c_resolved")
_NAMES = {"hard_random": "hard-random terrains", "elites": "elites", "named": "named terrains"}
_BARS = {"search": "search's settings", "again": "search's settings again", "resolved": "contact resolved"}
_WORDS = {
    "again": "the same settings again, which shows chance alone",
    "resolved": "contact resolved",
    "mujoco_c": "MuJoCo C",
    "mujoco_c_resolved": "MuJoCo C, contact resolved",
    "both_resolved": "MuJoCo C, contact resolved by both",
}


@dataclass(frozen=True, kw_only=True)
class Agreement(Who, InSpace, Where):
    """Measure how far rates at the search's settings lie from contact resolved and from MuJoCo C.

    The terrains are hard-random ones and elites, drawn at random and not by their rates. Robots cross them twice at the
    search's settings (steps of 5 ms), from two sets of starts. From the second starts they cross them also with contact
    resolved (steps of 1 ms, a time constant of 3 ms), and some of them in plain MuJoCo C at both settings. The bias is
    the mean rate of the first crossings minus that of the others.

    Crossings are kept, so the same command goes on after a stop.
    """

    run: Path | None = None
    """Run whose elites are drawn; the robot's published archive if left out, else its newest run under runs/."""
    terrains: int = setting(300, least=0)
    """Hard-random terrains."""
    elites: int = setting(150, least=0)
    """Elites, drawn at random; all if there are fewer."""
    genes: Path | None = None
    """Terrains to cross in place of both: an archive.npz, or any .npz with genes (num_terrains, 64)."""
    elite: str | None = None
    """Which of --genes: one number, several as in --elite "97 124", or all; all if left out."""
    episodes: int = setting(40, least=1)
    """Episodes a terrain in each set."""
    mujoco_c: int = setting(40, least=0)
    """Terrains of each kind to cross in plain MuJoCo C too, which always runs on the CPU."""
    seed: int = setting(0, least=0)
    """Draws terrains, elites and starts."""
    out: Path | None = None
    """File to write; runs/agreement/<robot>.json if left out."""

    def execute(self, *, open_evaluator: "Open" = open_evaluator) -> dict[str, Any]:
        """Crosses the terrains and publishes the comparison.

        Args:
            open_evaluator: Opens what crosses the terrains.

        Raises:
            FileNotFoundError: If there is no run.
            ValueError: If a flag's value cannot be used.
            AllInvalidError: If no episode is valid.
            Interrupted: On Ctrl-C; what was crossed is kept.
            EvaluatorError: If a worker is lost; likewise.
        """
        from sim.files.records import identity

        check(self)
        terrains = drawn(self)
        evaluator = _evaluator_of(self, terrains)
        out = self.out or RUNS / "agreement" / f"{terrains.robot.name}.json"
        digest = hashlib.sha256(terrains.genes.tobytes()).hexdigest()
        kept = Kept.beside(out, evaluator, [self.seed, digest])

        def measure() -> dict[str, Any]:
            print(_plan(self, terrains, evaluator), flush=True)
            crossings = Crossings(terrains, evaluator, kept)
            with naming_what_is_next(kept.state, lambda: "The same command goes on."):
                crossings.cross(open_evaluator)
            return {
                **origin_of(evaluator.device, self.seed, self.workers),
                **identity(terrains.robot, terrains.policy),
                "source": terrains.source and without_machine(terrains.source),
                "episodes": self.episodes,
                **report_of(terrains, crossings.outcome, self.seed),
            }

        report = publish(out, measure, _show)
        kept.remove()
        return report


@dataclass(frozen=True, kw_only=True)
class TerrainSet:
    """Terrains that are compared together."""

    number: list[int]
    """Where each stands among the hard-random ones, in its archive, or in its file."""
    genes: NDArray[np.float32]
    """Shape (num_terrains, num_genes)."""

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Which terrains are crossed, and by whom."""

    robot: "RobotCfg"
    policy: str
    """Controller, as :func:`sim.policy.loaders.load_policy` takes it."""
    space: "TerrainSpace"
    source: str | None
    """Run of the elites, or file of the named terrains; None if all are hard-random."""
    sets: dict[str, TerrainSet]
    """``hard_random`` and ``elites``, or ``named``."""
    seed: int
    """Draws the starts."""
    mujoco_c: int
    """So many of each set, the first, are crossed in MuJoCo C too."""

    @property
    def genes(self) -> NDArray[np.float32]:
        """Of all sets, one after the other, shape (num_terrains, num_genes)."""
        return np.concatenate([terrains.genes for terrains in self.sets.values()])

    @property
    def in_mujoco_c(self) -> NDArray[np.bool_]:
        """Which of them are crossed in MuJoCo C too, shape (num_terrains,)."""
        return np.concatenate([np.arange(len(terrains)) < self.mujoco_c for terrains in self.sets.values()])

    def seeds(self, way: str) -> NDArray[np.uint32]:
        """Seeds of the starts of all terrains, shape (num_terrains,): ``search`` has the first, all others the second.

        Args:
            way: As of :attr:`Crossings.outcome`.
        """
        sequence = np.random.SeedSequence([_KEY, self.seed], spawn_key=(_FIRST if way == "search" else _SECOND,))
        return sequence.generate_state(len(self.genes), np.uint32).astype(np.uint32)

    def rows(self, name: str) -> slice:
        """Where the terrains of a set stand among all."""
        names = list(self.sets)
        first = sum(len(self.sets[other]) for other in names[: names.index(name)])
        return slice(first, first + len(self.sets[name]))


def drawn(cfg: Agreement) -> Drawn:
    """The terrains that a command line asks for, and who crosses them.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If terrains, robot or controller are not available, or MuJoCo cannot read the robot.
    """
    from sim.mujoco_c.model import crossing_model, refuse_softness
    from sim.robots.robot import get_robot
    from sim.space import SUPER_GAUSSIAN, read_pool

    _refuse_contradictions(cfg)
    robot = get_robot(cfg.robot or "anymal")
    policy, space, source = cfg.policy or str(robot.policy_file), SUPER_GAUSSIAN, None
    sets: dict[str, TerrainSet] = {}
    if cfg.genes is not None:
        pool, space = read_pool(cfg.genes)
        source, number = str(cfg.genes), chosen_elites(cfg.elite or "all", len(pool), cfg.genes)
        sets["named"] = TerrainSet(number=number, genes=pool[number])
    elif cfg.elites:
        found = _archive(cfg, robot)
        robot, policy, source = found.robot, found.policy(cfg.policy), str(found.run)
        space, number = found.space, _rng(cfg, _ELITES).permutation(len(found.archive))
        number = number[: cfg.elites].tolist()
        sets["elites"] = TerrainSet(number=number, genes=found.archive.genes[number])
    if cfg.genes is None and cfg.terrains:
        genes = space.hard_random(cfg.terrains, _rng(cfg, _HARD_RANDOM))
        sets = {"hard_random": TerrainSet(number=list(range(len(genes))), genes=genes), **sets}
    if cfg.mujoco_c:
        try:
            crossing_model(robot, np.zeros((2, 2)))
            refuse_softness(space)
        except ValueError as error:
            raise ValueError(f"{error}, or leave MuJoCo C out with --mujoco-c 0") from None
    return Drawn(
        robot=robot, policy=policy, space=space, source=source, sets=sets, seed=cfg.seed, mujoco_c=cfg.mujoco_c
    )


def _refuse_contradictions(cfg: Agreement) -> None:
    if cfg.genes is None and cfg.elite is not None:
        raise ValueError(f"--elite {cfg.elite!r} names terrains of a file: give the file too (--genes)")
    if cfg.run is not None and (cfg.genes is not None or not cfg.elites):
        other = "--elites 0" if cfg.genes is None else f"--genes {cfg.genes}"
        raise ValueError(f"--run {cfg.run} is for its elites, got {other} too: leave one of the two out")
    if cfg.genes is None and not cfg.terrains and not cfg.elites:
        raise ValueError("there must be terrains to cross, got none: give --terrains, --elites or --genes")


def _rng(cfg: Agreement, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([_KEY, cfg.seed], spawn_key=(stream,)))


def _archive(cfg: Agreement, robot: "RobotCfg") -> "Found":
    """The run whose elites are drawn.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is of another robot, or empty.
    """
    from qd.show.elites import find_archive

    try:
        found = find_archive(cfg.robot, cfg.run or published_or_newest(robot, cfg.policy), cfg.policy, space=cfg.space)
    except FileNotFoundError as error:
        if cfg.run is not None:
            raise
        raise FileNotFoundError(f"{error}; --elites 0 crosses hard-random terrains alone") from None
    if not len(found.archive):
        raise ValueError(f"{found.run} has no elites: {found.go_on}, or leave elites out with --elites 0")
    if len(found.archive) < cfg.elites:
        print(f"{found.run} has {len(found.archive)} elites: all of them are crossed.", flush=True)
    return found


def _evaluator_of(cfg: Agreement, drawn: Drawn) -> EvaluatorCfg:
    """What crosses the terrains at the search's settings, with a controller that was tried.

    Raises:
        ValueError: If device or workers are not available, or the controller does not fit the robot.
    """
    device = resolve_device(cfg.device, cfg.workers)
    check_policy(drawn.policy, drawn.robot, device)
    return EvaluatorCfg(
        robot=drawn.robot,
        policy=drawn.policy,
        num_terrains=min(len(drawn.genes), _MOST_AT_ONCE[device.partition(":")[0]]),
        num_replicas=cfg.episodes,
        device=device,
        workers=cfg.workers,
        num_envs=cfg.num_envs,
        space=drawn.space.name,
    )


def _plan(cfg: Agreement, drawn: Drawn, evaluator: EvaluatorCfg) -> str:
    """What is about to be done, in words."""
    sets = " and ".join(f"{len(terrains)} {_NAMES[name]}" for name, terrains in drawn.sets.items())
    source = f" of {drawn.source}" if drawn.source else ""
    return (
        f"Crossing {sets}{source}, {cfg.episodes} episodes each: twice at the search's settings and once with contact "
        f"resolved on {evaluator.device}; {drawn.in_mujoco_c.sum()} of them at both in MuJoCo C."
    )


class Crossings:
    """Crossings of the terrains in every way, as far as they are done.

    Args:
        drawn: What to cross.
        evaluator: What crosses at the search's settings.
        kept: What was crossed before.

    Attributes:
        outcome: :class:`kernels.episode.Outcome` of each episode by the way it was crossed, shape (num_terrains,
            num_episodes); an episode that is not crossed, or not yet, is RUNNING. The ways are ``search`` from the
            first starts, and from the second ``again``, ``resolved``, ``mujoco_c`` and ``mujoco_c_resolved``.
    """

    def __init__(self, drawn: Drawn, evaluator: EvaluatorCfg, kept: Kept) -> None:
        self._drawn, self._evaluator, self._kept = drawn, evaluator, kept
        shape = (len(drawn.genes), evaluator.num_replicas)
        before = {name: array for name, array in kept.read().items() if array.shape == shape}
        names = (*_TWICE, "resolved", *_PLAIN)
        self.outcome = {name: before.get(name, np.zeros(shape, np.uint8)) for name in names}
        if before:
            crossed = sum(np.count_nonzero(array) for array in before.values())
            print(f"{crossed:,} episodes are kept from before in {kept.file}.", flush=True)

    def cross(self, open_evaluator: "Open") -> None:
        """Crosses what is not crossed yet, and keeps it after each part.

        Raises:
            AllInvalidError: If no episode of the first part is valid.
            EvaluatorError: If a worker is lost.
            OSError: If a file cannot be written, or a process of MuJoCo C dies.
        """
        for names, resolved in ((_TWICE, False), (("resolved",), True)):
            if any(len(self._left(name)) for name in names):
                with open_evaluator(replace(self._evaluator, resolved=resolved)) as evaluate:
                    for name in names:
                        self._cross(name, evaluate)
        for name in _PLAIN:
            self._cross_plain(name, resolved=name != "mujoco_c")

    def _left(self, name: str) -> NDArray[np.intp]:
        """Terrains that are still to be crossed in a way."""
        left = self.outcome[name][:, 0] == 0
        return np.flatnonzero(left & self._drawn.in_mujoco_c if name in _PLAIN else left)

    def _cross(self, name: str, evaluate: "Evaluate") -> None:
        left, outcome, at_once = self._left(name), self.outcome[name], self._evaluator.num_terrains
        seeds = self._drawn.seeds(name)
        if len(left) == 0:
            return
        with share_bar(_BARS[name]) as progress:
            for first in range(0, len(left), at_once):
                rows = left[first : first + at_once]

                def show(share: float, done: int = first, part: int = len(rows)) -> None:
                    progress(min(1.0, (done + share * part) / len(left)))

                result = evaluate(self._drawn.genes[rows], seeds[rows], show)
                if not outcome.any():
                    refuse_all_invalid(result)
                outcome[rows] = result.outcome
                self._kept.write(**self.outcome)

    def _cross_plain(self, name: str, *, resolved: bool) -> None:
        from sim.bank import host_device
        from sim.mujoco_c.crossing import cross_terrains

        left, drawn = self._left(name), self._drawn
        if len(left) == 0:
            return

        def crossed(terrain: int, crossings: Any) -> None:
            self.outcome[name][left[terrain]] = crossings.outcome
            self._kept.write(**self.outcome)

        cross_terrains(
            drawn.robot,
            drawn.policy,
            drawn.genes[left],
            drawn.seeds(name)[left],
            space=drawn.space,
            num_episodes=self._evaluator.num_replicas,
            device=host_device(),
            processes=parse_workers(self._evaluator.workers).num_processes,
            resolved=resolved,
            crossed=crossed,
        )


def report_of(drawn: Drawn, outcome: dict[str, NDArray[np.uint8]], seed: int) -> dict[str, Any]:
    """The comparison in numbers.

    Args:
        drawn: What was crossed.
        outcome: As of :class:`Crossings`.
        seed: Draws the resamples of intervals.

    Returns:
        Of each set its comparisons with ``search`` (:func:`sim.rates.agreement`), with ``both_resolved``, contact
        resolved here against contact resolved in MuJoCo C, and the ``rates`` of each terrain; None of a set that was
        not crossed. ``failing`` elites by the first crossings, and how many of them fail again by the second ones, at
        the search's settings (``failing_again``) and with contact resolved (``failing_resolved``); None without
        elites. ``invalid_episodes`` of each way.
    """
    from kernels.episode import Outcome

    sets: dict[str, Any] = {name: None for name in ("hard_random", "elites")}
    for name in drawn.sets:
        own = {way: array[drawn.rows(name)] for way, array in outcome.items()}
        sets[name] = _compared(own, seed) | {"number": drawn.sets[name].number, "rates": _rates(own)}
    judged = next((name for name in ("elites", "named") if name in drawn.sets), None)
    failing = _failing({way: array[drawn.rows(judged)] for way, array in outcome.items()} if judged else None)
    invalid = {way: int((array == Outcome.INVALID).sum()) for way, array in outcome.items()}
    return {**sets, **failing, "invalid_episodes": invalid}


def _compared(outcome: dict[str, NDArray[np.uint8]], seed: int) -> dict[str, Any]:
    from sim.rates import agreement

    pairs = {way: ("search", way) for way in ("again", "resolved", *_PLAIN)}
    pairs["both_resolved"] = ("resolved", "mujoco_c_resolved")
    return {name: agreement(outcome[ours], outcome[theirs], seed) for name, (ours, theirs) in pairs.items()}


def _rates(outcome: dict[str, NDArray[np.uint8]]) -> dict[str, dict[str, list[float | None]]]:
    """Rates of each terrain by way and kind, None where there is no valid episode."""
    from sim.rates import KINDS, crossing_rates

    def listed(rates: NDArray[np.float64]) -> list[float | None]:
        return [None if np.isnan(rate) else round(rate, 6) for rate in rates.tolist()]

    return {way: {kind: listed(crossing_rates(array, kind)) for kind in KINDS} for way, array in outcome.items()}


def _failing(outcome: dict[str, NDArray[np.uint8]] | None) -> dict[str, int | None]:
    """Terrains that fail by the first crossings, and those of them that fail by others too; None without terrains."""
    from sim.rates import crossing_rates

    if outcome is None:
        return dict.fromkeys(("failing", "failing_again", "failing_resolved"))
    ways = ("search", "again", "resolved")
    first, *others = (crossing_rates(outcome[way], "goal") < FAILING_GOAL_RATE for way in ways)
    again, resolved = (int((first & other).sum()) for other in others)
    return {"failing": int(first.sum()), "failing_again": again, "failing_resolved": resolved}


def _show(report: dict[str, Any]) -> None:
    from sim.rates import KINDS

    print("Rates at the search's settings minus those of other crossings (95 % interval), and their mean distance:")
    for name, title in _NAMES.items():
        own = report.get(name)
        if own is None:
            continue
        for way, words in _WORDS.items():
            found = own[way]
            if not found["terrains"]:
                continue
            print(f"{title} ({found['terrains']}): {words}")
            for kind in KINDS:
                bias = value_words(found[f"{kind}_bias"], found[f"{kind}_bias_interval"], "+.3f")
                print(f"  {kind:<8} {bias}, {found[f'{kind}_difference']:.3f} apart")
    if report.get("named") is not None:
        _show_rows(report["named"])
    if report["failing"] is not None:
        title = _NAMES["elites" if report["elites"] else "named"]
        print(
            f"failing {title}: {report['failing']} in the first episodes; of these in other episodes "
            f"{report['failing_again']} at the same settings, {report['failing_resolved']} with contact resolved"
        )
    if any(report["invalid_episodes"].values()):
        print(f"invalid episodes, which are left out: {report['invalid_episodes']}")


def _show_rows(named: dict[str, Any]) -> None:
    """Prints the goal rates of each terrain."""
    rates = {way: kinds["goal"] for way, kinds in named["rates"].items()}
    print("goal rates" + "".join(f"{way:>19}" for way in rates))
    for row, number in enumerate(named["number"]):
        cells = (value_words(values[row], None, ".2f") for values in rates.values())
        print(f"{number:>10}" + "".join(f"{cell:>19}" for cell in cells))
