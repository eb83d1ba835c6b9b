"""Height maps in and out: those of a user, and terrains as files for other programs."""
