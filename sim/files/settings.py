"""Settings: types and ranges stand on the fields of dataclasses, and msgspec checks values against them.

A range is written ``Annotated[int, Meta(ge=1)]`` with :class:`msgspec.Meta`. Floats must be finite.
"""

import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import Meta

PositiveInt = Annotated[int, Meta(ge=1)]
NonNegativeInt = Annotated[int, Meta(ge=0)]
PositiveFloat = Annotated[float, Meta(gt=0)]
NonNegativeFloat = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Interval = Annotated[tuple[float, float], Meta(description="the lower limit first")]

Settings = TypeVar("Settings")
_EXPECTED = re.compile(r"Expected (?P<what>.*?)(, got .*?)?( - at `\$\.?(?P<field>.*)`)?")
_PLAIN_WORDS = {
    r"`str` matching regex '\^\((.*)\)\$'": r"one of \1", r"(?<=\w)\|(?=\w)": ", ",
    r"`(int|float)` >= (\S+?)(\.0)?$": r"at least \2",
    r"`(int|float)` > (\S+?)(\.0)?$": r"above \2",
    r"`(int|float)` <= (\S+?)(\.0)?$": r"at most \2",
    r"\bint\b": "a whole number", r"\bfloat\b": "a finite number", r"\bstr\b": "a text", r"\bbool\b": "True or False",
    r"\barray\b": "a tuple", r"\bnull\b": "None", r" \| ": " or ", "`": "",
}  # fmt: skip
"""What msgspec calls a type or a range, and what a user does."""


def problems(settings: Any, prefix: str = "") -> list[str]:
    """What is wrong with the values of a settings dataclass and of those inside it: a line each, its field first.

    The prefix stands before each field's name, for example ``task.``.
    """
    lines: list[str] = []
    for setting in fields(settings):
        value, name = getattr(settings, setting.name), f"{prefix}{setting.name}"
        if is_dataclass(value):
            lines += problems(value, f"{name}.")
        elif expected := _mismatch(setting.type, value):
            lines.append(f"{name} must be {expected}, got {_brief(value)}")
        elif setting.type is Interval and value[0] > value[1]:
            lines.append(f"{name} must have its lower limit first, got {_brief(value)}")
    return lines


def check(settings: Any) -> None:
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
    except (msgspec.ValidationError, TypeError) as error:
        words = str(error).replace("Object missing required field", "missing").replace("`", "'")
        if match := _EXPECTED.fullmatch(str(error)):
            place, expected = match["field"] or "", match["what"]
            for word, words in {" | null": "", "array": "a list", "object": "a table"}.items():  # as a file has them
                expected = expected.replace(word, words)
            for key in re.findall(r"[^.\[\]]+", place):
                data = data[int(key) if key.isdigit() else key]
            words = f"{place or 'it'} must be {_in_words(expected)}, got {_brief(data)}"
        raise ValueError(f"{name}: {words}") from None
    if unknown := list(_unknown(data, settings)):
        raise ValueError(f"{name} has no setting {'; and no '.join(unknown)}")
    if lines := problems(settings):
        raise ValueError(f"{name}: {'; '.join(lines)}")
    return settings


def _unknown(given: dict[str, Any], settings: Any, table: str = "") -> Iterator[str]:
    """The names of each table that nobody knows, with those that it has."""
    known = [setting.name for setting in fields(settings)]
    if unknown := [f"{table}{key}" for key in given if key not in known]:
        yield f"{', '.join(unknown)}: there are {', '.join(known)}"
    for key, value in given.items():
        if isinstance(value, dict) and is_dataclass(part := getattr(settings, key, None)):
            yield from _unknown(value, part, f"{table}{key}.")


def _mismatch(annotation: Any, value: Any) -> str | None:
    """What a value should have been; None if it fits or its annotation is beyond msgspec."""
    parts = value if isinstance(value, tuple) else (value,)
    parts = [float(part) if isinstance(part, float) else part for part in parts]  # a NumPy float as Python's
    if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
        return "a finite number"
    plain = tuple(parts) if isinstance(value, tuple) else parts[0]
    try:
        converted = msgspec.convert(plain, annotation)
    except msgspec.ValidationError as error:
        match = _EXPECTED.fullmatch(str(error))
        return _in_words(match["what"]) if match else f"one of {', '.join(map(str, _choices(annotation)))}"
    except TypeError:
        return None
    return "a tuple" if isinstance(value, list) and isinstance(converted, tuple) else None


def _in_words(expected: str) -> str:
    for pattern, words in _PLAIN_WORDS.items():
        expected = re.sub(pattern, words, expected)
    return expected


def _choices(annotation: Any) -> tuple[Any, ...]:
    parts = get_args(annotation)
    return parts if get_origin(annotation) is Literal else tuple(value for part in parts for value in _choices(part))


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def read_toml(path: Path, text: str | None = None) -> dict[str, Any]:
    """Content of a TOML file, or of its text; an error names the file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8") if text is None else text)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from None


def to_toml(value: Any) -> str:
    """A value as TOML writes it, tables in braces."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_key(key)} = {to_toml(part)}' for key, part in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(to_toml, value))}]"
    if isinstance(value, float):
        return repr(float(value))
    return json.dumps(str(value) if isinstance(value, PurePath) else value, ensure_ascii=False)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else json.dumps(name)
