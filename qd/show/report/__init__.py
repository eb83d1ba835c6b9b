"""One page about a run: what was searched, how the controller breaks, on which terrains; it opens without a network."""
