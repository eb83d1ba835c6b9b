"""The viewer as a user begins it, and a tab of it without a browser."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import takewhile
from pathlib import Path

import msgspec
import viser
from websockets.sync.client import ClientConnection, connect

from tests.builders import free_port

ROOT = Path(__file__).parents[4]


@contextmanager
def serve(*flags: str) -> Iterator[str]:
    """Address of a viewer that serves its page; Ctrl-C must end it well."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "faultline", "view", "--port", str(port), *flags], cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background ignores it
    )  # fmt: skip
    assert process.stdout is not None
    lines = list(takewhile(lambda line: not line.startswith("Open "), process.stdout))
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=180)[0]
    assert process.returncode == 0 and "Traceback" not in rest, [*lines, rest]


def visit(port: int) -> ClientConnection:
    """A tab without a browser, as far as viser's protocol goes: it comes, looks somewhere, and hears nothing."""
    protocol = f"viser-v{viser.__version__}"
    socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, max_queue=None, compression=None)
    camera = {
        "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 2.0, 3.0), "look_at": (4.0, 5.0, 0.0), "fov": 1.3, "near": 0.01,
        "far": 1000.0, "image_height": 900, "image_width": 1400, "up_direction": (0.0, 0.0, 1.0),
    }  # fmt: skip
    socket.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **camera}))
    return socket
