"""What the fitness gains by subtracting standard deviations: the paper's ablation, alpha 1 against alpha 0."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from qd.fresh import FRESH_EPISODES, Open
from qd.run.arguments import Arguments, job_of
from qd.run.cli import naming_what_is_next, run_command
from qd.run.directory import CONFIG_FILE, Metrics, RunDirectory, differences
from qd.run.settings import SearchCfg, as_settings, refuse_unnamed_code
from qd.search import run_search
from qd.show.figures import new_figure, save_figure
from qd.studies.beside import LOOKS, prepare_numbers
from qd.workers.evaluator import open_evaluator, origin_of, resolve_device
from sim.files.atomic import to_json, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAMES = {1.0: "alpha_1", 0.0: "alpha_0"}
_DEFAULTS = {"paper": (150, 50), "small": (6, 2)}  # iterations, and how often elites are looked at


@dataclass(frozen=True, kw_only=True)
class AblationCfg:
    """Search with and without the standard deviations in the fitness, and see how repeatable the elites are.

    Every so many iterations up to 200 elites of each search are drawn and crossed 40 times afresh; the mean of their
    standard deviations is compared. Stopped, the same command goes on.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    run: Path | None = None
    """A run with alpha 1 whose first iterations are taken; left out, one is made too."""
    preset: str | None = None
    """Size of the searches: paper or small; that of --run, or what the device can do."""
    iterations: int | None = None
    """Iterations to compare; 150 of preset paper, 6 of small."""
    seed: int | None = None
    """Seed of the searches; that of --run, or 0."""
    policy: str | None = None
    """Controller other than the shipped one."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    workers: int | Literal["auto"] | None = None
    """Ray workers, a GPU or CPU core each; auto: all there are."""
    run_dir: Path | None = None
    """Where the searches are kept; runs/<robot>-ablation."""
    out: Path | None = None
    """Where to write the numbers, with a figure beside them; ablation.json in that directory."""


def ablation(args: AblationCfg, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """The command; returns what it writes.

    Args:
        args: What to compare.
        open_evaluator: Opens what crosses the terrains.

    Raises:
        FileNotFoundError: If --run is no run.
        ValueError: If the searches cannot be compared, or something asked for cannot be.
        Interrupted: On Ctrl-C; all iterations that ended are saved.
        EvaluatorError: If a worker is lost; likewise.
    """
    from sim.robots.robot import get_robot

    name = get_robot(args.robot).name
    folder = args.run_dir or Path("runs") / f"{name}-ablation"
    out = args.out or folder / "ablation.json"
    device = resolve_device(args.device, args.workers)
    asked = _asked(args, "paper" if device.startswith("cuda") else "small")
    if args.out is not None:
        prepare_numbers(out)
    with naming_what_is_next("finished iterations are saved", lambda: "The same command goes on"):
        if args.run is None:
            _check_looks(asked)
            cfg = _search(asked, 1.0, folder, open_evaluator)
        else:
            cfg = _checked(RunDirectory(args.run).read_cfg(), args)
            asked = _of_run(cfg, asked, args)
            _check_looks(asked)
        other = _search(asked, 0.0, folder, open_evaluator)
    _check_alike(cfg, other)
    metrics = {
        "alpha_1": RunDirectory(args.run or folder / "alpha_1").read_metrics(),
        "alpha_0": RunDirectory(folder / "alpha_0").read_metrics(),
    }
    report = {**origin_of(device, other.seed, args.workers), "robot": name, "preset": other.preset}
    report |= numbers_of(metrics, asked["iterations"])
    _print(report)
    write_atomically(out, to_json(report))
    save_figure(out.with_suffix(".png"), draw_ablation(report))
    print(f"written to {out} and {out.with_suffix('.png')}")
    return report


def _asked(args: AblationCfg, preset: str) -> dict[str, Any]:
    """What the command line asks of a search, with what it leaves out."""
    name = args.preset or preset
    iterations, every = _DEFAULTS.get(name, (1, 1))  # an unknown preset is refused where it is looked up
    given = {key: getattr(args, key) for key in ("robot", "seed", "policy", "device", "workers")}
    return {**given, "preset": name, "iterations": args.iterations or iterations, "reevaluate_every": every}


def _check_looks(asked: dict[str, Any]) -> None:
    """Refuse searches at the end of which nothing could be compared."""
    iterations, every = asked["iterations"], asked["reevaluate_every"]
    if iterations < every:
        raise ValueError(
            f"no iteration up to {iterations} at which elites are looked at again, which is every {every}: give at "
            f"least {every} --iterations"
        )


def _checked(cfg: SearchCfg, args: AblationCfg) -> SearchCfg:
    """The settings of the run with alpha 1."""
    from sim.robots.robot import get_robot

    wrong = [
        f"{name} {there}, got {wanted}"
        for name, there, wanted in (
            ("robot", cfg.robot, get_robot(args.robot).name),
            ("preset", cfg.preset, args.preset or cfg.preset),
            ("seed", cfg.seed, cfg.seed if args.seed is None else args.seed),
            ("policy", cfg.policy, args.policy or cfg.policy),
            ("alpha 1; it has", cfg.fitness.alpha, 1.0),
        )
        if there != wanted
    ]
    if wrong:
        raise ValueError(f"{args.run} is a run of {'; '.join(wrong)}: leave that out, or give another --run")
    if cfg.reevaluate_every == 0:
        raise ValueError(f"{args.run} never looked at its elites again (reevaluate_every 0): give another --run")
    return cfg


def _of_run(cfg: SearchCfg, asked: dict[str, Any], args: AblationCfg) -> dict[str, Any]:
    """What to ask of a search for it to have a run's settings."""
    from sim.robots.robot import robot_of

    assert args.run is not None
    robot = robot_of(cfg.robot, args.robot, args.run)
    refuse_unnamed_code(cfg.policy, args.policy, args.run)

    parts = (cfg, cfg.scheduler, cfg.fitness)
    own = {
        field.name: next(getattr(part, field.name) for part in parts if hasattr(part, field.name))
        for field in fields(Arguments)
        if any(hasattr(part, field.name) for part in parts)
    }
    left_out = tuple(name for name in robot.penalties if name not in cfg.fitness.penalties)
    own |= {"robot": robot.spec, "without": left_out or None, "policy": None if cfg.policy == "shipped" else cfg.policy}
    iterations = asked["iterations"] if asked["preset"] == cfg.preset else _DEFAULTS[cfg.preset][0]
    return {**asked, **own, "iterations": iterations}


def _search(asked: dict[str, Any], alpha: float, folder: Path, open_evaluator: Open) -> SearchCfg:
    """A search, made or gone on with; returns its settings."""
    path = folder / _NAMES[alpha]
    if (path / CONFIG_FILE).exists():
        iterations = max(asked["iterations"], RunDirectory(path).iterations_done())
        asked = {**asked, "iterations": iterations, "resume": path}
    else:
        asked = {**asked, "run_dir": path}
    job = job_of(Arguments(**{**asked, "alpha": alpha, "reproduce": "no"}))
    run_search(job, open_evaluator=open_evaluator)
    return job.cfg


def _check_alike(cfg: SearchCfg, other: SearchCfg) -> None:
    found = [item for item in differences(as_settings(cfg), as_settings(other)) if not item.startswith("fitness.alpha")]
    if found:
        raise ValueError(f"the searches must differ in alpha alone, but: {', '.join(found)}")


def numbers_of(metrics: dict[str, Metrics], iterations: int) -> dict[str, Any]:
    """The ablation in numbers.

    Args:
        metrics: Rows of the searches, by name.
        iterations: Up to which they are compared.

    Returns:
        ``iterations`` at which elites of all were looked at, the ``mean_std`` and their ``intervals`` (95 %, bootstrap
        over elites) by name, the ``elites`` and ``mean_fitness`` there, and ``below_by_more_than_intervals``: whether,
        of each, the interval with alpha 1 ends before that with alpha 0 begins.

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
        raise ValueError(f"no iteration up to {iterations} at which elites of all searches were looked at again")
    rows = {name: [found[iteration] for iteration in at] for name, found in looks.items()}
    intervals = {name: [row["mean_std_interval"] for row in own] for name, own in rows.items()}
    return {
        "iterations": at,
        "mean_std": {name: [row["mean_std"] for row in own] for name, own in rows.items()},
        "intervals": intervals,
        "elites": {name: [row["elites"] for row in own] for name, own in rows.items()},
        "mean_fitness": {name: [row["mean_fitness"] for row in own] for name, own in rows.items()},
        "below_by_more_than_intervals": [
            one[1] < other[0] for one, other in zip(intervals["alpha_1"], intervals["alpha_0"], strict=True)
        ],
    }


def _print(report: dict[str, Any]) -> None:
    print(f"\nmean STD of elites over {FRESH_EPISODES} fresh episodes, 95 % interval over elites")
    for k, iteration in enumerate(report["iterations"]):
        cells = []
        for name, label in (("alpha_1", "alpha 1"), ("alpha_0", "alpha 0")):
            low, high = report["intervals"][name][k]
            cells.append(f"{label}: {report['mean_std'][name][k]:.2f} ({low:.2f}-{high:.2f})")
        print(f"  iteration {iteration}: {', '.join(cells)}")


def draw_ablation(report: dict[str, Any]) -> "Figure":
    """Mean STD over the iterations with its intervals, and the number of elites (the paper's ablation figure)."""
    figure = new_figure(8.5, 3.6)
    figure.suptitle(f"{report['robot']}: the standard deviations in the fitness (alpha 1) and left out (alpha 0)")
    left, right = figure.subplots(1, 2)
    for (name, label), (color, style) in zip((("alpha_1", "alpha 1"), ("alpha_0", "alpha 0")), LOOKS, strict=False):
        means, limits = np.array(report["mean_std"][name]), np.array(report["intervals"][name])
        lengths = np.maximum([means - limits[:, 0], limits[:, 1] - means], 0.0)
        marks = {"color": color, "linestyle": style, "marker": "o", "markersize": 4}
        left.errorbar(report["iterations"], means, lengths, capsize=3, label=label, **marks)
        right.plot(report["iterations"], report["elites"][name], label=label, **marks)
    left.set_ylabel(f"mean STD of elites\n({FRESH_EPISODES} fresh episodes)")
    right.set_ylabel("elites")
    for axes in (left, right):
        axes.set_xlabel("iteration")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    left.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run_command(AblationCfg, ablation)
