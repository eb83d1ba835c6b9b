"""Each case checked and timed: ours, torch and compiled torch in turns; on CUDA ours once more with cold caches."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import torch
import warp as wp

from sim.bench.cases import Case
from sim.bench.ceiling import Ceiling
from sim.bench.timing import TimingCfg, Variant, fit_launches, repeat_torch, repeat_warp, time_in_turns
from sim.policy.loaders import reason_of

_FLUSH_BYTES = 256 << 20
"""More than any cache holds."""
_FLUSHED_LAUNCHES = 20


def _torch_variant(call: Callable[..., Any], case: Case, device: str, timing: TimingCfg) -> Variant:
    make = partial(repeat_torch, partial(call, *case.arguments), device=device)
    return fit_launches(make, device, timing)


def compile_variant(case: Case, device: str, timing: TimingCfg) -> tuple[Variant | None, str | None]:
    """The counterpart through ``torch.compile``, or why there is none.

    A compiler can fail with anything (on the CPU it needs one for C++): the column is then empty and says why.
    """
    try:
        compiled = torch.compile(case.counterpart, dynamic=False, fullgraph=True)
        return _torch_variant(compiled, case, device, timing), None
    except Exception as error:
        return None, f"{type(error).__name__}: {reason_of(error)}"[:300]


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

    Args:
        case: The kernel.
        ceiling: What the device can do.
        device: Warp device name.
        timing: How long.
        compiled: Whether to compile the counterpart too.

    Raises:
        OutputError: If an output of any variant is not what the oracle says.
    """
    case.check_ours()
    variants = {"torch": _torch_variant(case.counterpart, case, device, timing)}
    compiled_variant, failure = compile_variant(case, device, timing) if compiled else (None, "not asked for")
    if compiled_variant is not None:
        variants["torch_compile"] = compiled_variant
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
        **asdict(ceiling.judge(case.work, seconds["ours"])),
        "ours_cold_ms": None if cold is None else cold * 1e3,
        "per_control_step": case.per_control_step,
        "part_of": case.part_of,
        "torch_compile_failure": failure,
        **asdict(case.work),
    }
