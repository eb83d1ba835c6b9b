"""The kernels run on the device of this run."""

from collections.abc import Iterator

import pytest
import warp as wp


@pytest.fixture(autouse=True)
def on_device(device: str) -> Iterator[None]:
    """Arrays made without a device lie on that of this run."""
    with wp.ScopedDevice(device):
        yield
