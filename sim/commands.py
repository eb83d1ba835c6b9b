"""The commands about robots, controllers and the simulation: their options, and what each calls.

Modules with Warp, torch or Newton are imported inside ``execute``, so that ``--help`` answers at once.
"""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from sim.files.command import DeviceFlag, RobotFlag
from sim.files.settings import NonNegativeInt, PositiveInt


@dataclass(frozen=True, kw_only=True)
class Stand(RobotFlag, DeviceFlag):
    """Look at a robot before anything is searched or trained.

    It prints its joints and geoms as they were read, whether it stands in its default pose, and how many contacts and
    constraint rows it needs when it lies on rough ground. The exit status is 1 if something must be mended.
    """

    seconds: Annotated[float, Meta(gt=0, le=60)] = 3.0
    """How long it stands, and lies [s]."""
    drops: PositiveInt = 32
    """Robots dropped in random poses on hard-random terrain."""
    seed: NonNegativeInt = 0
    """Draws poses and terrains."""

    def execute(self) -> int:
        """Prints what was found; returns 1 if something has to be mended."""
        from sim.device import resolve_device
        from sim.robots.find import get_robot
        from sim.robots.stand import describe_model, describe_standing, stand

        robot = get_robot(self.robot)
        print(describe_model(robot), flush=True)
        device = resolve_device(self.device)
        standing = stand(robot, device=device, seconds=self.seconds, drops=self.drops, seed=self.seed)
        text, fine = describe_standing(robot, standing)
        print(text)
        return 0 if fine else 1
