"""Texts and pages by Jinja templates."""

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape


def open_templates(folder: Path) -> Environment:
    """The templates of a folder: a missing value is an error, and values in ``*.html`` are escaped."""
    options = {"autoescape": select_autoescape(["html"]), "trim_blocks": True, "lstrip_blocks": True}
    return Environment(loader=FileSystemLoader(folder), undefined=StrictUndefined, **options)
