"""A browser's part of viser's protocol, as far as a tab needs it: it comes, answers, and looks somewhere."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import takewhile
from pathlib import Path

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.builders import free_port

WIDTH, HEIGHT = 1400, 900
ROOT = Path(__file__).parents[4]


@contextmanager
def serve(*flags: str) -> Iterator[tuple[str, str]]:
    """Address of a viewer that serves its page, and what it has printed until then; Ctrl-C must end it well."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "faultline", "view", "--port", str(port), *flags], cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background ignores it
    )  # fmt: skip
    assert process.stdout is not None
    lines = list(takewhile(lambda line: not line.startswith("Open "), process.stdout))
    try:
        yield f"http://127.0.0.1:{port}/", "".join(lines)
    finally:
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=180)[0]
    assert process.returncode == 0 and "Traceback" not in rest, [*lines, rest]


class Visitor:
    """One tab without a browser; at first it says ``hello``: what its address asks for, and its window's size."""

    def __init__(self, port: int, hello: object) -> None:
        protocol = f"viser-v{viser.__version__}"
        self._socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, compression=None)
        self._hello, self._channel = hello, ""
        self.scripts: list[str] = []
        """What the page had it run."""
        self.notes: list[str] = []
        """What it was told at the top of the page."""
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()
        self.look((1.0, 2.0, 3.0), (4.0, 5.0, 0.0))

    def look(self, position, look_at) -> None:
        """Move its camera."""
        self._send(
            type="ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=position, look_at=look_at, fov=1.3,
            near=0.01, far=1000.0, image_height=HEIGHT, image_width=WIDTH, up_direction=(0.0, 0.0, 1.0),
        )  # fmt: skip

    def close(self) -> None:
        """Leave."""
        self._socket.close()
        self._thread.join(timeout=5)

    def _send(self, **message) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def _answer(self) -> None:
        try:
            for data in self._socket:
                size = int.from_bytes(data[8:16], "little")
                inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
                for message in msgspec.msgpack.decode(inner)["messages"]:
                    self._take(message)
        except ConnectionClosed:
            pass

    def act(self, **done) -> None:
        """Do something on the player bar."""
        self._send(type="GuiUpdateMessage", uuid=self._channel, updates={"value": json.dumps([0, done])})

    def _take(self, message) -> None:
        if message["type"] == "RunJavascriptMessage":
            self.scripts.append(message["source"])
            if "hello" in message["source"]:
                self.act(hello=self._hello)
        elif message["type"] == "NotificationShowMessage":
            self.notes.append(message["props"]["body"])
        elif message["type"] == "GuiTextMessage":
            self._channel = message["uuid"]
