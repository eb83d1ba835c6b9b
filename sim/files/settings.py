"""Settings: what a field may hold stands on the field, and is checked, and read back from JSON, in one place."""

import math
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

_KEY = "allowed"
_MAX_WHOLE = 1 << 53  # up to which whole numbers are floats too
_NAMES = {int: "a whole number", float: "a finite number", str: "a text", bool: "True or False", type(None): "None"}

Built = TypeVar("Built")


@dataclass(frozen=True, kw_only=True)
class Allowed:
    """What a field may hold; of a tuple each number. None always passes."""

    least: float | None = None
    above: float | None = None
    most: float | None = None
    one_of: tuple[Any, ...] | None = None
    rising: bool = False
    """Whether no number of a tuple may be below the one before."""

    def complaint(self, value: Any) -> str | None:
        """What a value should have been; None if it may stand."""
        if self.one_of is not None:
            return None if value in self.one_of else f"be one of {', '.join(map(str, self.one_of))}"
        numbers = value if isinstance(value, tuple | list) else (value,)
        if not all(map(self._holds, numbers)):
            return self._words()
        return "rise" if self.rising and list(numbers) != sorted(numbers) else None

    def _holds(self, number: Any) -> bool:
        return (
            isinstance(number, int | float)
            and math.isfinite(number)
            and (self.least is None or number >= self.least)
            and (self.above is None or number > self.above)
            and (self.most is None or number <= self.most)
        )

    def _words(self) -> str:
        low = f"at least {self.least:g}" if self.least is not None else ""
        low = f"above {self.above:g}" if self.above is not None else low
        high = f"at most {self.most:g}" if self.most is not None else ""
        return "be " + (" and ".join(filter(None, [low, high])) or "a finite number")


def setting(default: Any = MISSING, **allowed: Any) -> Any:
    """A dataclass field with a default and the values it may have.

    Args:
        default: The default; left out, the field must be given.
        allowed: Fields of :class:`Allowed`; none: any finite number.
    """
    return field(default=default, metadata={_KEY: Allowed(**allowed)})


def problems(settings: Any, prefix: str = "") -> list[str]:
    """What is wrong with the values of a settings dataclass and of those inside it, one line each.

    A value must be of the type that its field is annotated with, and in the range that :func:`setting` gives it.

    Args:
        settings: The dataclass.
        prefix: Stands before each field's name, for example ``task.``.
    """
    found = []
    for own in fields(settings):
        value = getattr(settings, own.name)
        complaint = _mismatch(own.type, value)
        if complaint is None and is_dataclass(value):
            found += problems(value, f"{prefix}{own.name}.")
        elif complaint is None and value is not None and _KEY in own.metadata:
            complaint = own.metadata[_KEY].complaint(value)
        if complaint:
            found.append(f"{prefix}{own.name} must {complaint}, got {_brief(value)}")
    return found


def check(settings: Any, prefix: str = "") -> None:
    """Refuses settings of which a value may not stand.

    Raises:
        ValueError: If there is one; the message names all of them.
    """
    found = problems(settings, prefix)
    if found:
        raise ValueError("; ".join(found))


def built(kind: type[Built], values: Any, name: str) -> Built:
    """A settings class from JSON values.

    Args:
        kind: The class; fields may be of such classes, or tuples of them.
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
    return kind(**{key: _from_json(hints[key], value, key) for key, value in values.items()})


def _from_json(hint: Any, value: Any, name: str) -> Any:
    if is_dataclass(hint):
        return built(hint, value, name)  # pyright: ignore[reportArgumentType] - a hint is a class, no instance
    found = value
    if get_origin(hint) is tuple and isinstance(value, list | tuple):
        parts = _parts(hint, value)
        found = tuple(value)
        if len(parts) == len(value):
            found = tuple(_from_json(part, item, name) for part, item in zip(parts, value, strict=True))
    complaint = _mismatch(hint, found)
    if complaint:
        raise ValueError(f"{name} must {complaint}, got {_brief(value)}")
    return found


def _mismatch(hint: Any, value: Any) -> str | None:
    """What a value should have been by its annotation; None if it fits, or if the annotation is beyond this check."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        complaints = [_mismatch(part, value) for part in get_args(hint)]
        words = [complaint.removeprefix("be ") for complaint in complaints if complaint]
        return None if None in complaints else f"be {' or '.join(words)}"
    if origin is Literal:
        return None if value in get_args(hint) else f"be one of {', '.join(map(str, get_args(hint)))}"
    if origin is tuple:
        parts = get_args(hint)
        if not isinstance(value, tuple):
            return "be a tuple"
        if parts[-1] is not ... and len(parts) != len(value):
            return f"have {len(parts)} values"
        wrong = [_mismatch(part, item) for part, item in zip(_parts(hint, value), value, strict=True)]
        wrong = [words.removeprefix("be ") for words in wrong if words]
        return f"be a tuple, each value {wrong[0]}" if wrong else None
    if not isinstance(hint, type) or _fits(hint, value):
        return None
    return f"be {_NAMES.get(hint, hint.__name__)}"


def _fits(kind: type, value: Any) -> bool:
    if isinstance(value, bool):
        return kind in (bool, object)
    if kind is float:
        return abs(value) < _MAX_WHOLE if isinstance(value, int) else isinstance(value, float) and math.isfinite(value)
    return isinstance(value, kind)


def _parts(hint: Any, value: Any) -> tuple[Any, ...]:
    parts = get_args(hint)
    return parts[:1] * len(value) if parts[-1] is ... else parts


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
