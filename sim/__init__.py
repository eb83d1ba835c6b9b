"""Physics: the robots, their terrains, and batches of them crossing those terrains under a policy."""
