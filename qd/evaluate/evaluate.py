"""How well controllers cross terrains that they were not trained on: the command, from its flags to its files.

The terrains are drawn from seeds used nowhere else: not in training, calibration or search.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from qd.archive import ARCHIVE_FILE, Archive
from qd.fresh import Open
from qd.run.directory import newest_or_published, read_archive_of, search_seed
from qd.workers.evaluator import EvaluatorCfg, check_policy, open_evaluator, origin_of, resolve_device
from sim.files.atomic import prepare_output
from sim.files.command import OnGround, Where, Who, naming_what_is_next, publish, split_words
from sim.files.records import identity, robot_identity
from sim.files.settings import check, setting
from sim.policy.spec import about_controllers, controllers_of, who_crossed

if TYPE_CHECKING:
    from qd.evaluate.dose import MeasureDose
    from qd.evaluate.sets import EliteSplit, TerrainSet
    from sim.robots.robot import RobotCfg
    from sim.rollout import RolloutResult
    from sim.space import TerrainSpace

_FULL = (300, 20)  # terrains a set and episodes a terrain of the published rates; tables take the paper's terrains
_SMALL = (24, 4)  # on a machine without a GPU


@dataclass(frozen=True, kw_only=True)
class Evaluate(Who, OnGround, Where):
    """Measure the rates of one controller on terrains or on a pack, or make the paper's tables of several.

    Rates say how often the controller gets through, and how large its velocity error is on flat ground. With
    --policies, --archive or --sets the command makes tables: any controllers on the same hand-crafted, hard-random and
    generated terrains, with rewards, penalties and intervals. After a kill the same command goes on. With
    --pack it says which terrains of a pack of faults a controller fails.
    """

    pack: str | None = None
    """Pack of faults that the controller is tested on: a folder that `faultline pack` made, or anymal or cassie for the
    published one. --terrains takes the first of it; all on CUDA."""
    policies: tuple[str, ...] = ()
    """Controllers of the tables, each NAME=FILE, NAME=file.py:callable, NAME=module:callable or NAME=shipped. The
    others are compared with the first. base=shipped if left out. C-G, C-G@1 and C-G@2 are three seeds of one kind;
    their mean is shown too."""
    archive: Path | None = None
    """Run of a search, or its archive.npz: its held-out elites are the generated terrains."""
    independent: Path | None = None
    """Run of another search, with another seed, or its archive.npz: elites that share no ancestor with those trained
    on, drawn from all of its elites. They are the terrains of generated_independent."""
    part: Literal["test", "validation"] = "test"
    """Which terrains the tables are of. test: those to report. validation: others of the same kinds, to choose settings
    by: elites that are neither trained on nor in the test, and other hand-crafted and hard-random terrains."""
    split_seed: int = setting(0, least=0)
    """Which elites are held out. Give the number that the fine-tuning was given."""
    space: str | None = None
    """Terrain space of the hard-random terrains: super_gaussian, course, or file.py:CLASS; super_gaussian if left out.
    If the archive is of a space of your own, name it here."""
    sets: tuple[str, ...] = ()
    """Sets of the tables: hand_crafted, hard_random, with --archive generated and generated_far, and with --independent
    generated_independent. All of them if left out."""
    resolved: tuple[str, ...] = ()
    """Names of controllers that cross the terrains of all sets again with contact resolved (steps of 1 ms, a time
    constant of 3 ms), which takes five times as long. The tables then have the bias of the search's settings."""
    mujoco_c: int = setting(0, least=0)
    """So many random terrains of each set are crossed by the controllers of --resolved in plain MuJoCo C too, with
    contact resolved, 10 episodes each. It always runs on the CPU."""
    terrains: int | None = setting(None, least=1)
    """Terrains a set; 300 on CUDA (tables of Cassie: 180), 24 on the CPU."""
    episodes: int | None = setting(None, least=1)
    """Episodes a terrain; 20 on CUDA, 4 on the CPU."""
    seed: int = setting(0, least=0)
    """Draws other test sets."""
    out: Path | None = None
    """File for the numbers. If left out: runs/<robot>-rates.json; with another controller than the shipped one
    runs/<robot>-<its name>-rates.json; with a pack ...-pack.json; for tables RUN_DIR/tables.json, those of validation
    RUN_DIR/validation.json. A figure of a pack or of tables is written beside it as .png."""
    run_dir: Path | None = None
    """Folder in which tables keep crossings, so that they can go on; runs/<robot>-tables."""

    @property
    def makes_tables(self) -> bool:
        """Whether the paper's tables are asked for."""
        asked = self.policies or self.sets or self.archive or self.independent or self.resolved or self.mujoco_c
        return bool(asked) or self.part != "test"

    def execute(self) -> None:
        """Evaluates.

        Raises:
            ValueError: If a flag's value cannot be used; raised before any long work.
        """
        if self.pack is not None:
            from qd.evaluate.pack import evaluate_pack

            evaluate_pack(self)
            return
        if not self.makes_tables:
            evaluate_rates(self)
            return
        with naming_what_is_next("what is crossed is kept", lambda: "The same command goes on."):
            evaluate_tables(self)


def evaluator_of(flags: Evaluate, robot: "RobotCfg", full: tuple[int, int] | None = None) -> EvaluatorCfg:
    """How much is crossed, where; says so where it is less than on a GPU. The controller is still to be named.

    Args:
        flags: What was asked for.
        robot: The robot.
        full: Terrains a set and episodes a terrain on a GPU; what rates or tables take if None.

    Raises:
        ValueError: If the device is unknown, or a number is out of range.
    """
    from qd.evaluate.sets import paper_terrains

    full = full or ((paper_terrains(robot.name), _FULL[1]) if flags.makes_tables else _FULL)
    sized = sized_evaluator(flags, robot, full, (min(full[0], _SMALL[0]), _SMALL[1]), "a set")
    return replace(sized, space=space_named(flags).name)


def sized_evaluator(
    flags: "Evaluate | MeasureDose", robot: "RobotCfg", full: tuple[int, int], small: tuple[int, int], each: str
) -> EvaluatorCfg:
    """What crosses as many terrains in as many episodes as a command line asks for, or as suit the device.

    Args:
        flags: What was asked for.
        robot: The robot.
        full: Terrains and episodes a terrain on a GPU.
        small: The same without one; it is told that they are fewer.
        each: What the terrains are for, as in ``a set``.

    Raises:
        ValueError: If the device is unknown, or a number is out of range.
    """
    check(flags)
    device = resolve_device(flags.device, flags.workers)
    terrains, episodes = full if device.startswith("cuda") else small
    if not device.startswith("cuda") and flags.terrains is None and flags.episodes is None:
        print(f"No GPU: {terrains} terrains x {episodes} episodes {each} instead of {full[0]} x {full[1]}.")
    return EvaluatorCfg(
        robot=robot,
        policy="",
        num_terrains=flags.terrains or terrains,
        num_replicas=flags.episodes or episodes,
        device=device,
        workers=flags.workers,
        num_envs=flags.num_envs,
    )


def space_named(flags: Evaluate) -> "TerrainSpace":
    """The space that the command line names; super_gaussian if it names none.

    Raises:
        ValueError: If there is no such space, or it does not work.
    """
    from sim.space import SUPER_GAUSSIAN, load_space, on_ground

    return load_space(on_ground(flags.space, flags.ground) or SUPER_GAUSSIAN.name)


def evaluate_rates(flags: Evaluate) -> dict[str, Any]:
    """Rates of one controller: print the table, write the file; returns its content.

    Raises:
        ValueError: If a flag's value cannot be used; raised before any long work.
    """
    from qd.evaluate.measures import VELOCITY_FROM_S, base_rates
    from qd.evaluate.show import print_rates
    from sim.robots.robot import get_robot

    robot = get_robot(flags.robot)
    policy = str(flags.policy or robot.policy_file)
    evaluator = replace(evaluator_of(flags, robot), policy=policy, penalties_from_s=VELOCITY_FROM_S)
    space = space_named(flags)
    out = flags.out or Path("runs") / f"{who_crossed(robot, policy)}-rates.json"
    check_policy(policy, robot, evaluator.device)

    def measure() -> dict[str, Any]:
        with open_evaluator(evaluator) as evaluate:
            rates = base_rates(evaluate, evaluator.num_terrains, flags.seed, space)
        origin = origin_of(evaluator.device, flags.seed, flags.workers)
        return {**origin, **identity(robot, policy), "space": space.name, **rates}

    return publish(out, measure, print_rates)


def evaluate_tables(flags: Evaluate, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """Cross every set with every controller, print the tables, write them and their figure; returns their content.

    Args:
        flags: What to evaluate, on what, where.
        open_evaluator: Opens what crosses terrains.

    Raises:
        ValueError: If a flag's value cannot be used; raised before any long work.
        FileNotFoundError: If there is no archive; likewise.
        EvaluatorError: If a worker is lost; what was crossed is kept.
    """
    from qd.evaluate.show import picture_of, print_tables

    job = tables_job(flags)
    prepare_output(job.kept / "any")  # last: what is refused leaves no folder
    file = "tables.json" if flags.part == "test" else "validation.json"
    out = flags.out or job.run_dir / file
    return publish(out, lambda: _tables(job, open_evaluator), print_tables, draw=picture_of)


@dataclass(frozen=True, kw_only=True)
class TablesJob:
    """Tables that can be made: what a user may have got wrong is checked."""

    flags: Evaluate
    robot: "RobotCfg"
    evaluator: EvaluatorCfg
    """What crosses; its policy is still to be named."""
    controllers: dict[str, str]
    """Policy of each controller by its name."""
    resolved: dict[str, str]
    """Those of them that cross with contact resolved too."""
    sets: "dict[str, TerrainSet]"
    scales: tuple[float, ...]
    """Of the penalties."""
    about: dict[str, Any]
    """Where the terrains come from, as ``tables.json`` has it."""

    @property
    def run_dir(self) -> Path:
        """Folder of the tables."""
        return self.flags.run_dir or Path("runs") / f"{self.robot.name}-tables"

    @property
    def kept(self) -> Path:
        """Folder of the crossings."""
        return self.run_dir / "crossings"


def tables_job(flags: Evaluate) -> TablesJob:
    """What a command line asks for, checked; errors as of :func:`evaluate_tables`."""
    from qd.evaluate.resolved import check_resolved
    from qd.evaluate.sets import make_sets
    from qd.evaluate.tables import check_seeds
    from sim.robots.robot import get_robot

    if flags.policy is not None:
        raise ValueError(f"tables are of named controllers: give --policies own={flags.policy} instead of --policy")
    robot = get_robot(flags.robot)
    evaluator = replace(evaluator_of(flags, robot), reward=True)
    controllers = controllers_of(flags.policies, robot)
    sources = _sources(flags, robot)
    names = _set_names(flags, robot, sources)
    for policy in controllers.values():
        check_policy(policy, robot, evaluator.device)
    own = next((policy for policy in controllers.values() if policy != str(robot.policy_file)), None)
    scales = tuple(robot.read_penalty_scales(own))
    check_seeds(controllers)
    space = space_named(flags)
    sets = make_sets(
        names, evaluator.num_terrains, flags.seed, archive=sources.archive, split=sources.split,
        independent=sources.independent, space=space, part=flags.part,
    )  # fmt: skip
    _refuse_trained_on(flags, controllers, sets, sources)
    resolved = split_words(flags.resolved)
    check_resolved(resolved, flags.mujoco_c, controllers, robot, sets)
    return TablesJob(
        flags=flags,
        robot=robot,
        evaluator=evaluator,
        controllers=controllers,
        resolved={who: controllers[who] for who in resolved},
        sets=sets,
        scales=scales,
        about={"space": space.name, **_about(flags, sources)},  # before the long work, after which files may be others
    )


class _Sources(NamedTuple):
    """Archives that sets are made of."""

    archive: Archive | None
    split: "EliteSplit | None"
    independent: Archive | None


def _sources(flags: Evaluate, robot: "RobotCfg") -> _Sources:
    from qd.evaluate.sets import read_independent, split_elites

    archive = split = independent = None
    if flags.archive is not None:
        archive = read_archive_of(robot, flags.archive, flags.space)
        split = split_elites(archive, robot.name, flags.split_seed, spec=robot.spec, run=flags.archive)
    if flags.independent is not None:
        if flags.part == "validation":
            raise ValueError(
                "independent elites are to be reported, and no setting is chosen by them: leave --independent out of "
                "--part validation"
            )
        independent = read_independent(
            robot, flags.independent, archive=archive, archive_path=flags.archive, named=flags.space
        )
    return _Sources(archive, split, independent)


def _set_names(flags: Evaluate, robot: "RobotCfg", sources: _Sources) -> list[str]:
    """Sets that are asked for, or all that can be had."""
    from qd.evaluate.sets import HELD_OUT, INDEPENDENT, SETS

    lacking = [name for name in HELD_OUT if sources.archive is None]
    asked = split_words(flags.sets)
    if missing := [name for name in asked if name in lacking]:
        found = newest_or_published(robot)
        raise ValueError(
            f"set {', '.join(missing)} is made of elites: give the run that found them (--archive {found})"
        )
    lacking += [INDEPENDENT] if sources.independent is None else []
    return asked or [name for name in SETS if name not in lacking]


def _refuse_trained_on(
    flags: Evaluate, controllers: dict[str, str], sets: "dict[str, TerrainSet]", sources: _Sources
) -> None:
    """Refuses controllers that were trained on what they are to be tested on, as far as their records say."""
    from qd.evaluate.sets import HELD_OUT, check_held_out, check_untrained

    for name in HELD_OUT:
        if name in sets:
            check_held_out(controllers, sets[name].terrains, flags.split_seed, flags.part)
    if sources.independent is not None:  # all of its elites: those of a run that was trained on share ancestors
        remedy = "give a search on whose elites no controller was trained"
        check_untrained(controllers, sources.independent.genes, f"of --independent {flags.independent}", remedy)


def _about(flags: Evaluate, sources: _Sources) -> dict[str, Any]:
    """Where the generated terrains come from, and what the tables are for."""
    about: dict[str, Any] = {"part": flags.part, "archive": None, "archive_sha256": None, "independent": None}
    if flags.archive is not None and sources.archive is not None and sources.split is not None:
        sizes = {name: len(getattr(sources.split, name)) for name in ("train", "validation", "test")}
        about["archive"] = {**_about_archive(flags.archive, sources.archive), **sizes, "split_seed": flags.split_seed}
        about["archive_sha256"] = _file_sha256(flags.archive)
    if flags.independent is not None and sources.independent is not None:
        digest = {"search_seed": search_seed(flags.independent), "sha256": _file_sha256(flags.independent)}
        about["independent"] = {**_about_archive(flags.independent, sources.independent), **digest}
    return about


def _about_archive(path: Path, archive: Archive) -> dict[str, Any]:
    return {"path": str(path), "elites": len(archive), "iterations": archive.iterations}


def _file_sha256(run: Path) -> str:
    return hashlib.sha256((run / ARCHIVE_FILE if run.is_dir() else run).read_bytes()).hexdigest()


def _tables(job: TablesJob, open_evaluator: Open) -> dict[str, Any]:
    """Crosses what is not kept yet; returns what ``tables.json`` says."""
    from qd.evaluate.crossings import cross_all
    from qd.evaluate.measures import measure
    from qd.evaluate.tables import make_tables

    flags, evaluator, seed = job.flags, job.evaluator, job.flags.seed
    results = cross_all(job.controllers, job.sets, evaluator, job.kept, open_evaluator=open_evaluator)
    crossed = {name: {who: measure(one, job.scales) for who, one in row.items()} for name, row in results.items()}
    about = about_controllers(job.controllers, job.robot)
    return {
        **origin_of(evaluator.device, seed, flags.workers),
        "robot": job.robot.name,
        **robot_identity(job.robot),
        "episodes": evaluator.num_replicas,
        "controllers": about,
        **job.about,
        **make_tables(crossed, job.sets, job.robot, seed, hashes={who: one["sha256"] for who, one in about.items()}),
        **_resolved(job, results, open_evaluator),
    }


def _resolved(job: TablesJob, results: "dict[str, dict[str, RolloutResult]]", open_evaluator: Open) -> dict[str, Any]:
    """The same terrains with contact resolved, here and in plain MuJoCo C; None of what is not asked for."""
    from qd.evaluate.crossings import cross_all
    from qd.evaluate.resolved import compared, cross_in_mujoco_c, drawn_sets, outcomes_of

    sets, seed, in_c = job.sets, job.flags.seed, job.flags.mujoco_c
    found: dict[str, Any] = {"resolved": None, "mujoco_c": None}
    outcomes = outcomes_of(results)
    if job.resolved:
        evaluator = replace(job.evaluator, resolved=True, reward=False)
        again = cross_all(job.resolved, sets, evaluator, job.kept, open_evaluator=open_evaluator)
        found["resolved"] = compared(outcomes, outcomes_of(again), sets, sets, seed)
    if job.resolved and in_c:
        drawn = drawn_sets(sets, in_c, seed)
        plain = cross_in_mujoco_c(job.resolved, drawn, job.evaluator, job.kept)
        found["mujoco_c"] = compared(outcomes, plain, sets, drawn, seed)
    return found
