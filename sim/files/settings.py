"""Settings: dataclasses whose fields say types and ranges, as ``Annotated[int, Meta(ge=1)]``, checked by msgspec."""

import json
import math
import re
import reprlib
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partialmethod
from pathlib import Path, PurePath
from typing import Annotated, Any, TypeVar

import msgspec
import yaml
from msgspec import Meta

PositiveInt = Annotated[int, Meta(ge=1)]
NonNegativeInt = Annotated[int, Meta(ge=0)]
PositiveFloat = Annotated[float, Meta(gt=0)]
NonNegativeFloat = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Interval = Annotated[tuple[float, float], Meta(description="the lower limit first")]


Settings = TypeVar("Settings")


def problems(settings: Any, prefix: str = "") -> list[str]:
    """What is wrong with the values of a settings dataclass and those in it: a line each, prefix and field first."""
    lines: list[str] = []
    for setting in fields(settings):
        name = f"{prefix}{setting.name}"
        value = getattr(settings, setting.name)
        if is_dataclass(value):
            lines += problems(value, f"{name}.")
        elif problem := _mismatch(setting.type, value):
            lines.append(f"{name} = {reprlib.repr(value)}: {problem}")
    return lines


def check_settings(settings: Any) -> None:
    """Raises a ValueError that names every value of settings that is of another type or out of its range."""
    if lines := problems(settings):
        raise ValueError("; ".join(lines))


def select_settings(cls: type[Settings], flags: Any) -> Settings:
    """The settings of a dataclass alone, from an object that has fields of the same names among others."""
    return cls(**{setting.name: getattr(flags, setting.name) for setting in fields(cls)})  # pyright: ignore[reportArgumentType]


def from_builtins(cls: type[Settings], data: Any, name: str) -> Settings:
    """A settings dataclass of JSON values by the names of its fields; an error calls it ``name``."""
    try:
        settings = msgspec.convert(data, cls, dec_hook=lambda kind, value: kind(value))
        check_settings(settings)
    except (ValueError, TypeError) as error:  # msgspec's errors are ValueErrors
        raise ValueError(f"{name}: {error}") from None
    if unknown := list(_unknown(data, settings)):
        raise ValueError(f"{name} has no setting {'; and no '.join(unknown)}")
    return settings


def _unknown(given: dict[str, Any], settings: Any, table: str = "") -> Iterator[str]:
    """The keys of each table that are no setting, with the settings that there are."""
    names = [setting.name for setting in fields(settings)]
    if unknown := [f"{table}{key}" for key in given if key not in names]:
        yield f"{', '.join(unknown)}: there are {', '.join(names)}"
    for key, value in given.items():
        inner = getattr(settings, key, None)
        tables = zip(value, inner, strict=False) if isinstance(value, list) and inner else [(value, inner)]
        for content, held in tables:
            if isinstance(content, dict) and is_dataclass(held):
                yield from _unknown(content, held, f"{table}{key}.")


def _mismatch(annotation: Any, value: Any) -> str | None:
    """What is wrong with a value; None if it fits or msgspec does not know its annotation."""
    values = value if isinstance(value, tuple) else (value,)
    values = tuple(float(item) if isinstance(item, float) else item for item in values)  # a NumPy float as Python's
    if any(isinstance(item, float) and not math.isfinite(item) for item in values):
        return "Expected a finite number"
    try:
        converted = msgspec.convert(values if isinstance(value, tuple) else values[0], annotation)
    except msgspec.ValidationError as error:
        return str(error)
    except TypeError:
        return None
    if annotation is Interval and value[0] > value[1]:
        return "Expected the lower limit first"
    return "Expected a tuple" if isinstance(value, list) and isinstance(converted, tuple) else None


def read_toml(path: Path, text: str | None = None) -> dict[str, Any]:
    """Content of a TOML file, or of its text; an error names the file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8") if text is None else text)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from None


class _PlainLoader(yaml.SafeLoader):
    """Reads tags of Python as the lists, tables and texts that they are on."""

    def drop_tag(self, suffix: str, node: yaml.Node) -> Any:
        """The value of a node without its tag; a tag on nothing is its own text."""
        if isinstance(node, yaml.ScalarNode):
            return self.construct_scalar(node) or suffix.partition(":")[2]
        construct: Any = self.construct_sequence if isinstance(node, yaml.SequenceNode) else self.construct_mapping
        return construct(node, deep=True)

    drop_this_tag = partialmethod(drop_tag, "")  # of a kind that TOML does not have


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _PlainLoader.drop_tag)
for _kind in ("timestamp", "binary", "set", "omap", "pairs"):
    _PlainLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _PlainLoader.drop_this_tag)
_MAX_VALUES = 1_000_000  # of a YAML, its aliases written out


def read_yaml(file: Path) -> dict[str, Any]:
    """Names and values of a YAML, as data alone; an error names the file."""
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), _PlainLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{file} cannot be read as YAML: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{file} must hold names with values, got {type(content).__name__}")
    left: list[Any] = [content]
    for _ in range(_MAX_VALUES):
        if not left:
            return content
        value = left.pop()
        left += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    raise ValueError(f"{file} must hold at most {_MAX_VALUES:,} values, aliases written out, got more")


def to_toml(value: Any) -> str:
    """A value as TOML writes it, tables in braces."""
    if isinstance(value, Mapping):
        keys = [key if re.fullmatch(r"[\w-]+", key, re.ASCII) else json.dumps(key) for key in map(str, value)]
        return f"{{{', '.join(f'{key} = {to_toml(item)}' for key, item in zip(keys, value.values(), strict=True))}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(to_toml, value))}]"
    if isinstance(value, float):
        return repr(float(value))
    return json.dumps(str(value) if isinstance(value, PurePath) else value, ensure_ascii=False)
