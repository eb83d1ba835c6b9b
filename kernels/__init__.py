"""Warp kernels: terrain, contact, observation, penalties and episode logic, for any number of environments."""

import warp as wp

# Nothing here is differentiated: without adjoint code, kernels compile in half the time.
wp.config.enable_backward = False
wp.config.log_level = 30  # warnings and worse: not a line for each module loaded
