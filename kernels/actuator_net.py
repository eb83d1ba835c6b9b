"""Actuator networks: the torque of a joint by its position error and velocity, one thread a drive."""

from functools import cache
from typing import Any

import warp as wp

from kernels.coordinates import SolverState
from kernels.launch import kernel_over

ACTIVATIONS = ("softsign", "elu", "relu", "tanh")
"""What may stand between dense layers."""


@wp.func
def _activate(x: float, activation: int) -> float:
    bounded = wp.where(activation == 0, x / (1.0 + wp.abs(x)), wp.tanh(x))
    rectified = wp.max(x, wp.where(activation == 1, wp.exp(wp.min(x, 0.0)) - 1.0, 0.0))
    return wp.where(activation == 1 or activation == 2, rectified, bounded)


@wp.func
def _sigmoid(x: float) -> float:
    return 1.0 / (1.0 + wp.exp(-x))


@cache
def make_torques(width: int, *, num_recurrent: int, activation: int, history: int, decimation: int) -> Any:
    """The launcher of a kernel for one network of all drives, with layers of at most ``width`` inputs and units.

    The first ``num_recurrent`` layers are LSTMs, the others dense, with an ``activation`` behind all but the last.
    Errors and velocities of ``history`` evaluations are known. A torque is held for ``decimation`` physics steps.
    """
    vector = wp.types.vector(width, float)

    @kernel_over("solver_out.ctrl", module="unique", enable_backward=False)
    def write_torques(
        joint_q: wp.array2d[float],
        joint_qd: wp.array2d[float],
        weights: wp.array[wp.vec4],
        sizes: wp.array[int],
        inputs: wp.array[int],
        memory_out: wp.array3d[float],
        solver_out: SolverState,
    ):
        """Grid (num_envs, num_actuators): write torques [N m] in place of the joint targets in ``ctrl``.

        ``weights`` lie layer by layer, and in it by four rows: their biases, then those of each input. Four rows are
        the gates i, f, g and o of a unit of an LSTM, whose inputs end with the hidden state, or one of each quarter of
        a dense layer. ``sizes`` are the layers' units, (num_layers,), and ``inputs`` columns of the memory. A drive's
        memory, 0 when an episode begins, is error [rad] and velocity [rad/s] of each evaluation, the newest first, the
        number of steps, the torque, and hidden and cell state of each LSTM.
        """
        env, k = wp.tid()
        memory = memory_out[env, k]
        state = 2 * history + 2
        steps = int(memory[state - 2])
        memory[state - 2] = float(steps + 1)
        if steps % decimation == 0:
            for j in range(2 * history - 1, 1, -1):
                memory[j] = memory[j - 2]
            column = solver_out.target_of_actuator[k]
            memory[0] = solver_out.ctrl[env, k] - joint_q[env, column]
            memory[1] = joint_qd[env, column - 1]
            x = vector()
            count = inputs.shape[0]
            for j in range(count):
                x[j] = memory[inputs[j]]
            row = int(0)
            for layer in range(sizes.shape[0]):
                size = sizes[layer]
                is_recurrent = layer < num_recurrent
                num_fours = wp.where(is_recurrent, size, (size + 3) // 4)
                if is_recurrent:
                    for j in range(size):
                        x[count + j] = memory[state + j]
                    count += size
                y = vector()
                for k4 in range(num_fours):
                    four = weights[row]
                    for j in range(count):
                        four += weights[row + 1 + j] * x[j]
                    row += 1 + count
                    if is_recurrent:
                        cell = _sigmoid(four[1]) * memory[state + size + k4] + _sigmoid(four[0]) * wp.tanh(four[2])
                        y[k4] = _sigmoid(four[3]) * wp.tanh(cell)
                        memory[state + k4] = y[k4]
                        memory[state + size + k4] = cell
                    else:
                        for j in range(4):
                            is_last = layer + 1 == sizes.shape[0]
                            y[j * num_fours + k4] = wp.where(is_last, four[j], _activate(four[j], activation))
                state += 2 * size
                x = y
                count = size
            memory[2 * history + 1] = x[0]
        solver_out.ctrl[env, k] = memory[2 * history + 1]

    return write_torques
