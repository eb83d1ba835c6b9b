"""The player bar under the scene: what it shows goes to the browser, and what a visitor does there comes back.

The bar is ``page.js``'s own, since viser has no place under the scene for one. It also sends keys and clicks on elites.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import viser
from viser import _messages

_SCRIPT = Path(__file__).with_name("page.js").read_text(encoding="utf-8")


class Bar:
    """The bar of one browser tab."""

    def __init__(self, client: viser.ClientHandle, act: Callable[[str, Any], None]) -> None:
        """Lay it out; ``act`` is called in another thread with the name and the value of what a visitor does."""
        self._client, self._act = client, act
        self.shown: dict[str, Any] = {}
        """What it shows, by the names in ``page.js``."""
        panel = client.gui.add_panel()  # hidden by the script; a field of another panel is gone while that is folded
        panel.float(x=0.0, y=0.0)
        panel.expand()
        with panel.add_tab("player bar"):
            client.gui.add_html('<i class="faultline-channel"></i>')
            field = client.gui.add_text("channel", "")
        field.on_update(lambda event: self._take(field.value) if event.client is not None else None)
        self._run(_SCRIPT)

    def _take(self, text: str) -> None:
        try:
            _, done = json.loads(text)
            tasks = list(done.items())
        except (ValueError, TypeError, AttributeError):  # anybody may write into the field
            return
        for name, value in tasks:
            self._act(name, value)

    def show(self, values: Mapping[str, Any]) -> None:
        """Show values by their names in ``page.js``; only what has changed is sent."""
        changed = {name: value for name, value in values.items() if self.shown.get(name, ...) != value}
        if changed:
            self.shown |= changed
            self._run(f"window.faultline?.show({json.dumps(changed)});")

    def show_address(self, query: str, *, is_new: bool) -> None:
        """Have the browser show another address, without loading anything; a new one is an entry in its history."""
        self._run(f"window.faultline?.address({json.dumps(query)}, {json.dumps(is_new)});")

    def copy(self, text: str) -> None:
        """Have the browser copy a text; if it may not, it shows that to be copied by hand."""
        self._run(f"const text = {json.dumps(text)}, ask = () => window.prompt('Copy this', text);"
             "navigator.clipboard ? navigator.clipboard.writeText(text).catch(ask) : ask();")  # fmt: skip

    def _run(self, script: str) -> None:
        """Run a script in the browser; viser does so for its plots, and has no public name for it."""
        self._client.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source=script))
