"""Conditions under which robots cross, which belong to a terrain: payload, weak motors, delays, noise, a push."""
