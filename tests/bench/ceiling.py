"""What a device can do at best, measured: copies, multiply-adds, exponentials, and launches that do nothing.

Copies are measured at many sizes, because what fits in a cache moves faster than memory can. A kernel's ceiling is the
fastest copy of at least as many bytes as it must move: as near to the processor as its own data may be, and without the
launch, which would hold back a small copy as it does a small kernel.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import warp as wp

from tests.bench.timing import Timing, fit_launches, repeat_torch, repeat_warp, time_in_turns

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

    copies: dict[int, float]
    """Bytes a second, read and written, by bytes moved."""
    flops_per_s: float
    """Single-precision multiplications and additions a second."""
    specials_per_s: float
    """Single-precision exponentials a second."""
    launch_s: float
    """Time of an empty kernel in a captured graph [s]."""

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
        nearest = max(shares, key=lambda name: shares[name])
        if shares[nearest] >= BOUND_SHARE:
            return shares[nearest], nearest
        return shares[nearest], "launch" if self.launch_s / seconds >= LAUNCH_SHARE else "latency"


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
