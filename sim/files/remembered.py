"""Settings classes from the JSON values that a run remembers them as."""

from dataclasses import is_dataclass
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

_MAX_WHOLE = 1 << 53  # up to which whole numbers are floats too

Built = TypeVar("Built")


def built(kind: type[Built], values: Any, name: str) -> Built:
    """A settings class from JSON values, each of the type its field is annotated with.

    Args:
        kind: The class; fields may be of such classes, or tuples.
        values: By the names of fields.
        name: What to call it in an error.

    Raises:
        TypeError: If a field without a default is missing.
        ValueError: If there is no such field, or a value is of another type or out of range.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{name} must be an object, got {_brief(values)}")
    hints = get_type_hints(kind)
    unknown = [str(key) for key in values if key not in hints]
    if unknown:
        raise ValueError(f"{name} has no setting {', '.join(unknown)}")
    return kind(**{key: _typed(hints[key], value, key) for key, value in values.items()})


def _typed(hint: Any, value: Any, name: str) -> Any:
    """A JSON value as a field wants it: a nested class, a tuple, or a value of just that type."""
    if is_dataclass(hint):
        return built(hint, value, name)  # pyright: ignore[reportArgumentType] - a hint is a class, no instance
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name} must be a list, got {_brief(value)}")
        parts = parts[:1] * len(value) if parts[-1] is ... else parts
        if len(value) != len(parts):
            raise ValueError(f"{name} must have {len(parts)} values, got {_brief(value)}")
        return tuple(_typed(part, item, name) for part, item in zip(parts, value, strict=True))
    kinds = get_args(hint) or (hint,)
    if type(value) in kinds or (type(value) is int and float in kinds and abs(value) < _MAX_WHOLE):
        return value
    expected = " or ".join(getattr(kind, "__name__", str(kind)) for kind in kinds)
    raise ValueError(f"{name} must be {expected}, got {_brief(value)}")


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
