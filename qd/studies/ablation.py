"""What the fitness gains by subtracting standard deviations: the paper's ablation, alpha 1 against alpha 0."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.fresh import FRESH_EPISODES, Open
from qd.run.directory import Metrics, RunDirectory
from qd.run.settings import (
    SearchCfg,
    as_settings,
    changed,
    measured_now,
    moved_policy,
    preset,
    refuse_changes,
    refuse_unnamed_code,
    resumed,
)
from qd.studies.study import LOOKS, StudyFlags, run_study, study_of
from qd.workers.evaluator import open_evaluator, resolve_device
from sim.files.command import publish
from sim.files.intervals import value_words
from sim.files.records import identity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sim.robots.robot import RobotCfg

_ALPHAS = {"alpha_1": 1.0, "alpha_0": 0.0}
# Iterations, and after how many of them elites cross fresh episodes; of wide as many terrains as of paper.
_DEFAULTS = {"wide": (18, 6), "paper": (150, 50), "small": (6, 2)}


@dataclass(frozen=True, kw_only=True)
class Ablation(StudyFlags):
    """Search with and without the standard deviations in the fitness, and compare how repeatable the elites are.

    Every few iterations up to 200 elites of each search cross 40 fresh episodes. The command compares the means of
    their standard deviations. Both searches are ordinary runs, alpha_1 and alpha_0 in the study's folder. State is
    saved after every iteration, and the same command goes on.
    """

    run: Path | None = None
    """A run with alpha 1 whose first iterations are taken, with its preset and seed; left out, one is made too."""
    iterations: int | None = None
    """Iterations to compare; 18 of preset wide, 150 of paper, 6 of small."""
    seed: int | None = None
    """Seed of the searches; that of --run, or 0."""

    def execute(self, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
        """Runs the searches that are not done and publishes what they show.

        Args:
            open_evaluator: Opens what crosses the terrains.

        Raises:
            FileNotFoundError: If --run is no run.
            ValueError: If the searches cannot be compared, or something asked for cannot be.
            Interrupted: On Ctrl-C; all iterations that ended are saved.
            EvaluatorError: If a worker is lost; likewise.
        """
        from sim.files.figures import as_png
        from sim.robots.robot import get_robot, robot_of

        device, moved, names = resolve_device(self.device, self.workers), None, list(_ALPHAS)
        if self.run is None:
            robot = get_robot(self.robot or "anymal")
            base = self._begun(robot, device)
        else:
            there = RunDirectory(self.run).read_cfg()
            robot = robot_of(as_settings(there), self.robot, self.run)
            moved = moved_policy(there, self.policy)
            base, names = self._of_run(self.run, there, robot, moved), ["alpha_0"]
        if base.iterations < base.reevaluate_every:
            raise ValueError(
                f"no iteration up to {base.iterations} at which elites cross fresh episodes, which is every "
                f"{base.reevaluate_every}: give at least {base.reevaluate_every} --iterations"
            )
        runs = {name: changed(base, {"alpha": _ALPHAS[name]}) for name in names}
        study = study_of(self, "ablation", runs, robot, device, sampled=True, moved=moved)

        def measure() -> dict[str, Any]:
            metrics, origin = run_study(study, open_evaluator)
            if self.run is not None:
                metrics["alpha_1"] = RunDirectory(self.run).read_metrics()
            numbers = numbers_of(metrics, base.iterations)
            return {**origin, **identity(robot, study.evaluator.policy), "preset": base.preset, **numbers}

        return publish(study.out, measure, _show, draw=lambda report: as_png(draw_ablation(report)))

    def _begun(self, robot: "RobotCfg", device: str) -> SearchCfg:
        """Settings of searches from the start."""
        size = self.preset or ("paper" if device.startswith("cuda") else "small")
        cfg = preset(size, robot, self.policy)
        iterations, every = _DEFAULTS[size]
        asked = {"iterations": self.iterations or iterations, "seed": self.seed, "policy": self.policy}
        return measured_now(changed(cfg, {**asked, "reevaluate_every": every}), robot)

    def _of_run(self, path: Path, there: SearchCfg, robot: "RobotCfg", moved: str | None) -> SearchCfg:
        """Settings of a run with alpha 1.

        Raises:
            ValueError: If it is another run than the one asked for, its elites never crossed fresh episodes, or its
                robot or controller has changed since.
        """
        if there.reevaluate_every == 0:
            raise ValueError(f"{path} has no fresh episodes of its elites (reevaluate_every 0): give another --run")
        refuse_unnamed_code(there.policy, self.policy, path)
        asked = {"preset": self.preset, "seed": self.seed, "policy": self.policy, "alpha": _ALPHAS["alpha_1"]}
        iterations = self.iterations or _DEFAULTS[there.preset][0]
        now = resumed(path, there, robot, {**asked, "iterations": iterations}, moved)
        refuse_changes(path, "run", as_settings(there), as_settings(now))
        return now


def numbers_of(metrics: dict[str, Metrics], iterations: int) -> dict[str, Any]:
    """The ablation in numbers.

    Args:
        metrics: Rows of the searches, by name.
        iterations: Up to which they are compared.

    Returns:
        ``iterations`` at which elites of all crossed fresh episodes; by name the ``mean_std``, their ``intervals``
        (95 %, bootstrap over elites), ``elites`` and ``mean_fitness`` there; and ``below_by_more_than_intervals``:
        whether, of each, the interval with alpha 1 ends before that with alpha 0 begins.

    Raises:
        ValueError: If there is no such iteration.
    """
    looks = {
        name: {
            row["iteration"]: row for row in rows if row.get("mean_std") is not None and row["iteration"] <= iterations
        }
        for name, rows in metrics.items()
    }
    at = sorted(set.intersection(*(set(found) for found in looks.values())))
    if not at:
        raise ValueError(f"no iteration up to {iterations} at which elites of all searches crossed fresh episodes")
    rows = {name: [found[iteration] for iteration in at] for name, found in looks.items()}
    intervals = {name: [row["mean_std_interval"] for row in own] for name, own in rows.items()}
    return {
        "iterations": at,
        "mean_std": {name: [row["mean_std"] for row in own] for name, own in rows.items()},
        "intervals": intervals,
        "elites": {name: [row["elites"] for row in own] for name, own in rows.items()},
        "mean_fitness": {name: [row["mean_fitness"] for row in own] for name, own in rows.items()},
        "below_by_more_than_intervals": [
            bool(one and other and one[1] < other[0])
            for one, other in zip(intervals["alpha_1"], intervals["alpha_0"], strict=True)
        ],
    }


def _show(report: dict[str, Any]) -> None:
    print(f"\nmean STD of elites over {FRESH_EPISODES} fresh episodes, 95 % interval over elites")
    for k, iteration in enumerate(report["iterations"]):
        cells = []
        for name in _ALPHAS:
            mean = value_words(report["mean_std"][name][k], report["intervals"][name][k], ".2f")
            cells.append(f"{name.replace('_', ' ')}: {mean}")
        print(f"  iteration {iteration}: {', '.join(cells)}")


def draw_ablation(report: dict[str, Any]) -> "Figure":
    """Mean STD over the iterations with its intervals, and the number of elites (the paper's ablation figure)."""
    from sim.files.figures import bar_lengths, new_figure

    figure = new_figure(8.5, 3.6)
    figure.suptitle(f"{report['robot']}: the standard deviations in the fitness (alpha 1) and left out (alpha 0)")
    left, right = figure.subplots(1, 2)
    for name, (color, style) in zip(_ALPHAS, LOOKS, strict=False):
        means = report["mean_std"][name]
        lengths = bar_lengths(means, report["intervals"][name])
        marks = {"color": color, "linestyle": style, "marker": "o", "markersize": 4, "label": name.replace("_", " ")}
        left.errorbar(report["iterations"], means, lengths, capsize=3, **marks)
        right.plot(report["iterations"], report["elites"][name], **marks)
    left.set_ylabel(f"mean STD of elites\n({FRESH_EPISODES} fresh episodes)")
    right.set_ylabel("elites")
    for axes in (left, right):
        axes.set_xlabel("iteration")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    left.legend(frameon=False)
    return figure
