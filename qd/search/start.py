"""How a new search starts: a robot that is ready for it, a terrain space at its height, and settings by a preset."""

from qd.check import ensure_ready
from qd.search.settings import SearchCfg, preset
from qd.workers.compute import Compute
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.registry import at_height, load_space, space_at


def start_search(
    robot: str | None,
    policy: str | None = None,
    *,
    compute: Compute,
    size: str = "small",
    space: str | None = None,
    height: float | None = None,
) -> tuple[SearchCfg, RobotCfg]:
    """Settings of a new search, and its robot, which is checked and has penalty scales then.

    Args:
        robot: Name or settings file, as ``--robot`` takes it.
        policy: Controller, as ``--policy`` takes it; the robot's own if None.
        compute: Where a robot without penalty scales is calibrated.
        size: Name of a preset.
        space: Terrain space, as ``--space`` takes it; the paper's if None.
        height: Largest height of a bump [m]; the one that fits the robot if None.
    """
    terrain_space = load_space(space)
    if height is not None:
        terrain_space = at_height(terrain_space, height)
    ready = ensure_ready(get_robot(robot), policy, compute)
    terrain_space = space_at(terrain_space, height, ready)
    cfg = preset(size, ready, policy, space=terrain_space.name, space_sha256=terrain_space.sha256)
    return cfg, ready
