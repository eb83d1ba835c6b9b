"""Terrain spaces: what each has, man-made courses, and spaces of a user's own."""
