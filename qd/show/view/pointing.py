"""Pointing at the lines of the archive's plot, in the browser."""

from pathlib import Path

import viser

from qd.show.view.address import run_script


def let_point(client: viser.ClientHandle) -> None:
    """Have a browser name the line under the pointer, and show its elite when it is clicked."""
    run_script(client, Path(__file__).with_suffix(".js").read_text(encoding="utf-8"))
