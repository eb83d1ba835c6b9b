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

FLOPS_PER_STEP = 2 * 8 * 16
"""Multiplications and additions that :func:`multiply_add` does a step and thread."""
SPECIALS_PER_STEP = 4 * 4
"""Exponentials that :func:`exponentials` computes a step and thread."""


@wp.kernel
def do_nothing(out: wp.array[float]):
    """Grid (1,)."""
    out[0] = 0.0


@wp.kernel
def multiply_add(steps: int, factor: float, addend: float, out: wp.array[float]):
    """Grid (num_threads,): eight independent chains, so that none waits for the result before."""
    i = wp.tid()
    a = wp.vec4(float(i), float(i) + 1.0, float(i) + 2.0, float(i) + 3.0)
    b = a + wp.vec4(4.0, 4.0, 4.0, 4.0)
    more = wp.vec4(addend, addend, addend, addend)
    for _step in range(steps):
        for _unrolled in range(16):
            a = a * factor + more
            b = b * factor + more
    out[i] = a[0] + a[1] + a[2] + a[3] + b[0] + b[1] + b[2] + b[3]


@wp.kernel
def exponentials(steps: int, out: wp.array[float]):
    """Grid (num_threads,): four independent chains."""
    i = wp.tid()
    a = float(i) * 1.0e-6
    b = a + 0.1
    c = a + 0.2
    d = a + 0.3
    for _step in range(steps):
        for _unrolled in range(4):
            a = wp.exp(-a)
            b = wp.exp(-b)
            c = wp.exp(-c)
            d = wp.exp(-d)
    out[i] = a + b + c + d


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


def launch(kernel: Any, out: Any, *inputs: float) -> None:
    """Launches one of the kernels above, one thread an entry of ``out``."""
    wp.launch(kernel, dim=out.shape[0], inputs=inputs, outputs=[out], device=out.device)


def measure_ceiling(device: str, timing: Timing) -> Ceiling:
    """Measures the best rates of a device, all in turns; torch works on Warp's stream already."""
    threads = 1 << 20 if device.startswith("cuda") else 64
    out: Any = wp.zeros(threads, dtype=float, device=device)
    launches = {
        "nothing": partial(launch, do_nothing, out[:1]),
        "flops": partial(launch, multiply_add, out, _STEPS, 0.999, 0.001),
        "specials": partial(launch, exponentials, out, _STEPS),
    }
    variants = {
        name: fit_launches(partial(repeat_warp, work, device=device), device, timing) for name, work in launches.items()
    }
    where = wp.to_torch(out).device
    # Bytes moved: 1 MB to 4 GB on CUDA, 16 KB to 64 MB on the CPU, in powers of 2.
    sizes = [1 << k for k in (range(20, 33) if device.startswith("cuda") else range(14, 27))]
    for size in sizes:
        source, target = (torch.zeros(size // 8, dtype=torch.float32, device=where) for _ in range(2))
        copy = partial(target.copy_, source)
        variants[str(size)] = fit_launches(partial(repeat_torch, copy, device=device), device, timing)
    seconds = time_in_turns(variants, device, timing)
    return Ceiling(
        copies={size: size / seconds[str(size)] for size in sizes},
        flops_per_s=threads * _STEPS * FLOPS_PER_STEP / seconds["flops"],
        specials_per_s=threads * _STEPS * SPECIALS_PER_STEP / seconds["specials"],
        launch_s=seconds["nothing"],
    )
