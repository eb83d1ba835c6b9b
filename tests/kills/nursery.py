"""Imported once by the fork server that children are forked from: what every child needs, imported and compiled.

The process must stay without threads and hold no simulation that a child would not have made alike.
"""

import contextlib
import gc
import os
import tempfile
import threading
from pathlib import Path

import torch
import tqdm
import warp as wp

from tests.kills import commands, searches
from tests.kills.trainings import TASK

__all__ = ["TASK", "commands"]

os.environ.setdefault("FAULTLINE_COMMIT", "under test")  # spares asking git
tqdm.tqdm.monitor_interval = 0  # or the first bar starts a thread
tqdm.tqdm.set_lock(threading.RLock())  # its own is one for all processes: a killed child would keep it
torch.set_num_threads(1)
wp.init()
with (
    tempfile.TemporaryDirectory() as folder,
    open(os.devnull, "w") as nowhere,
    contextlib.redirect_stdout(nowhere),
    contextlib.redirect_stderr(nowhere),
):
    searches.search(Path(folder) / "run", iterations=2)  # compiles the evolution strategy
gc.collect()
gc.freeze()  # or a child's first collection copies every page
