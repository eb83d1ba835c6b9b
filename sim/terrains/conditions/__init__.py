"""Conditions under which robots cross, which belong to a terrain: payload, weak motors, delays, noise, pushes, and
errors of what the robot sees, commands.
"""

from sim.terrains.conditions import command, kinds

__all__ = ["command", "kinds"]
