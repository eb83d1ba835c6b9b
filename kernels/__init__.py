"""Warp kernels: terrain, contact, observation, penalties and episode logic, for any number of environments."""

import os
import sys
import tempfile

import warp as wp

# Nothing here is differentiated: without adjoint code, kernels compile in half the time.
wp.config.enable_backward = False
wp.config.log_level = 30  # warnings and worse: not a line for each module loaded

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def _start_warp() -> None:
    """Starts Warp without the warning that its C++ writes where there is no CUDA driver.

    Every process would write it, workers too. Who chooses a device says it (:func:`sim.device.resolve_device`).
    """
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
        kept = [line for line in written if _NO_DRIVER not in line]
    sys.stderr.write(b"".join(kept).decode(errors="replace"))


_start_warp()
