"""Warp kernels: terrain, contact, observation, penalties and episode logic, for any number of environments.

Arrays that many kernels take, one row an environment:

- ``joint_q`` (num_envs, 7 + num_joints), ``joint_qd`` (num_envs, 6 + num_joints): :mod:`kernels.state`.
- ``targets`` (num_envs, 7 + num_joints): joint position targets [rad] in columns 7 and up.
- ``action``, ``last_action`` (num_envs, num_joints): what the policy put out; clipped from ``apply_action`` on.
- ``command`` (num_envs, 3): vx, vy [m/s], yaw rate [rad/s].
- ``geom_force`` (num_envs, num_geoms): vectors of contact force, world frame [N]; ``geom_role`` (num_geoms,): role bits
  of :mod:`kernels.penalties`.
- ``outcome`` (num_envs,): :class:`kernels.episode.Outcome`; ``terrain_of_env`` (num_envs,): which terrain it is on.
- ``base_com``: mass centre of the base in its frame [m].
"""

import os
import sys
import tempfile

import warp as wp

# Nothing here is differentiated: without adjoint code, kernels compile in half the time.
wp.config.enable_backward = False
wp.config.log_level = 30  # warnings and worse: not a line for each module loaded

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def _start_warp() -> None:
    """Starts Warp without the warning by each process that there is no CUDA driver: who chooses a device says it."""
    try:
        stderr = os.dup(2)
    except OSError:  # closed: nobody reads it
        wp.init()
        return
    with tempfile.TemporaryFile() as written:
        os.dup2(written.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        written.seek(0)
        lines = [line for line in written if _NO_DRIVER not in line]
    sys.stderr.write(b"".join(lines).decode(errors="replace"))


_start_warp()
