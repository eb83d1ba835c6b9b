"""Warp kernels: terrain, contact, observation, penalties and episode logic, for any number of environments."""

import warp as wp

# Nothing here is differentiated: without adjoint code, kernels compile in half the time.
wp.config.enable_backward = False
# Errors only while Warp starts, which else warns of every missing GPU; then warnings, but no line for each module loaded.
wp.config.log_level = 40
wp.init()
wp.config.log_level = 30
