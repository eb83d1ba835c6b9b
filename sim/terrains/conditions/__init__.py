"""Conditions under which robots cross, which belong to a terrain: of the robot, pushes, and errors of what it sees."""

from sim.terrains.conditions import kinds, perception  # in the order of their numbers in a row of conditions

__all__ = ["kinds", "perception"]
