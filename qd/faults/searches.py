"""A search whose elites are judged, and the other controllers that may certify them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from qd.faults.numbers import SEARCHED
from qd.search.archive import Archive, read_archive
from qd.search.directory import RunDirectory, check_config, check_space
from qd.search.settings import SearchCfg, as_settings, find_policy, is_searched
from qd.workers.compute import check_policy
from sim.controllers.spec import controller_hash, resolve_policy, weights_file
from sim.robots.find import resolve_robot
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import load_space

CERTIFIERS_FOLDER = "certifiers"  # folder of a run that holds certifiers trained for it, <name>.pt


@dataclass(frozen=True, kw_only=True)
class Search:
    """A search with its robot, controller and terrain space as they are now."""

    run: Path
    cfg: SearchCfg
    robot: RobotCfg
    policy: str  # the controller that was searched, as sim.controllers.loaders.load_policy takes it
    space: TerrainSpace

    def read_archive(self) -> Archive:
        """Its archive, which must fit the settings beside it."""
        archive = read_archive(self.run)
        check_config(archive, self.cfg, self.run)
        check_space(archive, None)
        return archive


def find_search(run: Path, *, robot: str | None = None, policy: str | None = None, space: str | None = None) -> Search:
    """The search of a run; what has moved, or is code, must be named: a robot's settings, a controller, a space."""
    cfg = RunDirectory(run).read_cfg()
    if space is not None:
        load_space(space)  # a user's space, which the run's name then finds
    robot_cfg = resolve_robot(as_settings(cfg), robot, run)
    controller = find_policy(run, cfg, robot_cfg) if policy is None else resolve_policy(policy, robot_cfg)
    if not is_searched(cfg, controller, robot_cfg):
        raise ValueError(f"policy must be the controller that was searched, {cfg.policy}, got {policy}: leave it out")
    return Search(run=run, cfg=cfg, robot=robot_cfg, policy=controller, space=cfg.terrain_space)


def controllers_in(folder: Path) -> dict[str, str]:
    """Controllers of a folder by name: descriptions, ``<name>.toml``, and weights without one, ``<name>.pt``."""
    described = sorted(folder.glob("*.toml"))
    weights = sorted({*folder.glob("*.pt")} - {*map(weights_file, described)})
    return {file.stem: str(file) for file in sorted([*weights, *described])}


def find_certifiers(search: Search) -> dict[str, str]:
    """Certifiers of a search by name: those of the robot's panel and of the run, without the searched controller."""
    certifiers = controllers_in(search.robot.panel) | controllers_in(search.run / CERTIFIERS_FOLDER)
    return {name: file for name, file in certifiers.items() if not is_searched(search.cfg, file, search.robot)}


def check_certifiers(certifiers: Mapping[str, str], search: Search, device: str) -> None:
    """Tries each certifier on the robot; refuses the searched controller, which cannot certify itself."""
    for name, policy in certifiers.items():
        if name == SEARCHED:
            raise ValueError(f"certifier {name} must have another name: so is the searched controller called")
        if controller_hash(policy) is None:
            rule = f"certifier {name} must have a file, by whose hash certificates name it"
            raise ValueError(f"{rule}, got {policy}, where there is none: give the path of one")
        if is_searched(search.cfg, policy, search.robot):
            raise ValueError(f"certifier {name} must be another controller than the searched one, got {policy}")
        check_fits(name, policy, search.robot, device)


def check_fits(name: str, policy: str, robot: RobotCfg, device: str) -> None:
    """Tries a certifier on a robot."""
    try:
        check_policy(policy, robot, device)
    except ValueError as error:
        raise ValueError(f"certifier {name} does not fit {robot.name}: {error}") from error
