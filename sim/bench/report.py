"""The benchmark as a whole: scene, rows, shares of the step, and the table."""

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sim.bench.cases import Case, make_cases
from sim.bench.ceiling import BOUND_BY_RULE, measure_ceiling
from sim.bench.checks import Truth
from sim.bench.measure import measure_case
from sim.bench.scene import SceneCfg, build_scene
from sim.bench.step import measure_step
from sim.bench.timing import TimingCfg
from sim.policy.loaders import prepare_torch
from sim.robots.robot import RobotCfg

_RUNS = Path("runs") / "bench"  # a measurement made in passing does not replace the published one


@dataclass(frozen=True, kw_only=True)
class BenchCfg:
    """What is measured, and for how long."""

    scene: SceneCfg
    timing: TimingCfg
    compiled: bool = True
    """Whether to measure torch.compile."""
    heightfield: bool = True
    """Whether to measure the solver's own heightfield collision."""
    replays: int = 3
    """Rounds of the replayed crossings, of which the median counts."""


def preset(device: str, *, seed: int) -> BenchCfg:
    """The sizes of the paper's iteration on CUDA, those of one CPU process otherwise."""
    if device.startswith("cuda"):
        return BenchCfg(scene=SceneCfg(num_envs=4096, num_terrains=200, seed=seed), timing=TimingCfg())
    return BenchCfg(
        scene=SceneCfg(num_envs=16, num_terrains=8, seed=seed), timing=TimingCfg(rounds=10, replay_s=10e-3), replays=5
    )


def file_of(device_name: str) -> Path:
    """Where numbers go by default: ``runs/bench/nvidia-h200.json`` for an NVIDIA H200, ``cpu.json`` for any CPU."""
    name = "cpu" if device_name.startswith("CPU") else re.sub(r"[^a-z0-9]+", "-", device_name.lower()).strip("-")
    return _RUNS / f"{name}.json"


def _measure_rows(cases: list[Case], cfg: BenchCfg, device: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    ceiling = measure_ceiling(device, cfg.timing)
    rows = []
    for case in cases:
        rows.append(measure_case(case, ceiling, device, cfg.timing, compiled=cfg.compiled))
        print(f"  {case.name}: checked and timed", flush=True)
    return rows, asdict(ceiling)


def add_shares(rows: list[dict[str, Any]], step_ms: float) -> float:
    """Give every row its share of a control step of ``step_ms``; returns their sum, no work counted twice.

    On CUDA a kernel counts with the time it takes from memory: in a step the solver has emptied the caches before it.
    """
    for row in rows:
        ms = row["ours_ms"] if row["ours_cold_ms"] is None else row["ours_cold_ms"]
        row["share_of_step"] = row["per_control_step"] * ms / step_ms
    return sum(row["share_of_step"] for row in rows if row["part_of"] is None)


def measure(robot: RobotCfg, cfg: BenchCfg, device: str) -> dict[str, Any]:
    """Check and time everything.

    Args:
        robot: Robot settings.
        cfg: Sizes and durations.
        device: Warp device name.

    Returns:
        What the results file holds beside where it comes from.

    Raises:
        OutputError: If a kernel or its counterpart disagrees with the oracle; nothing is reported then.
    """
    prepare_torch(device)
    print(f"walking {cfg.scene.num_envs} robots on {cfg.scene.num_terrains} terrains for {cfg.scene.walk_s:g} s")
    scene = build_scene(robot, cfg.scene, device)
    rows, ceiling = _measure_rows(make_cases(scene, Truth(scene)), cfg, device)
    step, collision = measure_step(scene, rounds=cfg.replays, heightfield=cfg.heightfield)
    share = add_shares(rows, step["ours_ms"])
    return {
        "robot": robot.name,
        "num_envs": cfg.scene.num_envs,
        "num_terrains": cfg.scene.num_terrains,
        "rows": [*rows, step],
        "share_of_step": share,
        "bound_by_rule": BOUND_BY_RULE,
        "ceiling": ceiling,
        "collision": collision,
    }


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}" if value < 1.0 else f"{value:.3f}"


def _times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}x"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.2f} %" if value < 0.01 else f"{100.0 * value:.1f} %"


def table(report: dict[str, Any]) -> str:
    """The results as text."""
    head = ("kernel", "ours ms", "cold ms", "torch ms", "compiled ms", "speed-up", "over compiled", "of ceiling")
    lines = [" ".join(f"{name:>13}" for name in head) + "    of step  bound by"]
    for row in report["rows"]:
        cells = [row["kernel"], _ms(row["ours_ms"]), _ms(row.get("ours_cold_ms")), _ms(row["torch_ms"])]
        cells += [_ms(row["torch_compile_ms"]), _times(row["speedup"]), _times(row["speedup_compile"])]
        cells += [_percent(row["ceiling_share"])]
        line = " ".join(f"{cell:>13}" for cell in cells)
        lines.append(f"{line} {_percent(row.get('share_of_step')):>10}  {row['bound_by']}")
    ceiling, collision = report["ceiling"], report["collision"]
    largest = ceiling["copies"][max(ceiling["copies"])]
    lines += [
        f"kernels together: {_percent(report['share_of_step'])} of a control step, {report['num_envs']} environments",
        f"ceilings: copies {largest / 1e9:,.0f} GB/s from memory, {max(ceiling['copies'].values()) / 1e9:,.0f} cached; "
        f"{ceiling['flops_per_s'] / 1e9:,.1f} GFLOP/s; {ceiling['specials_per_s'] / 1e9:,.2f} G exponentials/s; "
        f"launch {ceiling['launch_s'] * 1e6:.2f} us",
        f"bare physics: {collision['physics_steps_per_s']:,.0f} steps/s",
    ]
    if collision["physics_steps_per_s_solver_collision"] is not None:
        lines[-1] += (
            f"; with the solver's own heightfield collision {collision['physics_steps_per_s_solver_collision']:,.0f} "
            f"({collision['speedup']:.2f}x)"
        )
    lines += [
        f"no torch.compile of {row['kernel']}: {row['torch_compile_failure']}"
        for row in report["rows"]
        if row.get("torch_compile_failure") and row["torch_compile_ms"] is None
    ]
    return "\n".join(lines)
