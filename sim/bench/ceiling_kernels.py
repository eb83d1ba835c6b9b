"""Kernels that ask for one resource of a device and nothing else: what a kernel of use can be measured against."""

from typing import Any

import warp as wp

FLOPS_PER_STEP = 2 * 8 * 16
"""Multiplications and additions that :func:`multiply_add` does a step and thread."""
SPECIALS_PER_STEP = 4 * 4
"""Exponentials that :func:`exponentials` computes a step and thread."""


@wp.kernel
def _do_nothing_kernel(out: wp.array[float]):
    """Grid (1,)."""
    out[0] = 0.0


@wp.kernel
def _multiply_add_kernel(steps: int, factor: float, addend: float, out: wp.array[float]):
    """Grid (num_threads,): eight independent chains, so that none waits for the result before."""
    i = wp.tid()
    a = float(i)
    b = a + 1.0
    c = a + 2.0
    d = a + 3.0
    e = a + 4.0
    f = a + 5.0
    g = a + 6.0
    h = a + 7.0
    for _step in range(steps):
        for _unrolled in range(16):
            a = a * factor + addend
            b = b * factor + addend
            c = c * factor + addend
            d = d * factor + addend
            e = e * factor + addend
            f = f * factor + addend
            g = g * factor + addend
            h = h * factor + addend
    out[i] = a + b + c + d + e + f + g + h


@wp.kernel
def _exponentials_kernel(steps: int, out: wp.array[float]):
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


def do_nothing(out: Any) -> None:
    """Launch one thread that writes one number: what a launch costs.

    Args:
        out: Shape (1,) or longer; its first entry becomes 0.
    """
    wp.launch(_do_nothing_kernel, dim=1, outputs=[out], device=out.device)


def multiply_add(steps: int, out: Any) -> None:
    """Let every thread do ``steps`` x :data:`FLOPS_PER_STEP` flops in registers.

    Args:
        steps: Length of the work.
        out: One result a thread, shape (num_threads,).
    """
    wp.launch(_multiply_add_kernel, dim=out.shape[0], inputs=[steps, 0.999, 0.001], outputs=[out], device=out.device)


def exponentials(steps: int, out: Any) -> None:
    """Let every thread compute ``steps`` x :data:`SPECIALS_PER_STEP` exponentials.

    Args:
        steps: Length of the work.
        out: One result a thread, shape (num_threads,).
    """
    wp.launch(_exponentials_kernel, dim=out.shape[0], inputs=[steps], outputs=[out], device=out.device)
