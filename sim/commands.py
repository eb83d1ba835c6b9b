"""The commands about robots, controllers and the simulation: their options, and what each calls.

Modules with Warp, torch or Newton are imported inside ``execute``, so that ``--help`` answers at once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from sim.files.command import OfRobot, OnDevice, Who
from sim.files.settings import NonNegativeInt, PositiveInt


@dataclass(frozen=True, kw_only=True)
class Stand(OfRobot, OnDevice):
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


@dataclass(frozen=True, kw_only=True)
class ExportPolicy(Who):
    """Write a controller as one ONNX file, weights inside, for any batch size.

    Input `observation` (batch, observation_size) and output `action` (batch, num_joints), float32. The controller must
    be an rsl_rl checkpoint, such as the policy.pt of a training run.
    """

    out: Path = Path("policy.onnx")
    """File to write."""

    def execute(self) -> None:
        """Writes the file and says what it holds."""
        from sim.policy.loaders import load_checkpoint
        from sim.policy.onnx import export_onnx
        from sim.robots.find import get_robot

        robot = get_robot(self.robot)
        export_onnx(load_checkpoint(self.policy or robot.policy_file, robot), self.out)
        print(f"written to {self.out}")
