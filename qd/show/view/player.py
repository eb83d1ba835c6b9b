"""The player bar under the scene: it shows values in the browser, and sends back what a visitor does.

``page.js`` draws the bar, since viser has no element under the scene. It also sends keys and clicks on elites.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import viser
from viser import _messages

_SCRIPT = Path(__file__).with_name("page.js").read_text(encoding="utf-8")


class PlayerBar:
    """The bar of one browser tab."""

    def __init__(self, client: viser.ClientHandle, act: Callable[[str, Any], None]) -> None:
        """Add the bar; ``act`` is called in another thread with the name and value of each action of a visitor."""
        self._client = client
        self._act = act
        self.shown: dict[str, Any] = {}
        """Values by their names in ``page.js``."""
        panel = client.gui.add_panel()  # hidden by the script; the field of a folded panel would be gone
        panel.float(x=0.0, y=0.0)
        panel.expand()
        with panel.add_tab("player bar"):
            client.gui.add_html('<i class="faultline-channel"></i>')
            field = client.gui.add_text("channel", "")
        field.on_update(lambda event: self._receive(field.value) if event.client is not None else None)
        self._run(_SCRIPT)

    def _receive(self, text: str) -> None:
        try:
            _, actions = json.loads(text)
            for name, value in actions.items():
                self._act(name, value)
        except (ValueError, TypeError, AttributeError):  # anybody may write into the field
            return

    def show(self, values: Mapping[str, Any]) -> None:
        """Show values by their names in ``page.js``; only changed ones are sent."""
        changed = {name: value for name, value in values.items() if self.shown.get(name, ...) != value}
        if changed:
            self.shown |= changed
            self._run(f"window.faultline?.show({json.dumps(changed)});")

    def show_address(self, query: str, *, is_new: bool) -> None:
        """Change the browser's address without loading a page; a new one is an entry in its history."""
        self._run(f"window.faultline?.address({json.dumps(query)}, {json.dumps(is_new)});")

    def _run(self, script: str) -> None:
        """Run a script in the browser; viser does so for its plots, and has no public name for it."""
        self._client.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(source=script))
