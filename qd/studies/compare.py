"""Does the search earn its cost? The comparison lets it and its baselines loose on the same number of terrains."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.archive import Archive
from qd.faults import fault_numbers
from qd.fitness import FITNESS_FLOOR
from qd.fresh import Open, Reevaluate, reevaluate_run
from qd.run.arguments import NOT_ON_RAY, certifier_settings, check_certifiers
from qd.run.directory import Metrics, RunDirectory, episodes_in
from qd.run.judge import Certify, Confirm, certifiers_of, certify_run, confirm_run
from qd.run.settings import SchedulerCfg, SearchCfg, as_settings, changed, differences, measured_now, preset
from qd.studies.study import StudyFlags, run_study, study_of
from qd.workers.evaluator import open_evaluator, parse_workers, resolve_device
from qd.workers.kept_open import kept_open
from sim.files.command import publish
from sim.files.intervals import MAX_T_VALUES, t_interval, value_words
from sim.files.records import identity
from sim.files.settings import check, setting
from sim.policy.spec import certifier_hash, controllers_of, named_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sim.robots.robot import RobotCfg

METHODS: dict[str, dict[str, Any]] = {
    "uniform_random": {"method": "uniform_random"},
    "hard_random": {"method": "hard_random"},
    "map_elites": {"method": "map_elites"},
    "cma_me": {"method": "cma_me"},
    "cma_mae": {"method": "cma_mae", "es": "cma_es"},
    "cma_mae_sep": {"method": "cma_mae", "es": "sep_cma_es"},
    "cma_mae_narrow": {"method": "cma_mae", "es": "cma_es", "sigma0": 0.5},
    "mixed": {"method": "cma_mae+map_elites", "es": "cma_es"},
    "surrogate": {"method": "surrogate"},
    "gated": {"method": "cma_mae+map_elites", "es": "cma_es"},
}
"""What is compared: changes of the search's settings. ``gated`` is ``mixed`` for certified failures."""
GATED = "gated"
LABELS = {
    "uniform_random": ("uniform random", "#999999", ":"),
    "hard_random": ("hard-random", "#000000", "--"),
    "map_elites": ("MAP-Elites (iso+line)", "#009e73", "-"),
    "cma_me": ("CMA-ME", "#56b4e9", "-."),
    "cma_mae": ("CMA-MAE", "#0072b2", "-"),
    "cma_mae_sep": ("CMA-MAE, sep-CMA", "#cc79a7", "--"),
    "cma_mae_narrow": ("CMA-MAE, first step .5", "#e69f00", ":"),
    "mixed": ("CMA-MAE and iso+line", "#d55e00", "-"),
    "surrogate": ("surrogate", "#882255", "-"),
    "gated": ("... for certified failures", "#d55e00", "--"),
}
"""Name, colour and line of each method in the figure."""
_OTHER_LOOKS = [
    (color, style)
    for style in ((0, (6, 2, 1, 2)), (0, (1, 3)), "-", "--")
    for color in ("#332288", "#aa4499", "#117733", "#ddaa33")
]
CURVES = ("qd_score", "reachable_coverage", "elites", "mean_fitness")
AGAIN = (
    "corrected_qd_score",
    "corrected_coverage",
    "corrected_elites",
    "corrected_mean_fitness",
    "reproduced",
    "failing",
    "mean_std",
)
"""What a row of metrics has more where all elites crossed fresh episodes."""
FAULTS = ("confirmed", "certified", "faults")
"""What a method has more where its elites were judged."""
_BATCH = ("batch_fitness", "batch_collision_rate", "batch_goal_rate")
_NAME = re.compile(r"[a-zA-Z0-9_+.,:=-]{1,200}")  # what a folder can be called, with a seed behind it


@dataclass(frozen=True, kw_only=True)
class Compare(StudyFlags):
    """Compare search methods on the same number of terrains, with several seeds each.

    Every search is an ordinary run in its own folder METHOD-SEED. State is saved after every iteration: stop with
    Ctrl-C whenever you like, and the same command goes on. mixed:emitters=80,groups=8 is a wider search: it has eight
    times as many terrains in an iteration, and an eighth of the iterations.
    """

    methods: tuple[str, ...] = tuple(name for name in METHODS if name != GATED)
    """Which methods: uniform_random, hard_random, map_elites, cma_me, cma_mae, cma_mae_sep, cma_mae_narrow (first step
    size .5), mixed (cma_mae+map_elites), surrogate (elites varied as networks advise, the default of a search), gated
    (mixed, for failures that others can cross); all but the last. Settings of the search after a colon make another one
    of it: cma_mae:restart-rule=20,learning-rate=0.3. Of NAME@1 only the first seed is run."""
    certified_by: tuple[str, ...] = ()
    """Certifiers of the method gated, FILE or NAME=FILE. This method ends after as many episodes as the others. The
    certifiers' episodes count too, so it has fewer iterations."""
    certify_episodes: int = setting(10, least=1)
    """Episodes of each of them on a terrain that the controller does not cross."""
    certify: bool = False
    """Confirm and certify the elites of every run afterwards, and count the faults."""
    by: tuple[str, ...] = ()
    """Certifiers for --certify, NAME=FILE; the robot's panel if left out, results/<robot>/panel/*.pt."""
    seeds: int = setting(3, least=1, most=MAX_T_VALUES)
    """Runs of each method, with seeds from --seed on."""
    seed: int = 0
    """The first seed."""
    iterations: int = 33
    """Iterations of a run of the preset's size. They set how many terrains every run has. A larger number later extends
    a comparison."""
    reevaluate_every: int = setting(11, least=1)
    """Every so many iterations, and at the end, all elites cross 40 fresh episodes."""

    def execute(self, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
        """Runs the searches that are not done and publishes the comparison.

        Args:
            open_evaluator: Opens what crosses the terrains.

        Raises:
            ValueError: If something asked for cannot be.
            Interrupted: On Ctrl-C; all iterations that ended are saved.
            EvaluatorError: If a worker is lost; likewise.
        """
        from sim.files.figures import as_png
        from sim.robots.robot import get_robot

        check(self)
        robot, device = get_robot(self.robot or "anymal"), resolve_device(self.device, self.workers)
        size = self.preset or ("paper" if device.startswith("cuda") else "small")
        asked = {name: getattr(self, name) for name in ("seed", "iterations", "reevaluate_every", "policy")}
        shared = measured_now(changed(preset(size, robot, self.policy), asked), robot)
        certifiers = controllers_of([named_file(text) for text in self.certified_by], robot, flag="certified-by")
        certifiers = certifiers if self.certified_by else {}
        methods = self._methods(shared, certifiers)
        check_certifiers(certifiers, shared, robot, device)
        judges = judges_of(self.by, shared, robot, device) if self.certify else {}
        seeds = {name: range(self.seed, self.seed + count) for name, count in self._asked().items()}
        runs = {f"{name}-{seed}": replace(methods[name], seed=seed) for name in methods for seed in seeds[name]}
        study = study_of(self, "compare", runs, robot, device, sampled=False, certifiers=certifiers)

        def measure() -> dict[str, Any]:
            found, origin = run_study(study, open_evaluator)
            metrics = {name: [found[f"{name}-{seed}"] for seed in seeds[name]] for name in methods}
            report = report_of(metrics, {name: as_settings(cfg)["scheduler"] for name, cfg in methods.items()})
            counts = self._judged(study.path, list(runs), robot.spec, judges, open_evaluator) if self.certify else {}
            for name in methods if self.certify else ():
                own = [counts[f"{name}-{seed}"] for seed in seeds[name]]
                report["methods"][name] |= in_the_end({key: _over_seeds([one[key] for one in own]) for key in FAULTS})
            return {
                **origin,
                **identity(robot, study.evaluator.policy),
                "preset": size,
                "seeds": list(range(self.seed, self.seed + self.seeds)),
                "iterations": self.iterations,
                "reachable_cells": shared.cells.num_cells,
                "qd_score_offset": -FITNESS_FLOOR,
                "certified_by": dict(zip(certifiers, certifier_settings(certifiers)["certifier_sha256"], strict=True)),
                "panel": list(judges),
                "judged_by": self._judged_by(study.path / next(iter(runs))) if self.certify else None,
                **report,
            }

        return publish(study.out, measure, show, draw=lambda report: as_png(draw_comparison(report)))

    def _judged(
        self, path: Path, names: Sequence[str], robot: str, judges: dict[str, str], open_evaluator: Open
    ) -> dict[str, dict[str, Any]]:
        """What the elites of runs are in fresh episodes, with contact resolved and to the judges, by name of the run.

        What is there is kept. One step after the other, so that all runs are crossed by the same simulations.
        """
        shared = {"robot": robot, "device": self.device, "workers": self.workers, "num_envs": self.num_envs}
        by, found = tuple(f"{name}={policy}" for name, policy in judges.items()), {}
        with kept_open(open_evaluator) as opened:
            for name in names:
                if RunDirectory(path / name).fresh_archive() is None:
                    again = Reevaluate(policy=self.policy, run=path / name, **shared)
                    reevaluate_run(again, open_evaluator=opened)
            for name in names:
                confirm_run(Confirm(policy=self.policy, run=path / name, **shared), open_evaluator=opened)
            for name in names:
                archive = certify_run(Certify(by=by, run=path / name, **shared), open_evaluator=opened)
                found[name] = fault_numbers(judged_by(archive, judges))
        return found

    @staticmethod
    def _judged_by(run: Path) -> dict[str, Any]:
        """Where, when and by which commit a run was judged: it may be another machine than searched."""
        judged = RunDirectory(run).read_summary()["confirmed_by"]
        return {name: judged[name] for name in ("commit", "device", "versions", "date")}

    def _methods(self, shared: SearchCfg, certifiers: dict[str, str]) -> dict[str, SearchCfg]:
        """Settings of each method: different searches on the same number of terrains, or of episodes.

        Args:
            shared: What they have in common.
            certifiers: Those of the method gated.

        Raises:
            ValueError: If they are not, or a name cannot be that of a folder.
        """
        asked = self._asked()
        unknown = [name for name in asked if name.split(":")[0] not in METHODS]
        if unknown or not asked or len(asked) < len(self.methods):
            raise ValueError(f"methods must be some of {', '.join(METHODS)}, each once, got {', '.join(self.methods)}")
        gated = [name for name in asked if name.split(":")[0] == GATED]
        if bool(gated) != bool(certifiers):
            raise ValueError(
                f"methods: {GATED} and --certified-by need each other, got {', '.join(self.methods)} with "
                f"{', '.join(certifiers) or 'no certifier'}"
            )
        if gated and parse_workers(self.workers).on_ray:
            raise ValueError(f"methods: {NOT_ON_RAY}, got --workers {self.workers}")
        found: dict[str, SearchCfg] = {}
        for name in asked:
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"methods: a name must be up to 200 letters, digits and _+-.,:= without spaces, got {name!r}"
                )
            cfg = _resized(changed(shared, changes_of(name)), shared, name)
            if name in gated:
                cfg = replace(cfg, **certifier_settings(certifiers), certify_episodes=self.certify_episodes)
            for other, there in found.items():
                if there.iterations == cfg.iterations and not differences(as_settings(there), as_settings(cfg)):
                    raise ValueError(f"methods: {other} and {name} are the same search: leave one of them out")
            found[name] = cfg
        return found

    def _asked(self) -> dict[str, int]:
        """How many seeds of each method.

        Raises:
            ValueError: If a number behind an @ is none.
        """
        found = {}
        for text in self.methods:
            name, at, count = text.partition("@")
            if at and not (count.isdecimal() and 1 <= int(count) <= self.seeds):
                raise ValueError(
                    f"methods: behind @ there must be a number of seeds from 1 to {self.seeds}, got {text}"
                )
            found[name] = int(count) if at else self.seeds
        return found


def judged_by(archive: Archive, judges: Mapping[str, str]) -> Archive:
    """An archive with the certificates of these controllers alone; earlier calls may have asked others of some runs."""
    asked = {certifier_hash(*one) for one in judges.items()}
    return archive if archive.faults is None else replace(archive, faults=archive.faults.of_certifiers(asked))


def _resized(cfg: SearchCfg, shared: SearchCfg, name: str) -> SearchCfg:
    """A search with as many iterations as make the same number of terrains as the others have.

    Raises:
        ValueError: If no whole number of them does.
    """
    terrains, own = shared.iterations * shared.scheduler.num_terrains, cfg.scheduler.num_terrains
    if terrains % own:
        raise ValueError(
            f"methods: iterations of {name} must make up the {terrains:,} terrains of the others, got {own:,} terrains "
            "an iteration: change emitters, batch-size or --iterations"
        )
    every = max(1, shared.reevaluate_every * shared.scheduler.num_terrains // own)
    return replace(cfg, iterations=terrains // own, reevaluate_every=every)


def changes_of(method: str) -> dict[str, Any]:
    """Changes of the search's settings that a method is, those after its colon included.

    Raises:
        ValueError: If a setting is unknown, given twice, or of another type.
    """
    name, colon, given = method.partition(":")
    found, seen = dict(METHODS[name]), set()
    kinds = {field.name: type(field.default) for field in fields(SchedulerCfg)}
    for item in given.split(",") if colon else ():
        key, _, value = item.partition("=")
        key = key.replace("-", "_")
        if key not in kinds:
            raise ValueError(f"methods: no setting named {key} in {method}: expected some of {', '.join(kinds)}")
        if key in seen:
            raise ValueError(f"methods: {key} is given twice in {method}")
        seen.add(key)
        try:
            found[key] = kinds[key](value)
        except ValueError:
            raise ValueError(f"methods: {key} must be {kinds[key].__name__}, got '{value}' in {method}") from None
    return found


def judges_of(by: Sequence[str], cfg: SearchCfg, robot: "RobotCfg", device: str) -> dict[str, str]:
    """Controllers that certify afterwards, by name: those given, or the robot's panel.

    Raises:
        ValueError: If there is none, or one cannot be used (:func:`qd.run.arguments.check_certifiers`).
    """
    found = certifiers_of(tuple(by), cfg, robot, device)
    certifier_settings(found)
    return found


def report_of(runs: dict[str, list[Metrics]], settings: dict[str, Any]) -> dict[str, Any]:
    """The numbers of a comparison.

    Args:
        runs: Metrics of every seed, by method. Searches that have spent their episodes earlier than other seeds stay
            where they ended.
        settings: Settings of each method's scheduler.

    Returns:
        ``methods``: of each its settings, how many seeds and episodes of one seed it had, and what it has in the end,
        found (``CURVES``), corrected (``AGAIN``) and judged (``FAULTS``), each as the mean over seeds beside its 95 % t
        interval, None if not counted; ``curves``: the same on the way there, as points of mean, interval and seeds, at
        ``terrains`` and ``episodes`` of one seed, cumulative, those of ``AGAIN`` at ``corrected_at`` terrains; what its
        terrains did to the robots on average; iterations of each seed, and sums over seeds.
    """
    return {"methods": {name: _numbers_of_method(seeds, settings[name]) for name, seeds in runs.items()}}


def _numbers_of_method(ended: list[Metrics], settings: Any) -> dict[str, Any]:
    longest = max(ended, key=len)
    seeds = [rows + rows[-1:] * (len(longest) - len(rows)) for rows in ended]
    terrains = np.cumsum([row["terrains"] for row in longest])
    spent = np.zeros((len(ended), len(longest)))
    for own, rows in zip(spent, ended, strict=True):
        own[: len(rows)] = [episodes_in(row) for row in rows]
    episodes = spent.cumsum(axis=1).mean(axis=0)
    # The last iteration of a comparison that was stopped in it and then extended has them in some runs only.
    at = [k for k in range(len(longest)) if all("corrected_qd_score" in rows[k] for rows in seeds)]
    curves = {
        "terrains": terrains.tolist(),
        "episodes": episodes.tolist(),
        "corrected_at": terrains[at].tolist(),
        **{key: [_over_seeds([rows[k][key] for rows in seeds]) for k in range(len(longest))] for key in CURVES},
        **{key: [_over_seeds([rows[k].get(key) for rows in seeds]) for k in at] for key in AGAIN},
    }
    counted = (*CURVES, *AGAIN) if len(longest) - 1 in at else CURVES
    every = [row for rows in ended for row in rows]
    return {
        "settings": settings,
        "seeds": len(ended),
        "episodes": float(episodes[-1]),
        **in_the_end({key: curves[key][-1] if key in counted else None for key in (*CURVES, *AGAIN)}),
        **in_the_end(dict.fromkeys(FAULTS)),
        "curves": curves,
        **{key: _over_seeds([float(np.mean([row[key] for row in rows])) for rows in ended]) for key in _BATCH},
        "iterations": [len(rows) for rows in ended],
        **{key: sum(row.get(key, 0) for row in every) for key in ("certifier_episodes", "invalid_episodes", "wall_s")},
    }


def in_the_end(points: Mapping[str, dict[str, Any] | None]) -> dict[str, Any]:
    """Numbers of a method, each with its interval beside it; None where nothing was counted.

    Args:
        points: Mean and interval over seeds, by what they are of.
    """
    found = {}
    for name, point in points.items():
        found[name], found[f"{name}_interval"] = (point["mean"], point["interval"]) if point else (None, None)
    return found


def _over_seeds(values: Sequence[float | None]) -> dict[str, Any]:
    """Mean over seeds and its interval; None where a seed has no value, or there is one seed only."""
    if any(value is None for value in values):
        return {"mean": None, "interval": None, "seeds": list(values)}
    numbers = np.asarray(values, dtype=float)
    return {"mean": float(numbers.mean()), "interval": t_interval(numbers), "seeds": numbers.tolist()}


def draw_comparison(report: dict[str, Any]) -> "Figure":
    """Elites, corrected elites and failing elites over the episodes of one seed; bands are 95 % t intervals.

    Args:
        report: As of :func:`report_of`, with ``robot`` and ``seeds``.
    """
    from sim.files.figures import new_figure

    columns = 2 if any(len(name) > 30 for name in report["methods"]) else 4  # names with settings are long
    legend_rows = -(-len(report["methods"]) // columns)
    figure, seeds = new_figure(12.0, 4.4 + 0.2 * legend_rows), len(report["seeds"])
    most = max(method["episodes"] for method in report["methods"].values())
    figure.suptitle(
        f"{report['robot']}: {most:,.0f} episodes a run, "
        + (f"{seeds} seeds a method at most, mean and 95 % interval over them" if seeds > 1 else "one seed")
    )
    panels = (
        ("elites", "elites, as found"),
        ("corrected_elites", "elites, corrected by fresh episodes"),
        ("failing", "elites that the controller fails in fresh episodes"),
    )
    lines: dict[str, Any] = {}
    for axes, (key, label) in zip(figure.subplots(1, 3), panels, strict=True):
        others = iter(_OTHER_LOOKS * len(report["methods"]))
        for name, method in report["methods"].items():
            title, color, style = LABELS.get(name) or (name.replace(":", ": "), *next(others))
            curves = method["curves"]
            spent = dict(zip(curves["terrains"], curves["episodes"], strict=True))
            along = curves["corrected_at" if key in AGAIN else "terrains"]
            points = [(spent[at], point) for at, point in zip(along, curves[key], strict=True)]
            points = [(at, point) for at, point in points if point["mean"] is not None]
            x = [at for at, _ in points]
            mean = [point["mean"] for _, point in points]
            marker = "o" if key in AGAIN else ""
            lines[title] = axes.plot(x, mean, color=color, linestyle=style, marker=marker, markersize=4)[0]
            bounds = [point["interval"] or (math.nan, math.nan) for _, point in points]
            low, high = ([bound[side] for bound in bounds] for side in (0, 1))
            axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
            if key in AGAIN:  # a band has no width where there is one point
                axes.vlines(x, low, high, color=color, alpha=0.5)
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:,g}")
        axes.set_xlabel("thousands of episodes of one seed")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.legend(list(lines.values()), list(lines), loc="outside lower center", ncols=columns, frameon=False)
    return figure


_COLUMNS = ("elites", "corrected_elites", "failing", "faults")


def show(report: dict[str, Any]) -> None:
    """Prints what each method has found in the end, the one with the most failing elites first."""
    methods = report["methods"]
    ranked = sorted(methods, key=lambda name: [-(methods[name][key] or 0.0) for key in ("failing", "elites")])
    width = max(map(len, methods))
    heads = "".join(f"{name.replace('_', ' '):>20}" for name in _COLUMNS)
    print("\nmeans with 95 % intervals over seeds; failing and corrected by fresh episodes, - where not counted")
    print(f"  {'':<{width}}  seeds{'episodes':>12}{heads}")
    for name in ranked:
        method = methods[name]
        cells = "".join(f"{value_words(method[key], method[f'{key}_interval'], '.0f'):>20}" for key in _COLUMNS)
        print(f"  {name:<{width}}  {method['seeds']:>5}{method['episodes']:>12,.0f}{cells}")
