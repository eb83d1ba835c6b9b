"""Serves the viewer's page."""

import errno
import socket
from pathlib import Path

from qd.show.recordings import Recordings
from qd.show.view.app import App
from qd.show.view.show import Show
from sim.files.atomic import prepare_output


def serve(show: Show, *, host: str, port: int, cache: Path) -> None:
    """Serves the page until Ctrl-C.

    Args:
        show: What is shown.
        host: Address to serve it at.
        port: Likewise.
        cache: Folder where recordings are stored.
    """
    prepare_output(cache / "recording.npz")
    check_port(host, port)
    app = App(show, Recordings(show.robot, folder=cache), host=host, port=port)
    try:
        print(f"{show.opened_run.path}: {len(show.opened_run.archive):,} elites of {show.robot.name}.")
        print(f"Open http://{host}:{port} in a browser; Ctrl-C ends.", flush=True)
        app.run()
    except KeyboardInterrupt:
        print("\nStopped.")
    finally:
        app.close()


def check_port(host: str, port: int) -> None:
    """Makes sure that a page can be served on a port."""
    if not 0 < port < 65536:
        raise ValueError(f"port must lie in 1..65535, got {port}")
    reason = _trouble(host, port)
    if reason is not None and reason.errno == errno.EADDRINUSE:
        raise ValueError(f"port {port} of {host} is in use by another program: close that, or give another --port")
    if reason is not None:
        raise ValueError(
            f"nothing can be served at port {port} of {host}: {reason.strerror or reason}: give a --port above 1023 "
            "and a --host that is an address of this machine"
        )


def _trouble(host: str, port: int) -> OSError | None:
    """Why nothing could listen at a port; None if something could."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server has it
            probe.bind(address)
    except OSError as error:
        return error
    return None
