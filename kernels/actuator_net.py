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
    if activation == 0:
        return x / (1.0 + wp.abs(x))
    if activation == 1:
        return wp.max(x, wp.exp(wp.min(x, 0.0)) - 1.0)
    return wp.where(activation == 2, wp.max(x, 0.0), wp.tanh(x))


@wp.func
def _sigmoid(x: float) -> float:
    return 1.0 / (1.0 + wp.exp(-x))


@cache
def make_torques(width: int, *, num_recurrent: int, activation: int, history: int, decimation: int) -> Any:
    """The launcher of a kernel that writes the torques of a network, which all drives have in common.

    Its layers have at most ``width`` inputs and units; the first ``num_recurrent`` are LSTMs, the others dense, with an
    ``activation`` (:data:`ACTIVATIONS`) behind all but the last. It knows the errors and velocities of ``history``
    evaluations, and the torque is held for ``decimation`` physics steps.
    """
    vector = wp.types.vector(width, float)

    @kernel_over("solver_out.ctrl", module="unique", enable_backward=False)
    def write_torques(
        joint_q: wp.array2d[float],
        joint_qd: wp.array2d[float],
        weights: wp.array[float],
        sizes: wp.array[int],
        inputs: wp.array[int],
        memory_out: wp.array3d[float],
        solver_out: SolverState,
    ):
        """Grid (num_envs, num_actuators): write torques [N m] in place of the joint targets in ``ctrl``.

        ``weights`` lie layer by layer and row by row: the bias, then those of the inputs. Rows of an LSTM are the gates
        i, f, g and o of all units, and its inputs end with the hidden state. ``sizes`` are the layers' units,
        (num_layers,), and ``inputs`` columns of the memory, (num_inputs,). A drive's memory, 0 when an episode begins,
        is the number of steps, the torque, error [rad] and velocity [rad/s] of each evaluation, the newest first, and
        hidden and cell state of each LSTM.
        """
        env, k = wp.tid()
        memory = memory_out[env, k]
        steps = int(memory[0])
        memory[0] = float(steps + 1)
        if steps % decimation == 0:
            state = 2 + 2 * history
            for j in range(2 * history - 2):
                memory[state - 1 - j] = memory[state - 3 - j]
            column = solver_out.target_of_actuator[k]
            memory[2] = solver_out.ctrl[env, k] - joint_q[env, column]
            memory[3] = joint_qd[env, column - 1]
            x = vector()
            count = inputs.shape[0]
            for j in range(count):
                x[j] = memory[inputs[j]]
            row = int(0)
            for layer in range(sizes.shape[0]):
                size = sizes[layer]
                gates = int(1)
                if layer < num_recurrent:
                    gates = 4
                    for j in range(size):
                        x[count + j] = memory[state + j]
                    count += size
                y = vector()
                for unit in range(size):
                    sums = wp.vec4()
                    for gate in range(gates):
                        first = row + (gate * size + unit) * (1 + count)
                        sums[gate] = weights[first]
                        for j in range(count):
                            sums[gate] += weights[first + 1 + j] * x[j]
                    y[unit] = sums[0]
                    if gates == 4:
                        cell = _sigmoid(sums[1]) * memory[state + size + unit] + _sigmoid(sums[0]) * wp.tanh(sums[2])
                        y[unit] = _sigmoid(sums[3]) * wp.tanh(cell)
                        memory[state + unit] = y[unit]
                        memory[state + size + unit] = cell
                    elif layer + 1 < sizes.shape[0]:
                        y[unit] = _activate(sums[0], activation)
                row += gates * size * (1 + count)
                state += 2 * size
                x = y
                count = size
            memory[1] = x[0]
        solver_out.ctrl[env, k] = memory[1]

    return write_torques
