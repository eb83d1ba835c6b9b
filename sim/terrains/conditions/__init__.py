"""Conditions under which robots cross, which belong to a terrain: of robot and arms, pushes, commands, what it sees."""

from sim.terrains.conditions import arms, command, kinds, perception, pushes

__all__ = ["arms", "command", "kinds", "perception", "pushes"]
