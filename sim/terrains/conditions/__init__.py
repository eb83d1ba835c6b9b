"""Conditions under which robots cross, which belong to a terrain: payload, weak motors, delays, noise, pushes, and
errors of what the robot sees.
"""
