"""What a tab shows, in its address: read when the tab opens, and kept up to date while it is used."""

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

_POSITION = "initialCameraPosition"  # viser reads these two: its page starts with that camera
_LOOK_AT = "initialCameraLookAt"
_MINIMAL = "minimal"


@dataclass(frozen=True, kw_only=True)
class Address:
    """What a tab shows; None or False where its address lacks it."""

    elite: int | None = None
    controller: str | None = None
    ghost: str | None = None
    minimal: bool = False
    episode: int | None = None
    """Counted from 1."""
    time_s: float | None = None
    follow: bool = False
    camera: tuple[str, str] | None = None
    """Where the camera stands and what it looks at [m], ``x,y,z`` each."""

    def query(self) -> str:
        """The address behind its question mark."""
        position, look_at = self.camera or (None, None)
        values = {
            "elite": self.elite,
            "terrain": _MINIMAL if self.minimal else None,
            "controller": self.controller,
            "ghost": self.ghost,
            "episode": self.episode,
            "t": None if self.time_s is None else f"{self.time_s:.2f}".rstrip("0").rstrip("."),
            "follow": "1" if self.follow else None,
            _POSITION: position,
            _LOOK_AT: look_at,
        }
        ours = [(name, str(value)) for name, value in values.items() if value is not None]
        return urlencode(ours, safe=",", quote_via=quote)


def read_address(query: str) -> tuple[Address, list[str]]:
    """The address of a page behind its question mark, and a sentence for each value that is no number."""
    values = dict(parse_qsl(query.removeprefix("?"), keep_blank_values=True))
    refused = []

    def read(name: str, kind: type[int] | type[float]) -> Any:
        if name not in values:
            return None
        with suppress(ValueError, OverflowError):
            if math.isfinite(value := kind(values[name])):
                return value
        refused.append(f"{name}={values[name]} in the address is no number that makes sense: it is left out.")
        return None

    position = values.get(_POSITION)
    look_at = values.get(_LOOK_AT)
    return Address(
        elite=read("elite", int),
        controller=values.get("controller"),
        ghost=values.get("ghost"),
        minimal=values.get("terrain") == _MINIMAL,
        episode=read("episode", int),
        time_s=read("t", float),
        follow=values.get("follow") == "1",
        camera=(position, look_at) if position and look_at else None,
    ), refused
