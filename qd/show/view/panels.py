"""A tab's panels and bar, which post what a visitor does to the viewer's loop, and its selection, clock and address."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

import msgspec
import numpy as np
import viser
from matplotlib.colors import to_hex
from numpy.typing import NDArray
from viser import _messages, uplot

from kernels.penalties import PENALTIES
from qd.faults.families import summarise_search
from qd.show.crossed import all_endings
from qd.show.view.scene import COMMAND_COLOR, FORCE_COLOR, PHONE, Crossing
from qd.show.view.viewed import FITNESS_TEXT, TEMPLATES, Column, ViewedRun, render_rates
from sim.rates import rate_labels
from sim.recording.renderer import FOOT_TOUCH, OTHER_CONTROLLER, TOUCH
from sim.terrains.maps.picture import SLIPPERY, SOFT, height_colors

_SCRIPT = Path(__file__).with_name("page.js").read_text(encoding="utf-8")
_WIDTH = 360  # of a panel [pixels]
_NARROW_WIDTH = 300
_WIDE = 1300  # a narrower window has no room for two wide panels, and the archive is folded [pixels]
TERRAINS = ("whole", "minimal")  # of an elite, to choose from
_CURVE_POINTS = 300
_HOLD_S = 1.5  # real time from the end of a crossing that plays to its next begin
_KEYS = """- **Space** play or pause
- **←** **→** 0.1 s back or on, **M** next mark
- **1** to **9** an episode
- **N** **P** next or previous elite
- **F** follow the robot, **O** overview"""
_LEGEND = {
    "slippery": SLIPPERY, "soft": SOFT, "touch": TOUCH, "foot": FOOT_TOUCH, "force": FORCE_COLOR,
    "command": COMMAND_COLOR, "ghost": OTHER_CONTROLLER,
}  # fmt: skip
_NAMES = {"time_s": "t", "position": "initialCameraPosition", "look_at": "initialCameraLookAt"}


class Selection:
    """Numbers of the listed elites in their order, ``matching``, and of the shown one, ``picked``, listed or not."""

    def __init__(self, show: ViewedRun) -> None:
        self._show = show
        self._choice: dict[str, str] = {}
        self.matching: NDArray[np.int64] = show.list_elites()
        self.picked = int(self.matching[0]) if show.elite is None else show.elite

    def choose(self, **changes: str) -> None:
        """List the elites of another ``cause``, or in another ``order``, as :class:`ViewedRun` has them."""
        self._choice |= changes
        self.matching = self._show.list_elites(**self._choice)

    def step(self, by: int) -> int:
        """Number of the next (1) or previous (-1) listed elite by its position among all; the picked one at the end."""
        positions = np.argsort(self._show.list_elites(**self._choice | {"cause": ""}))  # of each elite
        ahead = positions[self.matching] - positions[self.picked]
        near = self.matching[ahead > 0][:1] if by > 0 else self.matching[ahead < 0][-1:]
        return int(near[0]) if len(near) else self.picked


@dataclass(kw_only=True)
class Clock:
    """Time within a crossing, run by real time; a crossing that plays begins again after its end."""

    duration_s: float = 0.0
    begin_s: float = 0.0  # where it begins again
    time_s: float = 0.0
    speed: float = 1.0  # simulated seconds in a real one
    playing: bool = False
    _waited_s: float = 0.0

    def seek(self, time_s: float) -> None:
        """Show a time, no further than the ends."""
        self.time_s = float(np.clip(time_s, 0.0, self.duration_s))

    def tick(self, real_s: float) -> None:
        """Let real time go by [s]."""
        if self.playing:
            self._waited_s = self._waited_s + real_s if self.time_s >= self.duration_s else 0.0
            self.seek(self.begin_s if self._waited_s >= _HOLD_S else self.time_s + self.speed * real_s)


class Address(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, rename=_NAMES):
    """What a tab shows, read when it opens and kept up to date while it is used; None or False where it is not said."""

    elite: int | None = None
    terrain: str | None = None
    controller: str | None = None
    ghost: str | None = None
    episode: int | None = None  # counted from 1
    time_s: float | None = None
    follow: bool = False
    position: str | None = None  # of the camera, x,y,z [m]; viser reads it too: its page begins there
    look_at: str | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.time_s or 0.0):
            raise ValueError("a time must be finite")

    def query(self) -> str:
        """The address behind its question mark."""
        values: dict[str, Any] = msgspec.to_builtins(self)
        texts = {name: value if isinstance(value, str) else f"{value:.9g}" for name, value in values.items()}
        return urlencode(texts, safe=",", quote_via=quote)

    @classmethod
    def parse(cls, query: str) -> tuple["Address", list[str]]:
        """The address of a page behind its question mark, and a sentence for each value that is no number."""
        values = dict(parse_qsl(query.removeprefix("?"), keep_blank_values=True))
        refused = []
        for name, value in [*values.items()]:
            try:
                msgspec.convert({name: value}, cls, strict=False)
            except msgspec.ValidationError:
                refused.append(f"{name}={value} in the address is no number that makes sense: it is left out.")
                del values[name]
        return msgspec.convert(values, cls, strict=False), refused


class ArchivePanel:
    """The archive's summary, the list of the chosen elites, and a map of where their episodes end."""

    def __init__(self, tab: Any) -> None:
        """Add the panel; a visitor's choices are posted to the ``tab``."""
        gui = tab.client.gui
        self._selection = tab.selection
        self._run = show = tab.show
        panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(_WIDTH)
        if tab.window[0] < _WIDE:
            panel.minimize()
        with panel.add_tab("Archive"):
            title = f"{show.robot.name} · {show.folder} · {len(show.archive):,} elites"
            gui.add_html(_small(f"{escape(title)}<br><b>{escape(summarise_search(show.ranking, show.archive))}.</b>"))
            orders = {label: name for name, label in show.ranking.orders.items()}
            causes = show.causes()
            choose = partial(tab.shared.post, self._choose)
            _add_choice(gui, "Cause", causes, lambda label: choose("cause", causes[label]))
            _add_choice(
                gui, "Sort", orders, lambda label: choose("order", orders[label]), f"Fitness is {FITNESS_TEXT}."
            )
            self.list = gui.add_html("")
            self._map = gui.add_html("")

    def _choose(self, name: str, value: str) -> None:
        self._selection.choose(**{name: value})
        self.show()

    def show(self) -> None:
        """Draw list and map."""
        selection = self._selection
        self._map.content = _small(self._run.render_map(selection.matching, selection.picked))
        self.list.content = _small(self._run.render_list(selection.matching, selection.picked))


class CrossingPanel:
    """The picked elite, its controllers, rates and penalties. Time is on the player bar."""

    def __init__(self, tab: Any) -> None:
        """Add the panel; a visitor's choices are posted to the ``tab``."""
        gui = tab.client.gui
        post = tab.shared.post
        controllers = tab.show.controllers
        self._rates = rate_labels(tab.show.space.asks)
        if tab.window[0] >= PHONE:  # in a narrower window viser makes a sheet of all panels
            gui.main_panel.dock_right()
            gui.main_panel.set_width(_WIDTH if tab.window[0] >= _WIDE else _NARROW_WIDTH)
        self.head = gui.add_html("")
        self.controller = _add_choice(gui, "Controller", controllers or ("none",), partial(post, tab.choose_controller))
        self.ghost = _add_choice(gui, "Ghost", tab.ghost_choices, partial(post, tab.choose_ghost))
        self.controller.disabled = self.ghost.disabled = not controllers
        choose_terrain = partial(post, tab.choose_terrain)
        self.terrain = _add_choice(gui, "Terrain", TERRAINS, lambda label: choose_terrain(label == TERRAINS[1]))
        self.rates = gui.add_html("")
        kinds = [PENALTIES[name] for name in tab.show.archive.penalties]
        series = [uplot.Series(label=kind.label, stroke=kind.color, width=2.0) for kind in kinds]
        with gui.add_folder("Penalties so far, in multiples of their scales", expand_by_default=True):
            look: Any = {"height": 170, "padding": (12, 12, 0, 0), "visible": False}
            nothing = (np.zeros(2),) * (1 + len(kinds))
            self.curves: Any = gui.add_uplot(nothing, (uplot.Series(label="time [s]"), *series), **look)
        views = {"overview": (tab.overview,), "near": (tab.look, "near")}
        films = {"film this": tab.film, "cancel": tab.cancel_film}
        gui.add_button_group("View", tuple(views)).on_click(lambda event: post(*views[event.target.value]))
        gui.add_button_group("Film", tuple(films)).on_click(lambda event: post(films[event.target.value]))
        self.film_status = gui.add_html("")
        with gui.add_folder("Details", expand_by_default=False):
            self.details = gui.add_markdown("")
        with gui.add_folder("Legend", expand_by_default=False):
            ramp = ", ".join(map(to_hex, height_colors(np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))))
            colors = {name: to_hex(color) for name, color in _LEGEND.items()}
            endings = all_endings(tab.show.space.asks).values()
            gui.add_html(TEMPLATES.get_template("legend.html").render(ramp=ramp, endings=endings, **colors))
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown(_KEYS)

    def show_rates(self, columns: Sequence[Column]) -> None:
        """Show how episodes ended."""
        self.rates.content = _small(render_rates(columns, self._rates)) if columns else ""

    def show_film(self, text: str) -> None:
        """Show the progress of a film."""
        self.film_status.content = _small(escape(text))

    def show_curves(self, crossing: Crossing | None) -> None:
        """Show the penalties of a crossing over its time; ``page.js`` draws the line of the present."""
        self.curves.visible = crossing is not None
        if crossing is not None:
            chosen = np.unique(np.linspace(0, len(crossing.penalties) - 1, _CURVE_POINTS).astype(int))
            self.curves.data = (crossing.recording.dt * chosen, *crossing.penalties[chosen].T)


class PlayerBar:
    """The player bar under the scene, where viser has no element: ``page.js`` draws it and sends what a visitor does.

    ``act`` is called in another thread with the name and value of each action, of keys and clicks on elites too.
    """

    def __init__(self, client: viser.ClientHandle, act: Callable[[str, Any], None]) -> None:
        self._client = client
        self._act = act
        self.shown: dict[str, Any] = {}  # values by their names in page.js
        panel = client.gui.add_panel()  # hidden by the script; the field of a folded panel would be gone
        panel.float(x=0.0, y=0.0)
        panel.expand()
        with panel.add_tab("player bar"):
            client.gui.add_html('<i class="faultline-channel"></i>')
            client.gui.add_text("channel", "").on_update(self._receive)
        self._run(_SCRIPT)

    def _receive(self, event: viser.GuiEvent[Any]) -> None:
        with suppress(ValueError, TypeError, AttributeError):  # anybody may write into the field
            _, actions = json.loads(event.target.value)
            for name, value in actions.items():
                self._act(name, value)

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


def _small(text: str) -> str:
    return f'<div style="font-size:0.85em;padding:0.2em 0.6em">{text}</div>' if text else ""


def _add_choice(gui: Any, label: str, options: Iterable[str], act: Callable[[str], None], hint: str = "") -> Any:
    """A choice whose new value is sent on if a visitor, and not this program, sets it."""
    chooser = gui.add_dropdown(label, tuple(options), hint=hint or None)
    chooser.on_update(lambda event: act(event.target.value) if event.client is not None else None)
    return chooser
