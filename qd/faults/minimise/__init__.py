"""Minimal terrains: the smallest ones on which a controller still fails."""
