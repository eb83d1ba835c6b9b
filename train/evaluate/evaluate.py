"""How well controllers cross terrains that they were not trained on: the command, from its flags to its files.

The terrains are drawn from seeds used nowhere else: not in training, calibration or search.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.archive import ARCHIVE_FILE, Archive
from qd.fresh import Open
from qd.run.directory import newest_or_published, read_archive_of
from qd.workers.evaluator import EvaluatorCfg, check_policy, open_evaluator, origin_of, resolve_device
from sim.files.atomic import prepare_output
from sim.files.command import OnGround, Where, Who, naming_what_is_next, publish, split_words
from sim.files.settings import check, setting
from sim.policy.spec import controller_hash, controllers_of, who_crossed
from sim.robots.identity import identity, robot_identity

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg
    from sim.space import TerrainSpace
    from train.evaluate.sets import EliteSplit

_FULL = (300, 20)  # terrains a set and episodes a terrain of the published rates; tables take the paper's terrains
_SMALL = (24, 4)  # on a machine without a GPU


@dataclass(frozen=True, kw_only=True)
class Evaluate(Who, OnGround, Where):
    """Measure the rates of one controller on terrains or on a pack, or make the paper's tables of several.

    Rates say how often the controller gets through, and how large its velocity error is on flat ground. With
    --policies, --archive or --sets the command makes tables: any controllers on the same hand-crafted, hard-random and
    held-out generated terrains, with rewards, penalties and intervals. After a kill the same command goes on. With
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
    split_seed: int = setting(0, least=0)
    """Which elites are held out. Give the number that the fine-tuning was given."""
    space: str | None = None
    """Terrain space of the hard-random terrains: super_gaussian, course, or file.py:CLASS; super_gaussian if left out.
    If the archive is of a space of your own, name it here."""
    sets: tuple[str, ...] = ()
    """Sets of the tables: hand_crafted, hard_random and, with an archive, generated and generated_far. All of them if
    left out."""
    terrains: int | None = setting(None, least=1)
    """Terrains a set; 300 on CUDA (tables of Cassie: 180), 24 on the CPU."""
    episodes: int | None = setting(None, least=1)
    """Episodes a terrain; 20 on CUDA, 4 on the CPU."""
    seed: int = setting(0, least=0)
    """Draws other test sets."""
    out: Path | None = None
    """File for the numbers. If left out: runs/<robot>-rates.json; with another controller than the shipped one
    runs/<robot>-<its name>-rates.json; with a pack ...-pack.json; for tables RUN_DIR/tables.json. A figure of a pack or
    of tables is written beside it as .png."""
    run_dir: Path | None = None
    """Folder in which tables keep crossings, so that they can go on; runs/<robot>-tables."""

    @property
    def makes_tables(self) -> bool:
        """Whether the paper's tables are asked for."""
        return bool(self.policies or self.sets or self.archive is not None)

    def execute(self) -> None:
        """Evaluates.

        Raises:
            ValueError: If a flag's value cannot be used; raised before any long work.
        """
        if self.pack is not None:
            from train.evaluate.pack import evaluate_pack

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
    from train.evaluate.sets import paper_terrains

    check(flags)
    device = resolve_device(flags.device, flags.workers)
    full = full or ((paper_terrains(robot.name), _FULL[1]) if flags.makes_tables else _FULL)
    terrains, episodes = full if device.startswith("cuda") else (min(full[0], _SMALL[0]), _SMALL[1])
    if not device.startswith("cuda") and flags.terrains is None and flags.episodes is None:
        print(f"No GPU: {terrains} terrains x {episodes} episodes a set instead of {full[0]} x {full[1]}.")
    return EvaluatorCfg(
        robot=robot,
        policy="",
        num_terrains=flags.terrains or terrains,
        num_replicas=flags.episodes or episodes,
        device=device,
        workers=flags.workers,
        num_envs=flags.num_envs,
        space=space_named(flags).name,
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
    from sim.robots.robot import get_robot
    from train.evaluate.measures import VELOCITY_FROM_S, base_rates
    from train.evaluate.show import print_rates

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
    from sim.robots.robot import get_robot
    from train.evaluate.crossings import cross_all
    from train.evaluate.measures import measure
    from train.evaluate.sets import FROM_ARCHIVE, SETS, check_held_out, make_sets, split_elites
    from train.evaluate.show import picture_of, print_tables
    from train.evaluate.tables import check_seeds, make_tables

    if flags.policy is not None:
        raise ValueError(f"tables are of named controllers: give --policies own={flags.policy} instead of --policy")
    robot = get_robot(flags.robot)
    evaluator = replace(evaluator_of(flags, robot), reward=True)
    controllers = controllers_of(flags.policies, robot)
    archive = None if flags.archive is None else read_archive_of(robot, flags.archive, flags.space)
    split = (
        None
        if archive is None
        else split_elites(archive, robot.name, flags.split_seed, spec=robot.spec, run=flags.archive)
    )
    names = split_words(flags.sets) or [name for name in SETS if archive is not None or name not in FROM_ARCHIVE]
    run_dir = flags.run_dir or Path("runs") / f"{robot.name}-tables"
    if archive is None and any(name in FROM_ARCHIVE for name in names):
        found = newest_or_published(robot)
        raise ValueError(f"set {', '.join(names)} is made of elites: give the run that found them (--archive {found})")
    for policy in controllers.values():
        check_policy(policy, robot, evaluator.device)
    own = next((policy for policy in controllers.values() if policy != str(robot.policy_file)), None)
    scales = robot.read_penalty_scales(own)
    check_seeds(controllers)
    space = space_named(flags)
    sets = make_sets(names, evaluator.num_terrains, flags.seed, archive=archive, split=split, space=space)
    for name in FROM_ARCHIVE:
        if name in sets:
            check_held_out(controllers, sets[name].terrains, flags.split_seed)
    kept = run_dir / "crossings"
    prepare_output(kept / "any")  # last: what is refused leaves no folder
    about = _about(flags, archive, split)  # before the long work: the file may be another afterwards

    def tables() -> dict[str, Any]:
        results = cross_all(controllers, sets, evaluator, kept, open_evaluator=open_evaluator)
        crossed = {name: {who: measure(one, scales) for who, one in row.items()} for name, row in results.items()}
        return {
            **origin_of(evaluator.device, flags.seed, flags.workers),
            "robot": robot.name,
            **robot_identity(robot),
            "space": space.name,
            "episodes": evaluator.num_replicas,
            "controllers": {
                who: {"policy": policy, "sha256": controller_hash(policy)} for who, policy in controllers.items()
            },
            **about,
            **make_tables(crossed, sets, robot, flags.seed),
        }

    return publish(flags.out or run_dir / "tables.json", tables, print_tables, draw=picture_of)


def _about(flags: Evaluate, archive: Archive | None, split: "EliteSplit | None") -> dict[str, Any]:
    """Where the generated terrains come from."""
    if flags.archive is None or archive is None or split is None:
        return {"archive": None, "archive_sha256": None}
    parts = {"train": len(split.train), "test": len(split.test), "split_seed": flags.split_seed}
    about = {"path": str(flags.archive), "elites": len(archive), "iterations": archive.iterations, **parts}
    file = flags.archive / ARCHIVE_FILE if flags.archive.is_dir() else flags.archive
    return {"archive": about, "archive_sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
