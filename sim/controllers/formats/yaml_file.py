"""YAML as data alone."""

from pathlib import Path
from typing import Any

import yaml

SUFFIXES = (".yaml", ".yml")


class _PlainLoader(yaml.SafeLoader):
    """Reads tags of Python as the lists, tables and texts that they are on."""


def _drop_tag(loader: Any, suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_scalar(node) or suffix.partition(":")[2]


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _drop_tag)


def read_yaml(file: Path) -> dict[str, Any]:
    """Names and values of a YAML, as data alone; an error names the file."""
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), _PlainLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{file} cannot be read as YAML: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{file} must hold names with values, got {type(content).__name__}")
    return content
