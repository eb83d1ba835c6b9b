"""The command that finds minimal terrains: which parts of a failing terrain, and how much of their height, it takes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from qd.archive import OUTCOMES, Archive
from qd.faults import Work, certify, confirm, fault_numbers, fault_words, judgement, known_names, rate_of
from qd.fresh import Open
from qd.groups import verdict_of
from qd.minimal import MOST_PARTS, Case, How, Minimal, Trial, fresh_counts, genes_of, goal_rate, minimise
from qd.run.arguments import evaluator_of
from qd.run.judge import certifiers_of, config_of, judged_run, searched_policy
from qd.run.minimal_file import MINIMAL_FILE, NUMBERS_FILE, Known, read_minimal, write_minimal
from qd.workers.evaluator import open_evaluator, origin_of, resolve_device
from sim.files.atomic import to_json, write_atomically
from sim.files.command import InSpace, Where, Who, command_line, naming_what_is_next
from sim.files.intervals import rate_words
from sim.files.records import identity

if TYPE_CHECKING:
    from qd.causes import Shape
    from sim.robots.robot import RobotCfg
    from sim.spaces.base import TerrainSpace

FIGURE_FILE = "minimal.png"

_MOST = {"cuda": 200, "cpu": 3}  # elites that are taken where none are named
_FIRST = ("fault", "confirmed", "certified", "failing")  # in this order
_LEAST_EFFECT = 1e-4  # a part that changes no height by more is none [m]


@dataclass(frozen=True, kw_only=True)
class Minimise(Who, InSpace, Where):
    """Find the smallest terrains on which the controller still fails. Which parts of an elite's terrain are needed?

    Robots cross subsets of a failing elite's parts, such as bumps, in 20 episodes each. A subset fails if under half of
    the robots reach the goal. A minimal terrain is a failing subset of which no smaller subset fails; 40 fresh episodes
    check it. Then its heights are scaled down together as long as it still fails. That is the margin. The cause is the
    part without which most robots arrive. Results are in minimal.json, minimal.npz and minimal.png of the run. Nothing
    is crossed twice, so the same command goes on after Ctrl-C. Results of several calls add up.
    """

    run: Path | None = None
    """Run directory; the newest of the robot under runs/."""
    elite: str | None = None
    """Numbers of failing elites: one, several as in --elite "0 3", or all that fail. If left out, 200 on a GPU and 3 on
    the CPU: faults first, then confirmed and certified ones, then others that fail."""
    how: Literal["exhaustive", "greedy"] | None = None
    """exhaustive: robots cross all subsets, from the smallest on, until one fails. greedy: parts are taken away one at
    a time as long as the rest fails. Where many parts are needed, that takes far fewer crossings. If left out,
    exhaustive on a GPU, and greedy on the CPU and for terrains of more than 10 parts."""
    confirm: bool = False
    """Cross the minimal terrains with contact resolved too, as `faultline confirm` does with elites."""
    certify: bool = False
    """Let the robot's panel cross the minimal terrains, as `faultline certify` does with elites."""
    by: tuple[str, ...] = ()
    """Let other controllers cross them instead: NAME=FILE, each as --policy takes it."""

    def execute(self) -> None:
        """Runs the command."""
        minimise_run(self)


@dataclass(frozen=True, kw_only=True)
class MinimalTerrains:
    """Failing elites that are taken apart, and what is known of them."""

    archive: Archive
    """With fresh values."""
    space: "TerrainSpace"
    """Of its genes."""
    half_width: float
    """Half the width of the robot's stance [m]."""
    cases: dict[int, Case]
    """By number of the elite; their counts grow."""

    @cached_property
    def _known(self) -> dict[int, tuple[int, Minimal | None]]:
        """By number of the elite, as of how many trials: every lot of crossings asks again about all of them."""
        return {}

    @cached_property
    def _entries(self) -> dict[int, dict[str, Any]]:
        return {}

    def minima(self) -> dict[int, Minimal]:
        """The minimal terrains that are known, by number of the elite."""
        found = {}
        for number, case in sorted(self.cases.items()):
            trials, minimal = self._known.get(number, (-1, None))
            if trials != len(case.counts):
                minimal = case.minimal()
                self._known[number] = len(case.counts), minimal
            if minimal is not None:
                found[number] = minimal
        return found

    def genes(self, number: int, minimal: Minimal, scale: float = 1.0) -> NDArray[np.float32]:
        """Genes of a minimal terrain, shape (num_genes,)."""
        return genes_of(self.archive, number, self.cases[number], Trial(minimal.parts, scale), self.space)

    def as_archive(self, known: Known | None = None) -> Archive:
        """The minimal terrains as elites whose fresh episodes are their own; of the rest only the names hold.

        Args:
            known: Whose fault counts are taken for terrains that are the same.
        """
        minima = self.minima()
        rows = self.archive.rows(np.array([*minima], dtype=np.int64))
        assert rows.fresh is not None
        counts = np.array([minimal.counts for minimal in minima.values()], np.int64).reshape(-1, len(OUTCOMES))
        invalid = counts[:, OUTCOMES.index("invalid")]
        genes = [self.genes(number, minimal) for number, minimal in minima.items()]
        fresh = replace(
            rows.fresh,
            goal_rate=np.array([goal_rate(row) for row in counts]),
            episodes=counts.sum(axis=1),
            invalid_episodes=invalid,
        )
        genes = np.array(genes, np.float32).reshape(len(minima), self.archive.genes.shape[1])
        return replace(rows, genes=genes, fresh=fresh, faults=None if known is None else known.faults_of(genes))

    def shapes(self, number: int, minimal: Minimal) -> dict[int, "Shape"]:
        """Shapes of the parts of a minimal terrain, by their numbers."""
        from qd.causes import effects_of  # with Warp: not for `--help`

        effects = effects_of(self.genes(number, minimal), minimal.parts, self.space)
        return {part: effects.shape(place, self.half_width) for place, part in enumerate(minimal.parts)}

    def margin(self, number: int, minimal: Minimal) -> tuple[float, float | None]:
        """Largest height or depth of a minimal terrain, and how far it moves to the least scale that fails [m]."""
        from sim.bank import heights_of  # with Warp: not for `--help`

        genes = [self.genes(number, minimal, scale) for scale in (1.0, minimal.scale or 1.0)]
        whole, scaled = heights_of(np.array(genes), self.space)
        moved = None if minimal.scale is None else round(float(np.abs(whole - scaled).max()), 4)
        return round(float(np.abs(whole).max()), 4), moved

    def entry(self, number: int, minimal: Minimal, judged: Archive, place: int) -> dict[str, Any]:
        """A minimal terrain as ``minimal.json`` has it.

        Args:
            number: Of the elite.
            minimal: The terrain.
            judged: The minimal terrains as elites, with fault counts where they were crossed for these.
            place: The terrain's among them.
        """
        if number not in self._entries:  # nothing more is crossed of a minimal terrain
            self._entries[number] = self._entry(number, minimal)
        return {**self._entries[number], "verdict": verdict_of(judged, place), **judgement(judged, place)}

    def _entry(self, number: int, minimal: Minimal) -> dict[str, Any]:
        """What does not change when others cross it."""
        words, case = self.space.parts(self.archive.genes[number]), self.cases[number]
        shapes, (height, margin) = self.shapes(number, minimal), self.margin(number, minimal)
        cause = minimal.cause({part: abs(shape.height_m) for part, shape in shapes.items()})
        return {
            "elite": number,
            "cell": int(self.archive.cell[number]),
            "iteration": int(self.archive.iteration[number]),
            "bumps": list(minimal.parts),
            "words": [words[part] for part in minimal.parts],
            "of": len(case.parts),
            "how": case.how,
            "subsets_crossed": minimal.subsets,
            **rate_of(minimal.counts),
            "without": {str(part): rate_of(counts)["goal_rate"] for part, counts in minimal.without.items()},
            "without_intervals": {
                str(part): rate_of(counts)["goal_interval"] for part, counts in minimal.without.items()
            },
            "cause": None if cause is None else {"bump": cause, **asdict(shapes[cause])},
            "scale": minimal.scale,
            "passing_scale": minimal.passing_scale,
            "height_m": height,
            "margin_m": margin,
            "scales": [{"scale": scale, **rate_of(counts)} for scale, counts in sorted(minimal.scales.items())],
        }

    def numbers(self, judged: Archive) -> dict[str, Any]:
        """All minimal terrains as ``minimal.json`` has them, and how many there are of each kind.

        Args:
            judged: As of :meth:`as_archive`.
        """
        minima = self.minima()
        entries = [self.entry(number, minima[number], judged, place) for place, number in enumerate(minima)]
        margins = [entry["margin_m"] for entry in entries if entry["margin_m"] is not None]
        counts = Counter(len(entry["bumps"]) for entry in entries)
        causes = Counter(entry["cause"]["kind"] for entry in entries if entry["cause"])
        return {
            "minimal": len(entries),
            "asked": len(self.cases),
            "bumps_histogram": {str(size): counts[size] for size in sorted(counts)},
            "bumps_median": _median([len(entry["bumps"]) for entry in entries]),
            "margin_m_median": _median(margins),
            "causes": dict(sorted(causes.items(), key=lambda one: (-one[1], one[0]))),
            **{name: fault_numbers(judged)[name] for name in ("confirmed", "certified", "faults", "panel")},
            "elites": entries,
        }


def minimise_run(args: Minimise, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """Finds minimal terrains of failing elites of a run, writes them, and says what they are.

    Args:
        args: Which run and elites, how, and where to work.
        open_evaluator: Opens what crosses terrains.

    Returns:
        The content of ``minimal.json``.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If the run is damaged or without fresh episodes, its robot or controller is another now, its
            terrains have no parts, or an argument is not as it must be.
        Interrupted: On Ctrl-C; lots that ended are kept.
        EvaluatorError: If a worker is lost; likewise.
    """
    from sim.spaces.registry import get_space  # with Warp: not for `--help`

    path, cfg, robot = config_of(args, args.run, args.space)
    policy = searched_policy(path, cfg, robot, args.policy, "minimised")
    device = resolve_device(args.device, args.workers)
    certifiers = certifiers_of(args.by, cfg, robot, device) if args.by or args.certify else {}
    evaluator = evaluator_of(cfg, robot, policy, device, args.workers, num_envs=args.num_envs)
    space = get_space(cfg.space, cfg.space_sha256)
    with judged_run(path, cfg, robot, args.elite or "all") as run:
        kind = device.partition(":")[0]
        chosen = run.chosen if args.elite else _first(run.archive, run.chosen, _MOST[kind])
        known = read_minimal(path, run.archive)
        hows: dict[int, How | None] = {**known.hows, **{n: args.how or known.hows.get(n) for n in chosen}}
        terrains = _terrains_of(run.archive, known, hows, space, robot.footprint[1], on_gpu=kind == "cuda")
        cases = terrains.cases
        origin = {**origin_of(device, cfg.seed, args.workers), **identity(robot, policy), "space": cfg.space}

        def save(judged: Archive | None = None) -> dict[str, Any]:
            judged = terrains.as_archive(known) if judged is None else judged
            scaled = {n: terrains.genes(n, one, one.scale or 1.0) for n, one in terrains.minima().items()}
            write_minimal(path, run.archive, cases, terrains.minima(), judged, scaled)
            numbers = {**origin, "space_sha256": cfg.space_sha256, **terrains.numbers(judged)}
            write_atomically(path / NUMBERS_FILE, to_json(numbers))
            return numbers

        with naming_what_is_next("what was crossed is kept", lambda: "The same command goes on"):
            own = {number: cases[number] for number in chosen}
            minimise(
                run.archive, own, space, evaluator=evaluator, open_evaluator=open_evaluator, seed=cfg.seed, save=save
            )
            judged = terrains.as_archive(known)
            work = Work(evaluator=evaluator, open_evaluator=open_evaluator, seed=cfg.seed, save=save)
            places = [place for place, number in enumerate(terrains.minima()) if number in chosen]
            if args.confirm:
                judged = confirm(judged, places, work)
            if certifiers:
                judged = certify(judged, places, known_names(judged, certifiers), work)
            numbers = save(judged)
            if numbers["elites"]:
                from qd.show.figures import save_figure
                from qd.show.minimal_figure import draw_minimal

                minimal_genes = {n: terrains.genes(n, one) for n, one in terrains.minima().items()}
                save_figure(path / FIGURE_FILE, draw_minimal(cfg.robot, numbers, minimal_genes, space))
    for line in minimal_words(numbers, judged):
        print(line)
    print(f"In {path / NUMBERS_FILE}, {path / MINIMAL_FILE} and {path / FIGURE_FILE}." if numbers["elites"] else "")
    if numbers["elites"] and not (args.confirm or certifiers):
        named = {"robot": robot.spec, "run": path, "elite": args.elite, "policy": cfg.policy, "confirm": True}
        print(f"Next, confirm them with contact resolved:  {command_line('minimise', **named)}")
    return numbers


def minimal_of_run(path: Path, archive: Archive, robot: "RobotCfg") -> tuple[dict[str, Any], Archive]:
    """The minimal terrains that a run has, if any.

    Args:
        path: The run directory.
        archive: Its elites.
        robot: Its robot.

    Returns:
        The numbers of ``minimal.json``, and the terrains as elites (:meth:`MinimalTerrains.as_archive`), in the same
        order.

    Raises:
        ValueError: If their file is damaged.
    """
    from sim.spaces.registry import get_space  # with Warp: not for `--help`

    known = read_minimal(path, archive)
    space = get_space(archive.space, archive.space_sha256)
    terrains = _terrains_of(archive, known, known.hows, space, robot.footprint[1], on_gpu=False)
    judged = terrains.as_archive(known)
    return terrains.numbers(judged), judged


def _terrains_of(
    archive: Archive, known: Known, hows: Mapping[int, How | None], space: "TerrainSpace", half_width: float, *,
    on_gpu: bool,
) -> MinimalTerrains:  # fmt: skip
    """Elites that are taken apart, with what was crossed of them before."""
    cases = {number: _case_of(archive, number, space, half_width, how, on_gpu) for number, how in hows.items()}
    for number, counts in known.counts.items():
        cases[number].counts.update(counts)
    return MinimalTerrains(archive=archive, space=space, half_width=half_width, cases=cases)


def _first(archive: Archive, chosen: Sequence[int], most: int) -> list[int]:
    """Some of the failing elites: faults first, then confirmed and certified ones, in the order of the archive."""
    return sorted(sorted(chosen, key=lambda number: (_FIRST.index(verdict_of(archive, number)), number))[:most])


def _case_of(
    archive: Archive, number: int, space: "TerrainSpace", half_width: float, how: How | None, on_gpu: bool
) -> Case:
    """An elite that is to be taken apart, of which nothing was crossed yet.

    Raises:
        ValueError: If its terrain has no parts, or too many for all subsets.
    """
    from qd.causes import effects_of  # with Warp: not for `--help`

    count = len(space.parts(archive.genes[number]))
    if not count:
        raise ValueError(
            f"terrains of the space {space.name} have no parts that can be taken away, expected some: give the space "
            "parts(genes) and without(genes, parts) (docs/own-space.md)"
        )
    effects = effects_of(archive.genes[number], range(count), space)
    parts = np.flatnonzero(effects.changes(_LEAST_EFFECT)).tolist()
    if how == "exhaustive" and len(parts) > MOST_PARTS:
        raise ValueError(
            f"elite {number} must have at most {MOST_PARTS} parts to cross all its subsets, got {len(parts)}: give "
            "--how greedy"
        )
    return Case(
        parts=tuple(sorted(parts, key=lambda part: (*effects.way(part, half_width), part))),
        how=how or ("exhaustive" if on_gpu and len(parts) <= MOST_PARTS else "greedy"),
        scalable=space.scaled(archive.genes[number][None], 0.5) is not None,
        flat=tuple(part for part in parts if np.abs(effects.heights[part]).max() <= _LEAST_EFFECT),
        counts={Trial(tuple(parts), fresh=True): fresh_counts(archive, number)},
    )


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def minimal_words(numbers: dict[str, Any], judged: Archive) -> list[str]:
    """Minimal terrains in sentences.

    Args:
        numbers: As of :meth:`MinimalTerrains.numbers`.
        judged: As of :meth:`MinimalTerrains.as_archive`.
    """
    entries, count = numbers["elites"], numbers["minimal"]
    if not entries:
        return ["No failing elite was taken apart."]
    told = [f"{_counted(count, 'minimal terrain')}, of as many failing elites:"]
    told += [f"  {_entry_words(entry)}" for entry in entries[:_SHOWN]]
    told += [f"  and {count - _SHOWN} more"] if count > _SHOWN else []
    sizes = ", ".join(f"{_counted(int(size), 'part')} in {many}" for size, many in numbers["bumps_histogram"].items())
    told.append(f"What a failure takes: {sizes}; median {numbers['bumps_median']:g}.")
    if numbers["margin_m_median"] is not None:
        margins = [100 * entry["margin_m"] for entry in entries if entry["margin_m"] is not None]
        told.append(
            "Margin, how far the ground can move toward flat ground and still fails: "
            f"{100 * numbers['margin_m_median']:.1f} cm (median), {min(margins):.1f} to {max(margins):.1f} cm."
        )
    if numbers["causes"]:
        told.append(f"Causes: {', '.join(f'{kind} {many}' for kind, many in numbers['causes'].items())}.")
    return told + fault_words(judged, what="minimal terrain")


_SHOWN = 10  # terrains that are told one by one


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'s' * (count != 1)}"


def _entry_words(entry: dict[str, Any]) -> str:
    parts, valid = entry["bumps"], entry["valid_episodes"]
    rate = rate_words(round(entry["goal_rate"] * valid), valid)
    text = (
        f"elite {entry['elite']}: {len(parts)} of {entry['of']} parts ({' '.join(map(str, parts)) or 'none'}), {rate}"
    )
    if entry["cause"] is not None:
        text += f"; cause: {entry['cause']['kind']} (part {entry['cause']['bump']})"
    if entry["scale"] is not None:
        passing = entry["passing_scale"]
        text += f"; heights at {entry['scale']:.0%} still fail"
        text += f", at {passing:.0%} the robot passes" if passing is not None else ", and at none below it passes"
        text += f": margin {100 * entry['margin_m']:.1f} cm"
    return text
