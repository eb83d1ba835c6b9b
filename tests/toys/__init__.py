"""Toys, one file each: entries of the registries that tests search with, dose and show like any other."""

from tests.toys import method, penalty

__all__ = ["method", "penalty"]
