"""What the address of a page says is shown: read when a tab opens, and kept up to date while it is used."""

import json
import math
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
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
    """What a tab shows; None and False of what its address does not say."""

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
    """What else the address says, as it says it; viser has parameters of its own."""

    def query(self) -> str:
        """The address behind its question mark."""
        said: list[tuple[str, str]] = list(self.others)
        named = (("elite", self.elite), ("controller", self.controller), ("ghost", self.ghost),
                 ("episode", self.episode))  # fmt: skip
        said += [(name, str(value)) for name, value in named if value is not None]
        if self.minimal:
            said.insert(len(self.others) + 1, ("terrain", _MINIMAL))
        if self.time_s is not None:
            said.append(("t", f"{self.time_s:.2f}".rstrip("0").rstrip(".")))
        if self.follow:
            said.append(("follow", "1"))
        if self.camera is not None:
            said += [(name, _text_of(point)) for name, point in zip((_POSITION, _LOOK_AT), self.camera, strict=True)]
        return urlencode(said, safe=",", quote_via=quote)


def _text_of(point: Point) -> str:
    return ",".join(f"{value:.2f}" for value in point)


def read_address(query: str) -> tuple[Address, list[str]]:
    """What the address of a page says, and in words what of it means nothing.

    Args:
        query: The address behind its question mark, with or without that.
    """
    pairs = parse_qsl(query.removeprefix("?"), keep_blank_values=True)
    said, refused = dict(pairs), []
    ours = {"elite", "controller", "ghost", "terrain", "episode", "t", "follow", _POSITION, _LOOK_AT}

    def number(name: str, words: str) -> float | None:
        if name not in said:
            return None
        try:
            value = float(said[name])
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (name != "t" and value != int(value)):
            refused.append(f"{name}={said[name]} in the address is no {words}: it is left out.")
            return None
        return value

    elite, episode, time_s = number("elite", "elite"), number("episode", "episode"), number("t", "time in seconds")
    position, look_at = _point(said.get(_POSITION)), _point(said.get(_LOOK_AT))
    return Address(
        elite=None if elite is None else int(elite),
        controller=said.get("controller"),
        ghost=said.get("ghost"),
        minimal=said.get("terrain") == _MINIMAL,
        episode=None if episode is None else int(episode),
        time_s=time_s,
        follow=said.get("follow") == "1",
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
    """What stands behind the question mark in a browser's address; nothing if it does not answer in time.

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


def copy_link(client: viser.ClientHandle) -> None:
    """Have a browser copy its address; where it may not, it shows the link to be copied by hand."""
    _copy(client, "location.href", "Copy this link")


def copy_text(client: viser.ClientHandle, text: str) -> None:
    """Have a browser copy a text, likewise."""
    _copy(client, json.dumps(text), "Copy this")


def _copy(client: viser.ClientHandle, source: str, asked: str) -> None:
    run_script(client, f"const text = {source}, ask = () => window.prompt({json.dumps(asked)}, text);"
         "navigator.clipboard ? navigator.clipboard.writeText(text).catch(ask) : ask();")  # fmt: skip


def keep_keys(client: viser.ClientHandle, names: Sequence[str]) -> None:
    """Keep keys from viser's camera, which would move with them too; the page's commands still get them.

    Args:
        client: The browser.
        names: As a keyboard event's ``code`` has them.
    """
    run_script(client, f"const kept = {json.dumps(list(names))};"
         "document.documentElement.addEventListener('keydown', e => "
         "{ if (kept.includes(e.code)) e.stopPropagation(); });")  # fmt: skip


def run_script(client: viser.ClientHandle, script: str) -> None:
    """Run a script in a browser; viser does so for its plots, and has no public name for it."""
    client.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source=script))
