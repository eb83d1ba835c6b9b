"""How a new search starts: a robot that is ready for it, a terrain space at its height, and settings by a preset."""

from qd.check import ensure_ready
from qd.search.settings import SearchCfg, preset
from qd.workers.compute import Compute
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.registry import at_height, load_space, space_at


def start_search(
    robot: str | None, policy: str | None, space: str | None, *, size: str, height: float | None, compute: Compute
) -> tuple[SearchCfg, RobotCfg]:
    """Settings of a new search by the name of a preset, and its robot, which is checked and has penalty scales then.

    Robot, controller and space are as flags take them. ``height`` is the largest one of a bump [m]; None is that which
    fits the robot.
    """
    terrain_space = load_space(space)
    if height is not None:
        terrain_space = at_height(terrain_space, height)
    ready = ensure_ready(get_robot(robot), policy, compute)
    terrain_space = space_at(terrain_space, height, ready)
    cfg = preset(size, ready, policy, space=terrain_space.name, space_sha256=terrain_space.sha256)
    return cfg, ready
