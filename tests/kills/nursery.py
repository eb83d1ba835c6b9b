"""Imported by the fork server alone: what every child needs, imported and compiled once.

The process must stay without threads and hold no simulation that a child would not have made alike.
"""

import gc
import os
import tempfile
import threading
from pathlib import Path

import torch
import tqdm

os.environ["NUMBA_DISABLE_JIT"] = "1"  # spares compiling the evolution strategy
os.environ.setdefault("FAULTLINE_COMMIT", "under test")  # spares asking git

from tests.kills import runs

tqdm.tqdm.monitor_interval = 0  # or the first bar starts a thread
tqdm.tqdm.set_lock(threading.RLock())  # its own is one for all processes: a killed child would keep it
torch.set_num_threads(1)
runs.task()
with tempfile.TemporaryDirectory() as folder:
    runs.search(Path(folder) / "run", iterations=2)  # imports what is imported late
gc.collect()
gc.freeze()  # or a child's first collection copies every page
