"""Settings: what values a field may have, said where the field stands and checked in one place."""

import math
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Any

_KEY = "allowed"


@dataclass(frozen=True, kw_only=True)
class Allowed:
    """What a field may hold; a tuple's numbers each. None is never looked at."""

    least: float | None = None
    above: float | None = None
    most: float | None = None
    one_of: tuple[Any, ...] | None = None

    def complaint(self, value: Any) -> str | None:
        """What a value should have been, None if it may stand."""
        if self.one_of is not None:
            return None if value in self.one_of else f"be one of {', '.join(map(str, self.one_of))}"
        numbers = value if isinstance(value, tuple | list) else (value,)
        return None if all(map(self._holds, numbers)) else self._words()

    def _holds(self, number: float) -> bool:
        return (
            math.isfinite(number)
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

    Args:
        settings: The dataclass.
        prefix: Stands before each field's name, for example ``task.``.
    """
    found = []
    for own in fields(settings):
        value = getattr(settings, own.name)
        if is_dataclass(value):
            found += problems(value, f"{prefix}{own.name}.")
        elif _KEY in own.metadata and value is not None:
            complaint = own.metadata[_KEY].complaint(value)
            if complaint:
                found.append(f"{prefix}{own.name} must {complaint}, got {value}")
    return found


def check(settings: Any, prefix: str = "") -> None:
    """Refuses settings of which a value may not stand.

    Raises:
        ValueError: If there is one; the message names all of them.
    """
    found = problems(settings, prefix)
    if found:
        raise ValueError("; ".join(found))
