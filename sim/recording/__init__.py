"""Recorded crossings: what every robot did at every control step, on disk and as pictures."""
