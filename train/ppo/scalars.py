"""TensorBoard's file: one record a row of scalars, handed to the system before the training goes on.

TensorBoard's own writer works in a thread, whose errors on a full disk come late and as a traceback.
"""

import io
import os
import socket
import time
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - protobuf makes it
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue] - likewise
from tensorboard.summary.writer.record_writer import RecordWriter

from sim.files.atomic import unwritable


class ScalarFile:
    """A file of scalars that TensorBoard reads.

    Args:
        folder: Where it is made; one file a piece of training, read together.

    Raises:
        OSError: If it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        name = f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}.{os.getpid()}.{time.monotonic_ns()}"
        self._path = folder / name
        self._append(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Add a row.

        Args:
            step: Number it is drawn over.
            scalars: Values by tag.

        Raises:
            OSError: If it cannot be written.
        """
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        self._append(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))

    def _append(self, event: Event) -> None:
        record = io.BytesIO()
        RecordWriter(record).write(event.SerializeToString())
        try:
            with self._path.open("ab") as file:
                file.write(record.getvalue())
        except OSError as error:
            raise unwritable(self._path, error) from error
