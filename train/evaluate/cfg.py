"""What a command line of the evaluation means."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from qd.workers.evaluator import resolve_device
from sim.robots.robot import RobotCfg, get_robot
from train.evaluate.sets import paper_terrains

FULL = (300, 20)
"""Terrains a set and episodes a terrain of the published rates; tables take the paper's number of terrains."""
SMALL = (24, 4)
"""The same on a machine without a GPU."""


@dataclass(frozen=True, kw_only=True)
class EvaluateCfg:
    """Cross fresh terrains with one controller, or make the paper's tables of several.

    The tables are made if --policies, --archive or --sets is given; killed, they go on by the same command.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    policy: str | None = None
    """Without tables, the controller: a checkpoint, a TorchScript or ONNX file, file.py:callable, module:callable, or
    file.py:adapter@FILE; the shipped one."""
    policies: tuple[str, ...] = ()
    """Controllers of the tables, each NAME=FILE, NAME=file.py:callable, NAME=module:callable or NAME=shipped; the first
    is the one that the others are held against; base=shipped. C-G, C-G@1, C-G@2 are one kind of several seeds, whose
    mean is shown too."""
    archive: Path | None = None
    """Run of a search, or its archive.npz: its held-out elites are the generated terrains."""
    split_seed: int = 0
    """Which elites are held out: what the fine-tuning was told."""
    sets: tuple[str, ...] = ()
    """Sets of the tables: hand_crafted, hard_random and, of an archive, generated and generated_far; all there are."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    terrains: int | None = None
    """Terrains a set; 300 on CUDA (tables of Cassie: 180), 24 on the CPU."""
    episodes: int | None = None
    """Episodes a terrain; 20 on CUDA, 4 on the CPU."""
    seed: int = 0
    """Draws other test sets."""
    workers: int | Literal["auto"] | None = None
    """Cross on so many Ray workers, a GPU or a CPU core each; auto: as many as there are."""
    out: Path | None = None
    """Where to write the numbers: runs/<robot>-rates.json, of another controller than the shipped
    runs/<robot>-<its name>-rates.json; tables RUN_DIR/tables.json, their figure beside as .png."""
    run_dir: Path | None = None
    """Where tables keep what is crossed, so that they can go on; runs/<robot>-tables."""

    @property
    def makes_tables(self) -> bool:
        """Whether the paper's tables are asked for."""
        return bool(self.policies or self.sets or self.archive is not None)


@dataclass(frozen=True, kw_only=True)
class Size:
    """How much is crossed, by what, where."""

    robot: RobotCfg
    device: str
    """Warp device name."""
    terrains: int
    """Terrains a set."""
    episodes: int
    """Episodes a terrain."""


def size_of(cfg: EvaluateCfg) -> Size:
    """How much is crossed; says so where it is less than on a GPU.

    Raises:
        ValueError: If robot or device is unknown, or a number is out of range.
    """
    robot = get_robot(cfg.robot)
    for name, least in (("terrains", 1), ("episodes", 1), ("seed", 0), ("split_seed", 0)):
        value = getattr(cfg, name)
        if value is not None and value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    device = resolve_device(cfg.device, cfg.workers)
    full = (paper_terrains(robot.name), FULL[1]) if cfg.makes_tables else FULL
    terrains, episodes = full if device.startswith("cuda") else SMALL
    if not device.startswith("cuda") and cfg.terrains is None and cfg.episodes is None:
        print(f"No GPU: {terrains} terrains x {episodes} episodes a set instead of {full[0]} x {full[1]}.")
    return Size(robot=robot, device=device, terrains=cfg.terrains or terrains, episodes=cfg.episodes or episodes)
