"""Timing of captured work, and what a device can do at best: copies, multiply-adds, exponentials, empty launches.

Variants of a work are timed in turns, many launches a replay; the median of many rounds counts.

Copies are measured at many sizes, because what fits in a cache moves faster than memory can. A kernel's ceiling is the
fastest copy of at least as many bytes as it must move: as near to the processor as its own data may be, and without the
launch, which would hold back a small copy as it does a small kernel.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp

MAX_LAUNCHES = 200


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long to time."""

    rounds: int  # replays of each variant, in turns; the median counts
    replay_s: float  # wanted length of one replay [s]: as many launches as that takes, at most 200


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way of doing a work: ``replay()`` does it ``launches`` times."""

    replay: Callable[[], None]
    launches: int
    work: Callable[[], object]  # what one launch does; keeps the arrays alive of which a graph knows the addresses
    outputs: list[Any] = field(default_factory=list)  # of the last launch of torch; overwritten by each replay


def repeat_warp(launch: Callable[[], None], launches: int, device: str) -> Variant:
    """Warp launches in one captured graph, on CUDA and CPU alike."""
    with wp.ScopedDevice(device):
        launch()  # loads the kernels
        with wp.ScopedCapture() as capture:
            for _ in range(launches):
                launch()
    graph: Any = capture.graph

    def replay() -> None:
        with wp.ScopedDevice(device):
            wp.capture_launch(graph)

    return Variant(replay=replay, launches=launches, work=launch)


def repeat_torch(call: Callable[[], object], launches: int, device: str) -> Variant:
    """Calls of torch: in one captured graph on CUDA, on the stream that Warp uses too; in a plain loop on the CPU."""
    outputs: list[Any] = []

    @torch.no_grad()
    def call_all() -> None:
        for _ in range(launches):
            outputs[:] = [call()]

    if not device.startswith("cuda"):
        return Variant(replay=call_all, launches=launches, work=call, outputs=outputs)
    for _ in range(3):  # compiles, and lets the allocator and the autotuner settle
        call_all()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=torch.cuda.current_stream()):
        call_all()
    return Variant(replay=graph.replay, launches=launches, work=call, outputs=outputs)


def time_once(variant: Variant, device: str) -> float:
    """Seconds a launch in one replay, by the device's clock."""
    if device.startswith("cuda"):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        variant.replay()
        end.record()
        torch.cuda.synchronize()
        return start.elapsed_time(end) * 1e-3 / variant.launches
    began = time.perf_counter()
    variant.replay()
    return (time.perf_counter() - began) / variant.launches


def fit_launches(make: Callable[[int], Variant], device: str, cfg: Timing) -> Variant:
    """A variant with as many launches as fill ``cfg.replay_s``; ``make`` builds it for a number of them."""
    single = make(1)
    seconds = min(time_once(single, device) for _ in range(3))
    launches = max(1, min(MAX_LAUNCHES, round(cfg.replay_s / max(seconds, 1e-9))))
    return single if launches == 1 else make(launches)


def time_in_turns(variants: dict[str, Variant], device: str, cfg: Timing) -> dict[str, float]:
    """Median seconds a launch of each variant; all are replayed in every round, so that they share its conditions."""
    rounds = [[time_once(variant, device) for variant in variants.values()] for _ in range(cfg.rounds + 1)]
    return dict(zip(variants, np.median(rounds[1:], axis=0).tolist(), strict=True))  # the first warms up


CHAINS, UNROLLED = 8, 16
"""Independent chains of a thread, so that none waits for the result before; links of each a step."""
_Chains = wp.types.vector(CHAINS, float)


@wp.kernel
def do_nothing(out: wp.array[float]):
    """Grid (1,)."""
    out[0] = 0.0


@wp.func
def multiply_add(x: float) -> float:
    """Two flops."""
    return x * 0.999 + 0.001


@wp.func
def exponential(x: float) -> float:
    """One special function."""
    return wp.exp(-x)


def chains_of(link: Any) -> Any:
    """A kernel on a grid (num_threads,) that applies a function :data:`UNROLLED` times a step to each chain."""

    @wp.kernel(module="unique")
    def run_chains(steps: int, out: wp.array[float]):
        i = wp.tid()
        chains = _Chains()
        for c in range(wp.static(CHAINS)):
            chains[c] = float(i) * 1.0e-6 + 0.1 * float(c)
        for _step in range(steps):
            for _unrolled in range(wp.static(UNROLLED)):
                for c in range(wp.static(CHAINS)):
                    chains[c] = link(chains[c])
        for c in range(wp.static(CHAINS)):
            out[i] += chains[c]

    return run_chains


BOUND_SHARE = 0.25
LAUNCH_SHARE = 0.5
_STEPS = 64


@dataclass(frozen=True, kw_only=True)
class Work:
    """What must be done in one launch."""

    bytes: int
    flops: int
    specials: int = 0


@dataclass(frozen=True, kw_only=True)
class Ceiling:
    """Best rates of a device."""

    copies: dict[int, float]  # bytes a second, read and written, by bytes moved
    flops_per_s: float  # single-precision multiplications and additions a second
    specials_per_s: float  # single-precision exponentials a second
    launch_s: float  # time of an empty kernel in a captured graph [s]

    def bytes_per_s(self, moved: int) -> float:
        """Rate of the fastest copy of at least ``moved`` bytes."""
        return max([rate for size, rate in self.copies.items() if size >= moved] or [self.copies[max(self.copies)]])

    def judge(self, work: Work, seconds: float) -> tuple[float, str]:
        """How near work done in ``seconds`` comes to its nearest ceiling (1 is at it), and what bounds it.

        That is the ceiling itself (memory, arithmetic, special functions) from a share of ``BOUND_SHARE``; else launch
        if an empty launch takes at least ``LAUNCH_SHARE`` of the time; else latency: dependent loads, threads that
        part ways, or instructions beyond the work counted.
        """
        shares = {
            "memory": work.bytes / self.bytes_per_s(work.bytes) / seconds,
            "arithmetic": work.flops / self.flops_per_s / seconds,
            "special functions": work.specials / self.specials_per_s / seconds,
        }
        share, nearest = max(zip(shares.values(), shares, strict=True))
        if share < BOUND_SHARE:
            nearest = "launch" if self.launch_s / seconds >= LAUNCH_SHARE else "latency"
        return share, nearest


def launch(kernel: Any, out: Any, *inputs: int) -> None:
    """Launches one of the kernels above, one thread an entry of ``out``."""
    wp.launch(kernel, dim=out.shape[0], inputs=inputs, outputs=[out], device=out.device)


def measure_ceiling(device: str, timing: Timing) -> Ceiling:
    """Measures the best rates of a device, all in turns; torch works on Warp's stream already."""
    on_gpu = device.startswith("cuda")
    threads = 1 << 20 if on_gpu else 64
    out: Any = wp.zeros(threads, dtype=float, device=device)
    works = {
        "nothing": partial(launch, do_nothing, out[:1]),
        "flops": partial(launch, chains_of(multiply_add), out, _STEPS),
        "specials": partial(launch, chains_of(exponential), out, _STEPS),
    }
    makers = {name: partial(repeat_warp, work) for name, work in works.items()}
    # Bytes moved: 1 MB to 4 GB on CUDA, 16 KB to 64 MB on the CPU, in powers of 2.
    sizes = [1 << k for k in (range(20, 33) if on_gpu else range(14, 27))]
    for size in sizes:
        source, target = (torch.zeros(size // 8, dtype=torch.float32, device=wp.to_torch(out).device) for _ in range(2))
        makers[str(size)] = partial(repeat_torch, partial(target.copy_, source))
    variants = {name: fit_launches(partial(make, device=device), device, timing) for name, make in makers.items()}
    seconds = time_in_turns(variants, device, timing)
    links = threads * _STEPS * CHAINS * UNROLLED
    return Ceiling(
        copies={size: size / seconds[str(size)] for size in sizes},
        flops_per_s=2 * links / seconds["flops"],
        specials_per_s=links / seconds["specials"],
        launch_s=seconds["nothing"],
    )
