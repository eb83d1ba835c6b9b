"""Conditions under which robots cross, which belong to a terrain: of the robot, pushes, commands, and what it sees."""

from sim.terrains.conditions import command, kinds, perception, pushes

__all__ = ["command", "kinds", "perception", "pushes"]
