"""A pack of terrains: the command that makes one, and any controller tested on it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.faults import EPISODES
from qd.fresh import Open
from qd.pack import (
    PACK_FILE,
    TERRAINS_FILE,
    Candidates,
    Pack,
    candidates_of,
    check_judged,
    choose,
    pack_folder,
    read_pack,
    rounded,
    write_terrains,
)
from qd.run.arguments import evaluator_of as evaluator_of_run
from qd.run.directory import RESULTS, RUNS
from qd.run.judge import PANEL_FOLDER, config_of, judged_run, searched_policy
from qd.workers.evaluator import check_policy, open_evaluator, origin_of, resolve_device
from sim.files.atomic import prepare_output
from sim.files.command import InSpace, Where, Who, naming_what_is_next, publish
from sim.files.records import identity
from sim.files.settings import setting
from sim.policy.spec import controller_hash, controllers_of, is_same, who_crossed

if TYPE_CHECKING:
    from qd.evaluate.evaluate import Evaluate
    from qd.evaluate.sets import TerrainSet
    from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class MakePack(Who, InSpace, Where):
    """Make a pack of terrains from a run: faults and near-faults, to test any controller on.

    The terrains are spread over the ways in which the searched controller fails and over families of kin. Faults come
    first, and minimal terrains of the run are among them. Every controller crosses each terrain. pack.npz has the
    terrains. pack.json has the rates and what is known of each terrain. pack.png shows some of them. The run needs
    fresh episodes, confirmations and certificates. Crossings are kept, so the same command goes on after Ctrl-C.
    """

    run: Path | None = None
    """Run directory; the newest of the robot under runs/."""
    size: int = setting(100, least=1)
    """How many terrains. There are fewer if the run has fewer faults and near-faults."""
    controllers: tuple[str, ...] = ()
    """Controllers that cross them, each NAME=FILE, as --policy takes it. If left out, the shipped one as base, all of
    results/<robot>/*.pt, and the robot's panel. The searched controller is always among them."""
    episodes: int = setting(EPISODES, least=1)
    """Episodes on each terrain."""
    seed: int = setting(0, least=0)
    """Draws other episodes."""
    out: Path | None = None
    """Folder to write to; runs/<robot>-pack."""

    def execute(self) -> None:
        """Runs the command."""
        make_pack(self)


def make_pack(args: MakePack, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """Chooses terrains of a run, lets all controllers cross them, and writes the pack.

    Args:
        args: Which run and controllers, and where to work.
        open_evaluator: Opens what crosses terrains.

    Returns:
        The content of ``pack.json``.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If the run is damaged, or was not reevaluated, confirmed and certified, has nothing to take, its
            robot or controller is another now, or a controller does not fit.
        Interrupted: On Ctrl-C; what was crossed is kept.
        EvaluatorError: If a worker is lost; likewise.
    """
    from qd.evaluate.crossings import cross_all
    from qd.evaluate.pack_rates import grouped, over_all, rows_of
    from qd.evaluate.show import picture_of_pack, print_pack
    from sim.bank import heights_of
    from sim.space import get_space

    path, cfg, robot = config_of(args, args.run, args.space)
    policy = searched_policy(path, cfg, robot, args.policy, "packed")
    device = resolve_device(args.device, args.workers)
    controllers = _controllers(args.controllers, policy, robot)
    for name, one in controllers.items():
        _check_fits(name, one, robot, device)
    with judged_run(path, cfg, robot, "all") as judged:
        check_judged(judged.archive, path, robot)
        candidates = candidates_of(judged.archive, path, robot)
    chosen = choose(candidates.terrains, args.size)
    _tell_choice(candidates, len(chosen), args.size, path)
    space = get_space(cfg.space, cfg.space_sha256)
    if space.ground:
        raise ValueError(
            f"a pack holds heights alone, got terrains of {space.name} with {' and '.join(space.ground)} of their own: "
            "give a run without --ground"
        )
    heights = rounded(heights_of(np.array([one.genes for one in chosen]), space))
    own = evaluator_of_run(cfg, robot, policy, device, args.workers, num_envs=args.num_envs)
    evaluator = replace(own, num_replicas=args.episodes, num_terrains=len(chosen), lots=1)
    out = args.out or RUNS / f"{robot.name}-pack"
    prepare_output(out / TERRAINS_FILE)

    def measure() -> dict[str, Any]:
        terrains = _set_of(heights, len(heights), args.seed)
        crossed = cross_all(
            controllers, {"pack": terrains}, evaluator, _kept(robot), open_evaluator=open_evaluator
        )["pack"]  # fmt: skip
        rows = {who: rows_of(result) for who, result in crossed.items()}
        rates = [[np.nan if row["goal_rate"] is None else row["goal_rate"] for row in own] for own in rows.values()]
        more = {"controllers": np.array([*rows]), "goal_rates": np.array(rates).T, "robot": np.array(robot.name)}
        abouts = [one.about for one in chosen]
        return {
            **origin_of(device, args.seed, args.workers),
            **identity(robot, policy),
            "space": cfg.space,
            "space_sha256": cfg.space_sha256,
            "episodes": args.episodes,
            "searched": next(who for who, one in controllers.items() if is_same(one, policy)),
            "iterations": judged.archive.iterations,
            "panel": list(judged.archive.faults.certifiers) if judged.archive.faults else [],
            "candidates": len(candidates.terrains),
            "not_known_to_be_passable": candidates.not_passable,
            "controllers": {
                who: {"policy": Path(one).name, "sha256": controller_hash(one)} for who, one in controllers.items()
            },
            "rates": {who: over_all(own, abouts, args.seed) for who, own in rows.items()},
            "by": grouped(abouts, rows),
            "modes": [
                {"mode": mode.number, "ending": mode.ending, "marked_by": mode.marked_by}
                for mode in candidates.modes.modes
            ],
            "terrains_sha256": write_terrains(out, heights, chosen, more),
            "terrains": [
                about | {"rates": {who: own[place] for who, own in rows.items()}} for place, about in enumerate(abouts)
            ],
        }

    with naming_what_is_next("what is crossed is kept", lambda: "The same command goes on."):
        return publish(
            out / PACK_FILE, measure, print_pack,
            draw=lambda report: picture_of_pack(report["terrains"], heights, report["searched"], robot.name),
        )  # fmt: skip


def evaluate_pack(flags: "Evaluate", *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """Tests one controller on a pack: prints what fails beside the rates of the pack's controllers, writes it.

    Args:
        flags: Which pack and controller, and where to work.
        open_evaluator: Opens what crosses terrains.

    Returns:
        The content of the result file.

    Raises:
        FileNotFoundError: If there is no pack.
        ValueError: If it is damaged or of another robot, the controller does not fit, or a flag does not go with it.
        Interrupted: On Ctrl-C.
        EvaluatorError: If a worker is lost.
    """
    from qd.evaluate.crossings import cross_all
    from qd.evaluate.evaluate import evaluator_of
    from qd.evaluate.pack_rates import grouped, over_all, rows_of
    from qd.evaluate.show import picture_of_pack, print_pack_test
    from sim.robots.robot import robot_of

    assert flags.pack is not None
    of_terrains = (flags.space, flags.ground, flags.run_dir, flags.split_seed or None)
    if flags.makes_tables or any(one is not None for one in of_terrains):
        raise ValueError(
            "a pack is crossed by one controller and has its own terrains, got another flag of tables or terrains "
            "beside --pack: leave out --policies, --archive, --sets, --split-seed, --run-dir, --space and --ground, "
            "and give --policy"
        )
    folder = pack_folder(flags.pack)
    pack = read_pack(folder)
    robot = robot_of(pack.content, flags.robot, folder / PACK_FILE, flag="pack")
    policy = str(flags.policy or robot.policy_file)
    evaluator = replace(evaluator_of(flags, robot, (len(pack), EPISODES)), policy=policy)
    check_policy(policy, robot, evaluator.device)
    terrains = _set_of(pack.heights, min(evaluator.num_terrains, len(pack)), flags.seed)
    who = who_crossed(robot, policy)
    out = flags.out or RUNS / f"{who}-pack.json"
    abouts = pack.terrains[: len(terrains)]

    def measure() -> dict[str, Any]:
        result = cross_all(
            {who: policy}, {"pack": terrains}, evaluator, _kept(robot), open_evaluator=open_evaluator
        )["pack"][who]  # fmt: skip
        own = rows_of(result)
        beside = {name: [about["rates"][name] for about in abouts] for name in pack.content["rates"]}
        return {
            **origin_of(evaluator.device, flags.seed, flags.workers),
            **identity(robot, policy),
            "episodes": evaluator.num_replicas,
            "pack": _about_pack(pack),
            "rates": over_all(own, abouts, flags.seed),
            "beside": {name: over_all(rows, abouts, flags.seed) for name, rows in beside.items()},
            "by": grouped(abouts, {_OWN: own, **beside}),
            "terrains": [about | {"rates": {_OWN: row}} for about, row in zip(abouts, own, strict=True)],
        }

    with naming_what_is_next("what is crossed is kept", lambda: "The same command goes on."):
        return publish(
            out, measure, lambda report: print_pack_test(report, folder),
            draw=lambda report: picture_of_pack(report["terrains"], pack.heights, _OWN, who),
        )  # fmt: skip


_OWN = "this"  # the controller that is tested, beside those of the pack


def _about_pack(pack: Pack) -> dict[str, Any]:
    names = ("robot", "robot_sha256", "terrains_sha256", "episodes", "seed", "searched", "modes")
    return {**{name: pack.content[name] for name in names}, "folder": pack.folder.name, "terrains": len(pack)}


def _controllers(named: Sequence[str], searched: str, robot: "RobotCfg") -> dict[str, str]:
    """Who crosses a pack, by name; the searched controller first where nobody names it."""
    found = controllers_of(named, robot)
    if not named:
        folder = RESULTS / robot.name
        for file in (*sorted(folder.glob("*.pt")), *sorted((folder / PANEL_FOLDER).glob("*.pt"))):
            if not any(is_same(str(file), one) for one in found.values()):
                name = file.stem if file.stem not in found else f"{file.parent.name}-{file.stem}"
                found[name] = str(file)
    return found if any(is_same(searched, one) for one in found.values()) else {"searched": searched, **found}


def _check_fits(name: str, policy: str, robot: "RobotCfg", device: str) -> None:
    try:
        check_policy(policy, robot, device)
    except ValueError as error:
        raise ValueError(f"controller {name} does not fit {robot.name}: {error}") from error


def _tell_choice(candidates: Candidates, count: int, size: int, path: Path) -> None:
    """Says how many terrains there are, and what was left out.

    Raises:
        ValueError: If there is none.
    """
    rest = f"failing terrains that nobody is known to cross: {candidates.not_passable:,}"
    if not count:
        raise ValueError(
            f"{path} must have faults or near-faults to make a pack of, got none, and {rest}: let its search go on, or "
            "certify with more controllers (`faultline certify --by NAME=FILE`)"
        )
    told = f"Faults and near-faults in {path}: {len(candidates.terrains):,}, of which the pack has {count:,}"
    print(f"{told}, {size:,} were asked for." if count < size else f"{told}.")
    print(f"Left out, {rest}.", flush=True)


def _kept(robot: "RobotCfg") -> Path:
    """Where crossings of packs are kept until they are reported."""
    return RUNS / f"{robot.name}-packs" / "crossings"


def _set_of(heights: NDArray[np.float32], count: int, seed: int) -> "TerrainSet":
    """The first terrains of a pack, with episodes that nothing else has."""
    from qd.evaluate.sets import TerrainSet, set_rng

    seeds = set_rng("pack", seed).integers(2**32, size=len(heights), dtype=np.uint32)
    return TerrainSet(name="pack", terrains=heights[:count], seeds=seeds[:count], numbers=np.arange(count))
