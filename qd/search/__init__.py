"""The search: its loop, archive, cells, fitness, methods, and the directory of a run."""
