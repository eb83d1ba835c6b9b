"""Who crosses terrains: this process, several processes, or Ray."""
