"""The task that controllers are trained on: environment, terrains and settings."""
