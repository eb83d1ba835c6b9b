"""Imported first: what spares time in tests.

No garbage is collected until all tests are imported, of whose time that takes a third. Numba compiles nothing: of a
search by CMA-ES that takes ten seconds, and makes no other terrains.
"""

import gc
import os

gc.disable()
os.environ["NUMBA_DISABLE_JIT"] = "1"
