"""What a tab shows, in its address: read when the tab opens, and kept up to date while it is used."""

import math
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

import msgspec

MINIMAL = "minimal"
"""The terrain of an address that shows a minimal one."""
_NAMES = {"time_s": "t", "position": "initialCameraPosition", "look_at": "initialCameraLookAt"}


class Address(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, rename=_NAMES):
    """What a tab shows; None or False where its address lacks it."""

    elite: int | None = None
    terrain: str | None = None
    controller: str | None = None
    ghost: str | None = None
    episode: int | None = None
    """Counted from 1."""
    time_s: float | None = None
    follow: bool = False
    position: str | None = None
    """Where the camera stands [m], ``x,y,z``; viser reads it too: its page begins there."""
    look_at: str | None = None
    """What the camera looks at [m]."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.time_s or 0.0):
            raise ValueError("a time must be finite")

    def query(self) -> str:
        """The address behind its question mark."""
        values: dict[str, Any] = msgspec.to_builtins(self)
        texts = {name: value if isinstance(value, str) else f"{value:.9g}" for name, value in values.items()}
        return urlencode(texts, safe=",", quote_via=quote)


def read_address(query: str) -> tuple[Address, list[str]]:
    """The address of a page behind its question mark, and a sentence for each value that is no number."""
    values = dict(parse_qsl(query.removeprefix("?"), keep_blank_values=True))
    refused = []
    for name, value in [*values.items()]:
        try:
            msgspec.convert({name: value}, Address, strict=False)
        except msgspec.ValidationError:
            refused.append(f"{name}={value} in the address is no number that makes sense: it is left out.")
            del values[name]
    return msgspec.convert(values, Address, strict=False), refused
