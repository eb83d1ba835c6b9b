"""Time every kernel against torch and against the best the device can do: ``python -m sim.bench --device cuda:0``.

Robots are walked into gene terrains by the shipped controller; every output is held against a float64 oracle first.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from sim.bench.report import file_of, measure, preset, table
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import exit_code_of
from sim.files.provenance import provenance
from sim.robots.robot import get_robot
from sim.simulation import resolve_device


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Time the kernels against torch, torch.compile and the device's ceilings, and the step against bare physics."""

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    out: Path | None = None
    """Where to write the numbers; runs/bench/<device>.json by default."""
    num_envs: int | None = None
    """Robots: 4,096 on CUDA, 16 on the CPU."""
    num_terrains: int | None = None
    """Terrains they stand on: 200 on CUDA, 8 on the CPU."""
    rounds: int | None = None
    """Replays of each variant, of which the median counts."""
    duration_s: float | None = None
    """Simulated length of the crossings that time the whole step."""
    walk_s: float | None = None
    """Simulated time the robots walk before the kernels are timed."""
    compile: bool = True
    """Measure torch.compile too: a minute or two of compiling."""
    heightfield: bool = True
    """Measure the solver's own heightfield collision too."""
    seed: int = 0
    """Seed of terrains and starts."""


def run(args: Arguments) -> int:
    """Measure, print the table, write the file; returns the exit status.

    Raises:
        ValueError: If something asked for cannot be had, or an output is not what the oracle says.
    """
    robot, device = get_robot(args.robot), resolve_device(args.device)
    origin = provenance(device, args.seed)
    out = args.out or file_of(origin["device"])
    prepare_output(out)
    cfg = preset(device, seed=args.seed)
    sizes = {name: getattr(args, name) for name in ("num_envs", "num_terrains", "duration_s", "walk_s")}
    cfg = replace(
        cfg,
        scene=replace(cfg.scene, **{name: value for name, value in sizes.items() if value is not None}),
        timing=replace(cfg.timing, rounds=cfg.timing.rounds if args.rounds is None else args.rounds),
        compiled=args.compile,
        heightfield=args.heightfield,
    )
    report = {**origin, **measure(robot, cfg, device)}
    print(table(report))
    write_atomically(out, to_json(report))
    print(f"written to {out}")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    args = tyro.cli(Arguments, args=argv)
    return exit_code_of(lambda: run(args), stopped="Stopped; nothing was written.")


if __name__ == "__main__":
    sys.exit(main())
