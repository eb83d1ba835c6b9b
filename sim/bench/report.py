"""The benchmark as a whole: scene, rows, shares of the step, and the table."""

import re
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
import warp as wp

from sim.bench.cases import Case, make_cases
from sim.bench.ceiling import BOUND_BY_RULE, Ceiling, measure_ceiling
from sim.bench.checks import Truth
from sim.bench.physics import measure_step
from sim.bench.scene import build_scene
from sim.bench.timing import TimingCfg, Variant, fit_launches, repeat_torch, repeat_warp, time_in_turns
from sim.commands import Bench
from sim.files.records import identity
from sim.policy.loaders import prepare_torch, reason_of
from sim.robots.robot import RobotCfg

_FLUSH_BYTES = 256 << 20
"""More than any cache holds."""
_FLUSHED_LAUNCHES = 20


def _torch_variants(
    case: Case, device: str, timing: TimingCfg, *, compiled: bool
) -> tuple[dict[str, Variant], str | None]:
    """The counterpart as it is and through ``torch.compile``, or why that is missing.

    A compiler can fail with anything (on the CPU it needs one for C++): the column is then empty and says why.
    """

    def variant(call: Callable[..., Any]) -> Variant:
        return fit_launches(partial(repeat_torch, partial(call, *case.arguments), device=device), device, timing)

    found = {"torch": variant(case.counterpart)}
    if not compiled:
        return found, "not asked for"
    try:
        found["torch_compile"] = variant(torch.compile(case.counterpart, dynamic=False, fullgraph=True))
    except Exception as error:
        return found, f"{type(error).__name__}: {reason_of(error)}"[:300]
    return found, None


def _time_cold(case: Case, device: str, timing: TimingCfg) -> float:
    """Seconds a launch with the caches overwritten before each: its inputs come from memory, as in a whole step.

    The time of overwriting alone is subtracted.
    """
    flushed: Any = wp.zeros(_FLUSH_BYTES // 4, dtype=float, device=device)

    def flush_and_launch() -> None:
        flushed.zero_()
        case.launch()

    pair = {
        "both": repeat_warp(flush_and_launch, _FLUSHED_LAUNCHES, device),
        "flush": repeat_warp(flushed.zero_, _FLUSHED_LAUNCHES, device),
    }
    seconds = time_in_turns(pair, device, timing)
    return seconds["both"] - seconds["flush"]


def measure_case(case: Case, ceiling: Ceiling, device: str, timing: TimingCfg, *, compiled: bool) -> dict[str, Any]:
    """One row of the results.

    Raises:
        OutputError: If an output of any variant is not what the oracle says.
    """
    case.check_ours()
    variants, failure = _torch_variants(case, device, timing, compiled=compiled)
    for name, variant in variants.items():
        variant.replay()
        case.check_torch(name, variant.outputs[0])
    variants["ours"] = fit_launches(partial(repeat_warp, case.launch, device=device), device, timing)
    seconds = time_in_turns(variants, device, timing)
    case.check_ours()  # and still after all those launches
    cold = max(_time_cold(case, device, timing), seconds["ours"]) if device.startswith("cuda") else None
    by_compile = seconds.get("torch_compile")
    return {
        "kernel": case.name,
        "ours_ms": seconds["ours"] * 1e3,
        "torch_ms": seconds["torch"] * 1e3,
        "torch_compile_ms": None if by_compile is None else by_compile * 1e3,
        "speedup": seconds["torch"] / seconds["ours"],
        "speedup_compile": None if by_compile is None else by_compile / seconds["ours"],
        **ceiling.judge(case.work, seconds["ours"]),
        "ours_cold_ms": None if cold is None else cold * 1e3,
        "per_control_step": case.per_control_step,
        "part_of": case.part_of,
        "torch_compile_failure": failure,
        **asdict(case.work),
    }


def sizes_of(cfg: Bench, device: str) -> tuple[int, int, TimingCfg]:
    """Environments, terrains and timing asked for; else the paper's iteration on CUDA, one CPU process otherwise."""
    on_gpu = device.startswith("cuda")
    num_envs, num_terrains, rounds, replay_s = (4096, 200, 20, 2e-3) if on_gpu else (16, 8, 10, 10e-3)
    timing = TimingCfg(rounds=cfg.rounds or rounds, replay_s=replay_s)
    return cfg.num_envs or num_envs, cfg.num_terrains or num_terrains, timing


def file_of(device_name: str) -> Path:
    """Where numbers go by default: ``runs/bench/nvidia-h200.json`` for an NVIDIA H200, ``cpu.json`` for any CPU.

    A measurement made in passing does not replace the published one.
    """
    name = "cpu" if device_name.startswith("CPU") else re.sub(r"[^a-z0-9]+", "-", device_name.lower()).strip("-")
    return Path("runs") / "bench" / f"{name}.json"


def add_shares(rows: list[dict[str, Any]], step_ms: float) -> float:
    """Give every row its share of a control step of ``step_ms``; returns their sum, no work counted twice.

    On CUDA a kernel counts with the time it takes from memory: in a step the solver has emptied the caches before it.
    """
    for row in rows:
        ms = row["ours_ms"] if row["ours_cold_ms"] is None else row["ours_cold_ms"]
        row["share_of_step"] = row["per_control_step"] * ms / step_ms
    return sum(row["share_of_step"] for row in rows if row["part_of"] is None)


def measure(robot: RobotCfg, cfg: Bench, device: str) -> dict[str, Any]:
    """Checks and times everything.

    Returns:
        The results file without its provenance.

    Raises:
        OutputError: If a kernel or its counterpart disagrees with the oracle; nothing is reported then.
    """
    num_envs, num_terrains, timing = sizes_of(cfg, device)
    prepare_torch(device)
    print(f"walking {num_envs} robots on {num_terrains} terrains for {cfg.walk_s:g} s")
    scene = build_scene(
        robot, device, num_envs=num_envs, num_terrains=num_terrains, walk_s=cfg.walk_s, duration_s=cfg.duration_s,
        seed=cfg.seed,
    )  # fmt: skip
    ceiling = measure_ceiling(device, timing)
    rows = []
    for case in make_cases(scene, Truth(scene)):
        rows.append(measure_case(case, ceiling, device, timing, compiled=cfg.compile))
        print(f"  {case.name}: checked and timed", flush=True)
    replays = 3 if device.startswith("cuda") else 5
    step, collision = measure_step(scene, rounds=replays, heightfield=cfg.heightfield)
    share = add_shares(rows, step["ours_ms"])
    return {
        **identity(robot, robot.policy_file),
        "num_envs": num_envs,
        "num_terrains": num_terrains,
        "rows": [*rows, step],
        "share_of_step": share,
        "bound_by_rule": BOUND_BY_RULE,
        "ceiling": asdict(ceiling),
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
