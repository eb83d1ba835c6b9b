"""Imported by the fork server alone: what every child needs, imported and compiled once.

The process must stay without threads and hold no simulation that a child would not have made alike.
"""

import gc
import os
import tempfile
from pathlib import Path

import torch

os.environ.setdefault("FAULTLINE_COMMIT", "under test")  # spares asking git

from tests.kills import runs

torch.set_num_threads(1)
runs.task()
with tempfile.TemporaryDirectory() as folder:
    runs.search(Path(folder) / "run", iterations=2)  # imports what is imported late
gc.collect()
gc.freeze()  # or a child's first collection copies every page
