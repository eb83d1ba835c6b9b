"""The search: genes, descriptors, fitness and the archive of terrains on which a controller fails."""
