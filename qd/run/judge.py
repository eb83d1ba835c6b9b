"""The commands that judge the failing elites of a run: confirm and certify."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.archive import ARCHIVE_FILE, Archive, read_archive
from qd.faults import Work, certify, confirm, confirm_in_mujoco_c, fault_words, known_names, saving
from qd.fresh import Open, Reevaluate, reevaluate_run
from qd.run.arguments import check_certifiers, evaluator_of
from qd.run.directory import CONFIG_FILE, RESULTS, SUMMARY_FILE, RunDirectory, claimed, find_run
from qd.run.settings import SearchCfg, as_settings, is_searched, own_policy
from qd.workers.evaluator import Compute, open_evaluator, origin_of, resolve_device
from sim.files.atomic import read_json
from sim.files.command import InSpace, OfRobot, Where, Who, chosen_elites, command_line, naming_what_is_next
from sim.files.intervals import rate_words
from sim.files.records import identity
from sim.files.settings import setting
from sim.policy.spec import controllers_of, spec_of

if TYPE_CHECKING:
    from qd.show.recordings import Cross
    from sim.robots.robot import RobotCfg

PANEL_FOLDER = "panel"
"""Folder of a robot's results that holds its fixed certifiers, ``<name>.pt``."""


@dataclass(frozen=True, kw_only=True)
class Confirm(Who, InSpace, Where):
    """Cross the failing elites of a run again with contact resolved. Do they fail there too?

    An elite fails if under half of the robots reach the goal in its 40 fresh episodes. It is confirmed if under half
    reach it in 20 more episodes too, with steps of 1 ms and a contact time constant of 3 ms. Such an episode is about
    five times the work. Nothing is crossed twice, so the same command goes on after Ctrl-C.
    """

    run: Path | None = None
    """Run directory; the newest of the robot under runs/."""
    elite: str = "all"
    """Numbers of failing elites: one, several as in --elite "0 3", or all that fail."""
    mujoco_c: int = setting(0, least=0)
    """How many of them to cross in plain MuJoCo C too, on the CPU, with contact resolved. The run's seed draws them."""

    def execute(self) -> None:
        """Runs the command."""
        confirm_run(self)


@dataclass(frozen=True, kw_only=True)
class Certify(OfRobot, InSpace, Where):
    """Let other controllers cross the failing elites of a run. Which of them can be crossed?

    A certificate says that a controller reaches the goal in at least half of 20 episodes at the search's settings, and
    in at least half of 20 with contact resolved. A confirmed elite with a certificate is a fault of the controller that
    was searched. Certificates add up over calls. Nothing is crossed twice, so the same command goes on after Ctrl-C.
    """

    by: tuple[str, ...] = ()
    """Certifiers as NAME=FILE, each as --policy takes it; the robot's panel if left out, results/<robot>/panel/*.pt."""
    run: Path | None = None
    """Run directory; the newest of the robot under runs/."""
    elite: str = "all"
    """Numbers of failing elites: one, several as in --elite "0 3", or all that fail."""
    record: bool = False
    """Keep one crossing of each certificate in the run's recordings, which `faultline replay --certificate` shows."""

    def execute(self) -> None:
        """Runs the command."""
        certify_run(self)


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A run whose failing elites are to be crossed."""

    run: RunDirectory
    cfg: SearchCfg
    robot: "RobotCfg"
    archive: Archive
    """With fresh values."""
    chosen: list[int]
    """Numbers of the failing elites that were named."""


def config_of(args: OfRobot, run: Path | None, space: str | None) -> tuple[Path, SearchCfg, "RobotCfg"]:
    """Directory, search and robot of the run that a command line names, and its terrain space at hand."""
    from sim.robots.find import get_robot, robot_of
    from sim.spaces.registry import get_space, load_space

    path = find_run(get_robot(args.robot), run, published="never")
    cfg = RunDirectory(path).read_cfg()
    if space is not None:
        load_space(space)
    get_space(cfg.space, cfg.space_sha256)
    return path, cfg, robot_of(as_settings(cfg), args.robot, path)


@contextmanager
def judged_run(path: Path, cfg: SearchCfg, robot: "RobotCfg", elite: str) -> Iterator[Judged]:
    """The run, kept from other commands.

    Raises:
        ValueError: If archive or numbers are damaged, there are no fresh episodes, or an elite that was named does not
            fail.
    """
    with claimed(path):
        archive = read_archive(path)
        if (path / SUMMARY_FILE).exists():
            read_json(path / SUMMARY_FILE)  # what is found is added to it: a damaged one would be lost
        if (archive.robot, archive.penalties, archive.scales) != (
            cfg.robot, cfg.fitness.penalties, cfg.fitness.scales,
        ):  # fmt: skip
            raise ValueError(
                f"{path / ARCHIVE_FILE} must be the archive of {CONFIG_FILE} beside it, got one of another robot, "
                "other penalties or scales: put back the one that is not this run's"
            )
        if archive.fresh is None:
            remedy = command_line("reevaluate", robot=robot.spec, run=path, policy=cfg.policy)
            raise ValueError(
                f"{path} must have fresh episodes of its elites, which say what fails, got none: run `{remedy}` first"
            )
        yield Judged(
            run=RunDirectory(path), cfg=cfg, robot=robot, archive=archive, chosen=_failing(archive, elite, path)
        )


def _failing(archive: Archive, elite: str, path: Path) -> list[int]:
    """Numbers of failing elites that a command line names.

    Raises:
        ValueError: If one of them does not fail.
    """
    fresh = archive.fresh
    assert fresh is not None
    if elite.strip() == "all":
        return np.flatnonzero(fresh.failing).tolist()
    numbers = chosen_elites(elite, len(archive), path)
    for number in numbers:
        if not fresh.failing[number]:
            count = int(fresh.episodes[number] - fresh.invalid_episodes[number])
            rate = rate_words(round(float(fresh.goal_rate[number]) * count), count)
            why = f"{rate} of its fresh episodes reach the goal, expected under half"
            if not fresh.valid[number]:
                why = f"{fresh.invalid_episodes[number]} of its {fresh.episodes[number]} fresh episodes are invalid"
            raise ValueError(f"elite {number} of {path} does not fail: {why}: name failing ones, or leave out --elite")
    return numbers


def searched_policy(path: Path, cfg: SearchCfg, robot: "RobotCfg", given: str | None, what: str) -> str:
    """The controller that was searched, as :func:`sim.policy.loaders.load_policy` takes it.

    Args:
        path: The run.
        cfg: Its search.
        robot: Its robot.
        given: Controller that the command line names.
        what: What is to be done with the run, for the error.

    Raises:
        ValueError: If another one is named, or it is code that is not named again.
    """
    policy = own_policy(path, cfg, robot) if given is None else spec_of(given, robot)
    if not is_searched(cfg, policy, robot):
        raise ValueError(
            f"{path} must be {what} with the controller that was searched, {cfg.policy}, got {policy}: leave out "
            "--policy, or use `faultline certify` to see which elites another controller crosses"
        )
    return policy


def confirm_run(args: Confirm, *, open_evaluator: Open = open_evaluator) -> Archive:
    """Crosses failing elites of a run with contact resolved, writes what came of it, and says it.

    Args:
        args: Which run and elites, and where to work.
        open_evaluator: Opens what crosses terrains.

    Returns:
        The archive with its counts.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If the run is damaged or without fresh episodes, its robot or controller is another now, or an
            argument is not as it must be.
        Interrupted: On Ctrl-C; lots that ended are kept.
        EvaluatorError: If a worker is lost; likewise.
    """
    path, cfg, robot = config_of(args, args.run, args.space)
    policy = searched_policy(path, cfg, robot, args.policy, "confirmed")
    if args.mujoco_c:
        from sim.mujoco_c.model import refuse_softness  # with MuJoCo: not for `--help`
        from sim.spaces.registry import get_space

        refuse_softness(get_space(cfg.space, cfg.space_sha256))
    device = resolve_device(args.device, args.workers)
    evaluator = evaluator_of(cfg, robot, policy, device, args.workers, num_envs=args.num_envs)
    with judged_run(path, cfg, robot, args.elite) as judged:
        by = {"confirmed_by": {**origin_of(device, cfg.seed, args.workers), **identity(robot, policy)}}
        save = saving(judged.run, by)
        work = Work(evaluator=evaluator, open_evaluator=open_evaluator, seed=cfg.seed, save=save)
        with naming_what_is_next("what was crossed is kept", lambda: "The same command goes on"):
            archive = confirm(judged.archive, judged.chosen, work)
            archive = confirm_in_mujoco_c(archive, judged.chosen, args.mujoco_c, work)
            saving(judged.run)(archive)
    _tell(archive, path)
    if archive.confirmed.any() and panel_files(robot, lambda file: is_searched(cfg, file, robot)):
        print(f"Next, see which of them other controllers cross:  {_certify_command(robot, path, args)}")
    return archive


def certify_run(args: Certify, *, open_evaluator: Open = open_evaluator, cross: "Cross | None" = None) -> Archive:
    """Lets other controllers cross failing elites of a run, writes what came of it, and says it.

    Args:
        args: Which run, elites and controllers, and where to work.
        open_evaluator: Opens what crosses terrains.
        cross: Crosses the terrains that are recorded; by default the simulation.

    Returns:
        The archive with its counts.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If the run is damaged or without fresh episodes, its robot is another now, a certifier does not fit
            the robot, is the controller that was searched or has no file, or there is none.
        Interrupted: On Ctrl-C; lots that ended are kept.
        EvaluatorError: If a worker is lost; likewise.
    """
    path, cfg, robot = config_of(args, args.run, args.space)
    device = resolve_device(args.device, args.workers)
    certifiers = certifiers_of(args.by, cfg, robot, device)
    evaluator = evaluator_of(cfg, robot, next(iter(certifiers.values())), device, args.workers, num_envs=args.num_envs)
    with judged_run(path, cfg, robot, args.elite) as judged:
        certifiers = known_names(judged.archive, certifiers)
        origin = origin_of(device, cfg.seed, args.workers)
        there = judged.run.read_summary().get("certified_by") or {}
        own = {name: {**origin, **identity(robot, policy)} for name, policy in certifiers.items()}
        work = Work(
            evaluator=evaluator, open_evaluator=open_evaluator, seed=cfg.seed,
            save=saving(judged.run, {"certified_by": {**there, **own}}),
        )  # fmt: skip
        with naming_what_is_next("what was crossed is kept", lambda: "The same command goes on"):
            archive = certify(judged.archive, judged.chosen, certifiers, work)
            saving(judged.run)(archive)
            if args.record:
                from qd.show.evidence import FOLDER, record_certificates
                from qd.show.recordings import Simulation

                kept = record_certificates(
                    path, archive, judged.chosen, certifiers, seed=cfg.seed, device=device,
                    cross=cross or Simulation(robot, device),
                )  # fmt: skip
                print(f"Crossings recorded under {path / FOLDER}: {kept}")
    _tell(archive, path)
    faults = np.flatnonzero(archive.confirmed & archive.certified)
    if len(faults):
        print(f"Next, see one:  {command_line('replay', robot=robot.spec, run=path, elite=int(faults[0]))}")
    elif archive.certified.any():
        print(f"Next, confirm them:  {command_line('confirm', robot=robot.spec, run=path)}")
    return archive


def certifiers_of(by: tuple[str, ...], cfg: SearchCfg, robot: "RobotCfg", device: str) -> dict[str, str]:
    """Certifiers by name, each tried on the robot.

    Args:
        by: As the command line names them; the robot's panel if empty.
        cfg: The search whose controller they are to certify.
        robot: Its robot.
        device: Warp device name.

    Raises:
        ValueError: If there is none; as of :func:`qd.run.arguments.check_certifiers`.
    """
    if by:
        certifiers = controllers_of(by, robot, flag="by")
    else:
        certifiers = panel_of(robot, lambda file: is_searched(cfg, file, robot))
    check_certifiers(certifiers, cfg, robot, device)
    return certifiers


def panel_files(robot: "RobotCfg", is_measured: Callable[[str], bool]) -> dict[str, str]:
    """The robot's fixed certifiers by name, without the controller that is measured.

    Args:
        robot: The robot.
        is_measured: Whether a file is of that controller.
    """
    files = sorted((RESULTS / robot.name / PANEL_FOLDER).glob("*.pt"))
    return {file.stem: str(file) for file in files if not is_measured(str(file))}


def panel_of(robot: "RobotCfg", is_measured: Callable[[str], bool]) -> dict[str, str]:
    """:func:`panel_files`, of which there must be one.

    Raises:
        ValueError: If there is none.
    """
    found = panel_files(robot, is_measured)
    if not found:
        folder = RESULTS / robot.name / PANEL_FOLDER
        raise ValueError(
            f"{folder} must hold certifiers of {robot.name} other than the controller that was searched, *.pt, got "
            "none: name some, for example --by C-G=tuned/policy.pt"
        )
    return found


def _certify_command(robot: "RobotCfg", path: Path, args: Confirm) -> str:
    return command_line("certify", robot=robot.spec, run=path, device=args.device, workers=args.workers)


def _tell(archive: Archive, path: Path) -> None:
    if not archive.failing.any():
        print(f"No elite of {path} fails by its fresh episodes: there is nothing to cross.")
    for line in fault_words(archive):
        print(line)
    print(f"In {path / SUMMARY_FILE} and {path / ARCHIVE_FILE}.")


@dataclass(frozen=True, kw_only=True)
class Search:
    """A search whose elites are judged."""

    run: Path
    cfg: SearchCfg
    robot: "RobotCfg"
    policy: str
    """The controller that was searched, where it is now."""


def find_search(run: Path, *, robot: str | None = None, policy: str | None = None, space: str | None = None) -> Search:
    """The search of a run; robot, controller and space are named if they are code or have moved."""
    path, cfg, body = config_of(OfRobot(robot=robot), run, space)
    return Search(run=path, cfg=cfg, robot=body, policy=searched_policy(path, cfg, body, policy, "searched"))


def judge(
    run: Path,
    *,
    compute: Compute,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    open_evaluator: Open = open_evaluator,
) -> Archive:
    """Fresh episodes of all elites of a run, and contact resolved for those that fail."""
    flags: dict[str, Any] = {
        "run": run, "robot": robot, "policy": policy, "space": space, "device": compute.device,
        "workers": compute.workers, "num_envs": compute.num_envs,
    }  # fmt: skip
    reevaluate_run(Reevaluate(**flags), open_evaluator=open_evaluator)
    return confirm_run(Confirm(**flags), open_evaluator=open_evaluator)
