"""Which failures are faults of the controller: judging, causes, families, minimal terrains."""
