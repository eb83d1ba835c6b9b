"""Conditions under which robots cross, which belong to a terrain: payload, delays, noise, pushes, commands and more."""

from sim.terrains.conditions import command, kinds, pushes

__all__ = ["command", "kinds", "pushes"]
