"""What the address of a page says is shown: read when a tab opens, and kept up to date while it is used."""

import json
import math
import uuid
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

import viser
from viser import _messages

_ANSWER_S = 5.0
"""How long a browser has to say what its address is."""
_POSITION, _LOOK_AT = "initialCameraPosition", "initialCameraLookAt"
"""Viser's own: its page starts with that camera."""
_MINIMAL = "minimal"

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Address:
    """What a tab shows; None or False where its address does not say it."""

    elite: int | None = None
    controller: str | None = None
    ghost: str | None = None
    """The controller that crosses beside it."""
    minimal: bool = False
    """Whether it is the elite's minimal terrain."""
    episode: int | None = None
    """Counted from 1."""
    time_s: float | None = None
    follow: bool = False
    camera: tuple[Point, Point] | None = None
    """Where the camera stands and what it looks at [m]."""
    others: tuple[tuple[str, str], ...] = ()
    """Further parameters with their values, such as viser's."""

    def query(self) -> str:
        """The address behind its question mark."""
        camera = {} if self.camera is None else dict(zip((_POSITION, _LOOK_AT), self.camera, strict=True))
        values = {
            "elite": self.elite,
            "terrain": _MINIMAL if self.minimal else None,
            "controller": self.controller,
            "ghost": self.ghost,
            "episode": self.episode,
            "t": None if self.time_s is None else f"{self.time_s:.2f}".rstrip("0").rstrip("."),
            "follow": "1" if self.follow else None,
            **{name: ",".join(f"{value:.2f}" for value in point) for name, point in camera.items()},
        }
        ours = [(name, str(value)) for name, value in values.items() if value is not None]
        return urlencode([*self.others, *ours], safe=",", quote_via=quote)


def read_address(query: str) -> tuple[Address, list[str]]:
    """What the address of a page says, and which parts of it mean nothing, in words.

    Args:
        query: The address behind its question mark, with or without that.
    """
    pairs = parse_qsl(query.removeprefix("?"), keep_blank_values=True)
    values, refused = dict(pairs), []
    ours = {"elite", "controller", "ghost", "terrain", "episode", "t", "follow", _POSITION, _LOOK_AT}

    def read(name: str, kind: type[int] | type[float]) -> Any:
        if name not in values:
            return None
        with suppress(ValueError, OverflowError):
            if math.isfinite(value := kind(values[name])):
                return value
        refused.append(f"{name}={values[name]} in the address is no number that makes sense: it is left out.")
        return None

    position, look_at = _point(values.get(_POSITION)), _point(values.get(_LOOK_AT))
    return Address(
        elite=read("elite", int),
        controller=values.get("controller"),
        ghost=values.get("ghost"),
        minimal=values.get("terrain") == _MINIMAL,
        episode=read("episode", int),
        time_s=read("t", float),
        follow=values.get("follow") == "1",
        camera=None if position is None or look_at is None else (position, look_at),
        others=tuple(pair for pair in pairs if pair[0] not in ours),
    ), refused


def _point(text: str | None) -> Point | None:
    try:
        x, y, z = map(float, (text or "").split(","))
    except ValueError:
        return None
    return (x, y, z) if all(map(math.isfinite, (x, y, z))) else None


def ask_query(client: viser.ClientHandle) -> str:
    """What a browser's address says behind its question mark; empty if the browser does not answer in time.

    Viser's browser does not send it. A script puts it where viser can read it: in the browser's storage, under a name
    that is made up for this one question, since tabs share that storage.
    """
    key = f"faultline-address-{uuid.uuid4()}"
    client.local_storage.set_item(key, "")
    run_script(client, f"for (const k of Object.keys(localStorage)) if (k.endsWith({json.dumps(key)})) "
         "localStorage.setItem(k, location.search);")  # fmt: skip
    try:
        return client.local_storage.get_item(key, timeout=_ANSWER_S) or ""
    except (RuntimeError, TimeoutError):  # it has no storage, or is gone again
        return ""
    finally:
        client.local_storage.remove_item(key)


def show_query(client: viser.ClientHandle, query: str) -> None:
    """Have a browser show another address, without loading anything or an entry in its history."""
    run_script(client, f"history.replaceState(history.state, '', {json.dumps('?' + query)});")


def copy_text(client: viser.ClientHandle, text: str | None) -> None:
    """Have a browser copy a text, or with None its address; if it may not, it shows that to be copied by hand."""
    source = "location.href" if text is None else json.dumps(text)
    run_script(client, f"const text = {source}, ask = () => window.prompt('Copy this', text);"
         "navigator.clipboard ? navigator.clipboard.writeText(text).catch(ask) : ask();")  # fmt: skip


def keep_keys(client: viser.ClientHandle) -> None:
    """Keep left and right from viser's camera, which would move with them too; the page's commands still get them."""
    run_script(client, "document.documentElement.addEventListener('keydown', e => "
         "{ if (['ArrowLeft', 'ArrowRight'].includes(e.code)) e.stopPropagation(); });")  # fmt: skip


def let_point(client: viser.ClientHandle) -> None:
    """Have a browser name the line of the archive's plot under the pointer, and show its elite on a click."""
    run_script(client, Path(__file__).with_name("pointing.js").read_text(encoding="utf-8"))


def run_script(client: viser.ClientHandle, script: str) -> None:
    """Run a script in a browser; viser does so for its plots, and has no public name for it."""
    client.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source=script))
