"""Which robots' contacts are solved: the convergence test of mujoco_warp's Newton solver, on the gradient alone."""

from typing import Any

import warp as wp

wp.set_module_options({"fuse_fp": False})  # the solver's sum is of rounded products too


@wp.kernel
def _stop_converged_kernel(
    num_dofs: int,
    tolerance: wp.array[float],
    scale: wp.array[float],
    force: wp.array2d[float],
    smooth_force: wp.array2d[float],
    constraint_force: wp.array2d[float],
    alpha: wp.array[float],
    improvement: wp.array[float],
    num_iterations_out: wp.array[int],
    num_solving_out: wp.array[int],
    done_out: wp.array[bool],
):
    """Grid (num_envs,)."""
    env = wp.tid()
    if done_out[env]:
        return
    squares = float(0.0)
    for k in range(num_dofs):
        gradient = force[env, k] - smooth_force[env, k] - constraint_force[env, k]
        squares += gradient * gradient
    least = tolerance[env % tolerance.shape[0]]
    gained = scale[env] * improvement[env]
    if alpha[env] == 0.0 or (gained > 0.0 and gained < least) or scale[env] * wp.sqrt(squares) < least:
        num_iterations_out[env] += 1
        wp.atomic_add(num_solving_out, 0, -1)
        done_out[env] = True


def stop_converged(
    num_dofs: int, tolerance: Any, scale: Any, force: Any, smooth_force: Any, constraint_force: Any, alpha: Any,
    improvement: Any, num_iterations_out: Any, num_solving_out: Any, done_out: Any,
) -> None:  # fmt: skip
    """Mark the robots whose iteration brought no step, too little, or a gradient of almost nothing.

    Args:
        num_dofs: Degrees of freedom of a robot; rows below may be longer.
        tolerance: Of improvement and gradient, both scaled, shape (num_envs,) or (1,).
        scale: One over the trace of the inertia matrix, shape (num_envs,).
        force: Inertia times acceleration, shape (num_envs, num_dofs).
        smooth_force: All forces but those of constraints, same shape.
        constraint_force: Forces of constraints, same shape.
        alpha: Length of the step taken, shape (num_envs,).
        improvement: What it gained, shape (num_envs,).
        num_iterations_out: Iterations made, shape (num_envs,); one more where a robot stops.
        num_solving_out: Robots that go on, shape (1,).
        done_out: Who has stopped, bools of shape (num_envs,).
    """
    inputs = [num_dofs, tolerance, scale, force, smooth_force, constraint_force, alpha, improvement]
    outputs = [num_iterations_out, num_solving_out, done_out]
    wp.launch(_stop_converged_kernel, done_out.shape[0], inputs, outputs=outputs, device=done_out.device)
