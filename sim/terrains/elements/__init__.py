"""Elements of courses: kerbs, steps, stairs, ramps, ditches and the like."""
