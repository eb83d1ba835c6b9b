"""A surrogate of the simulation: networks, and the search that they judge."""
