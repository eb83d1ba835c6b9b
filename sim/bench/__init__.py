"""Microbenchmarks: every kernel against torch and against what the device can do at best."""
