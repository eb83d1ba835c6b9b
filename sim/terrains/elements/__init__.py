"""Elements of courses: kerbs, steps, stairs, ramps, ditches and the like."""

from sim.terrains.elements import kinds as kinds
