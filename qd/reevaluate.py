"""All elites of a run again: its archive, numbers and figures as 40 fresh episodes of each elite correct them."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.archive import Archive
from qd.fresh import Open, corrected
from qd.run.arguments import evaluator_of
from qd.run.cli import naming_what_is_next, run_command
from qd.run.directory import CONFIG_FILE, RunDirectory, archive_of, claimed
from qd.run.next_commands import next_command
from qd.run.places import newest_run
from qd.run.resuming import origin_in, refuse_unnamed_code
from qd.run.settings import SearchCfg, as_settings, file_hash, policy_spec
from qd.search import write_results
from qd.workers.evaluator import open_evaluator, origin_of, resolve_device
from sim.policy.spec import SHIPPED

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class ReevaluateCfg:
    """Evaluate every elite of a run again with 40 fresh episodes.

    An elite is the best of many noisy evaluations; its fresh episodes say what it is worth. The run's archive, numbers
    and figures are written again with them, elites by descending corrected fitness.
    """

    robot: str | None = None
    """Which robot the run is of; left out, whatever shipped one --run is of. The settings file of one that is not."""
    run: Path | None = None
    """Run directory; the newest of the robot, or of anymal, under runs/."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    workers: str | None = None
    """Who works: a number of processes on the CPU (one a core if left out), ray for every device of a Ray cluster, or
    ray:N for N of them. RAY_ADDRESS names a running cluster."""
    policy: str | None = None
    """Controller to evaluate with, even another than the run's; by default the run's, unless its file has changed."""
    seed: int | None = None
    """Seed of the fresh episodes; the run's."""


def reevaluate_run(args: ReevaluateCfg, *, open_evaluator: Open = open_evaluator) -> Archive:
    """The command.

    Args:
        args: What to evaluate again, and where.
        open_evaluator: Opens what crosses the terrains.

    Returns:
        The corrected archive.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If the run is damaged or empty, its controller is another now, or an argument is not as it must be.
        Interrupted: On Ctrl-C; the run is as it was.
        EvaluatorError: If a worker is lost; likewise.
    """
    from sim.robots.robot import get_robot, robot_of

    path = args.run or newest_run(get_robot(args.robot or "anymal"))
    run = RunDirectory(path)
    config, cfg = run.read_config(), run.read_cfg()
    robot = robot_of(cfg.robot, args.robot, path)
    seed = cfg.seed if args.seed is None else args.seed
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    device = resolve_device(args.device, args.workers)
    policy = args.policy or _own_policy(path, cfg, robot)
    evaluator = evaluator_of(cfg, robot, policy, device, args)
    again = next_command("reevaluate", args, robot=robot.spec, run=path, policy=args.policy, seed=args.seed)
    with claimed(path):
        loaded = run.load(as_settings(cfg))
        if loaded is None:
            raise ValueError(f"{path} has no finished iteration, expected at least one: go on with it (--resume)")
        search, metrics = loaded
        found = archive_of(as_settings(cfg), search, len(metrics))
        with naming_what_is_next(f"{path} is as it was", lambda: f"Start again with:  {again}"):
            archive = corrected(found, cfg, evaluator, open_evaluator, seed)
        by = origin_of(device, seed, args.workers) | _given_policy(args)
        with naming_what_is_next("some files may not be written", lambda: f"Start again with:  {again}"):
            write_results(run, archive, metrics, {**origin_in(config), "reproduced_by": by})
    return archive


def _own_policy(path: Path, cfg: SearchCfg, robot: "RobotCfg") -> str:
    """The run's own controller, which must be what it was."""
    refuse_unnamed_code(cfg.policy, None, path)
    policy = policy_spec(cfg, robot)
    digest = file_hash(policy)
    if digest != cfg.policy_sha256:
        what = "the shipped controller" if cfg.policy == SHIPPED else f"the controller in {policy}"
        state = "lost" if digest is None else "another one now"
        raise ValueError(
            f"{path / CONFIG_FILE}: the run was searched with {what}, which is {state} (expected SHA-256 "
            f"{cfg.policy_sha256}, got {digest}): put it back, or say with --policy which one to evaluate with"
        )
    return policy


def _given_policy(args: ReevaluateCfg) -> dict[str, Any]:
    """For the results: the controller, where it was given."""
    if args.policy is None:
        return {}
    return {"policy": args.policy, "policy_sha256": file_hash(args.policy)}


def main(args: ReevaluateCfg) -> None:
    """The command."""
    reevaluate_run(args)


if __name__ == "__main__":
    run_command(ReevaluateCfg, main)
