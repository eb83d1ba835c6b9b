"""Terrains: spaces of genes, height maps, ground, conditions, and the bank that holds them on the device."""
