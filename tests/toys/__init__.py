"""Toys, one file each: entries of the registries that tests search with, dose and show like any other."""

from tests.toys import condition, element, method, penalty

__all__ = ["condition", "element", "method", "penalty"]
