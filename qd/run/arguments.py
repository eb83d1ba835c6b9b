"""What the commands about a run share: what evaluates its elites, and whether certifiers fit."""

from collections.abc import Mapping

from qd.run.settings import SearchCfg, is_searched
from qd.workers.evaluator import EvaluatorCfg, check_policy
from sim.policy.spec import controller_hash
from sim.robots.robot import RobotCfg
from sim.spaces.registry import get_space


def check_certifiers(certifiers: Mapping[str, str], cfg: SearchCfg, robot: RobotCfg, device: str) -> None:
    """Tries certifiers on the robot; the controller of the search, or one that is there twice, is refused."""
    names: dict[str | None, str] = {}
    for name, policy in certifiers.items():
        if is_searched(cfg, policy, robot):
            raise ValueError(f"certifier {name} ({policy}) is searched itself: a controller cannot certify itself")
        digest = controller_hash(policy)
        if digest in names:
            raise ValueError(f"certifiers {names[digest]} and {name} are the same controller: leave one of them out")
        names |= {} if digest is None else {digest: name}
        try:
            check_policy(policy, robot, device)
        except ValueError as error:
            raise ValueError(f"certifier {name} does not fit {robot.name}: {error}") from error


def evaluator_of(
    cfg: SearchCfg, robot: RobotCfg, policy: str, device: str, workers: str | None, *, num_envs: int | None = None
) -> EvaluatorCfg:
    """What evaluates the elites of a search, with a controller that is tried here."""
    check_policy(policy, robot, device)
    return EvaluatorCfg(
        robot=robot, policy=policy, num_terrains=cfg.scheduler.num_terrains, num_replicas=cfg.replicas, device=device,
        workers=workers, num_envs=num_envs, space=get_space(cfg.space, cfg.space_sha256).name,
    )  # fmt: skip
