"""The panels of a tab, the archive left and the crossing right, its keys, and what they stand at.

They hand on what a visitor does to the :class:`qd.show.view.tab.Tab`, by the viewer's loop.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from qd.groups import ORDERS
from qd.show.view.legend import legend_html
from qd.show.view.plots import FITNESS_WORDS, Axes, Choice, axes_svg
from qd.show.view.scene import PHONE, first_view_of

PAGE = 8
"""Lines of the list at once."""
SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}
STEP_S = 0.1
"""Time that a step goes on or back [s]."""
_WIDTH, _NARROW_WIDTH = 380, 300  # of a panel [pixels]
_WIDE = 1200  # a window from here on has room for two wide panels; in another the archive is folded at first [pixels]
_PICKED, _OTHER = (213, 94, 0), (73, 80, 87)
_TERRAINS = ("whole", "minimal")
_CONTROL_DT = 0.02  # step of the time slider [s]
# viser's sheet on a phone has a fixed width, which leaves a strip of the picture beside it.
_WHOLE_WIDTH = """<style>
.mantine-Paper-root[style*="position: fixed"][style*="width: 20em"],
.mantine-Paper-root[style*="position: fixed"] [style*="width: 20em"] { width: 100vw !important; }
</style>"""


class Selection:
    """Which elites are listed in which order, and which of them is picked."""

    def __init__(self, axes: Axes) -> None:
        """All elites listed, the first picked.

        Args:
            axes: Of at least one elite.
        """
        self._axes = axes
        self.ranges: dict[str, tuple[float, float]] = {}
        """Brushed ranges by axis; an axis that is open at both ends has none."""
        self.choice = Choice(ranges=self.ranges)
        """What is listed."""
        self.kept: NDArray[np.int64] = axes.listed(self.choice)
        """Numbers of the elites that are listed, in their order."""
        self.picked = int(self.kept[0])
        """Number of the elite that is shown; it stays when it is not listed any more."""
        self.page = 0
        """Page of the list, from 0."""

    @property
    def num_pages(self) -> int:
        """Pages of the list, at least 1."""
        return max(1, -(-len(self.kept) // PAGE))

    @property
    def listed(self) -> list[int]:
        """Numbers of the elites on the page."""
        return self.kept[self.page * PAGE : (self.page + 1) * PAGE].tolist()

    def brush(self, name: str, low: float, high: float) -> None:
        """Keep elites in a range of an axis alone, ends included; the axis's full range frees it."""
        axis = self._axes.axis(name)
        half = 0.5 * axis.step
        if low <= axis.low + half and high >= axis.high - half:
            self.ranges.pop(name, None)
        else:
            self.ranges[name] = (low, high)
        self._keep()

    def choose(self, **changes: Any) -> None:
        """List other elites, or in another order: fields of :class:`qd.show.view.plots.Choice`."""
        self.choice = replace(self.choice, **changes)
        self._keep()

    def clear(self) -> None:
        """List all elites, in the order that was chosen."""
        self.ranges.clear()
        self.choose(kind="all", mode=None)

    def _keep(self) -> None:
        self.kept = self._axes.listed(self.choice)
        self.page = 0

    def turn(self, pages: int) -> None:
        """Turn the list by some pages, no further than its ends."""
        self.page = int(np.clip(self.page + pages, 0, self.num_pages - 1))

    def pick(self, number: int) -> bool:
        """Show an elite, and its page of the list if it is listed; returns whether it is another one."""
        place = np.flatnonzero(self.kept == number)
        if len(place):
            self.page = int(place[0]) // PAGE
        changed = number != self.picked
        self.picked = number
        return changed

    def step(self, by: int) -> int:
        """Number of the next (1) or previous (-1) elite of the list; the picked one if there is none.

        Of one that is not listed any more, the neighbours are those of its place among all elites.
        """
        everyone = self._axes.listed(Choice(ranges={}, order=self.choice.order))
        place = np.argsort(everyone)  # of each elite by its number
        there = place[self.kept] - place[self.picked]
        near = self.kept[there > 0][:1] if by > 0 else self.kept[there < 0][-1:]
        return int(near[0]) if len(near) else self.picked


@dataclass(kw_only=True)
class Clock:
    """Time within a crossing, run by real time."""

    duration_s: float = 0.0
    """Length of the crossing [s]."""
    time_s: float = 0.0
    """Shown time [s]."""
    speed: float = 1.0
    """Simulated seconds in a real one."""
    playing: bool = False

    def load(self, duration_s: float) -> None:
        """Begin another crossing; playing goes on."""
        self.duration_s = duration_s
        self.time_s = 0.0

    def seek(self, time_s: float) -> None:
        """Show a time, no further than the ends."""
        self.time_s = float(np.clip(time_s, 0.0, self.duration_s))

    def toggle(self) -> None:
        """Play or pause; at its end a crossing begins anew."""
        self.playing = not self.playing
        if self.playing and self.time_s >= self.duration_s:
            self.time_s = 0.0

    def tick(self, real_s: float) -> None:
        """Let real time go by [s]; at its end a crossing stops."""
        if self.playing:
            self.seek(self.time_s + self.speed * real_s)
            self.playing = self.time_s < self.duration_s

    def frame(self, dt: float, num_frames: int) -> int:
        """Frame of the shown time among ``num_frames`` that are ``dt`` [s] apart."""
        return int(np.clip(round(self.time_s / dt), 0, num_frames - 1))


class ArchivePanel:
    """The elites on parallel axes, their ranges, and the list of those in the ranges."""

    def __init__(self, client: viser.ClientHandle, axes: Axes, selection: Selection, title: str, tab: Any) -> None:
        """Lay it out.

        Args:
            client: The tab's browser.
            axes: The elites.
            selection: Those listed, and the one picked.
            title: What archive it is.
            tab: The :class:`qd.show.view.tab.Tab`, which does what a visitor asks for.
        """
        self._axes, self._selection, self._tab, self._gui = axes, selection, tab, client.gui
        self._panel = client.gui.add_panel()
        self._panel.dock_left()
        self._panel.set_width(_WIDTH)
        if client.camera.image_width < _WIDE:
            self._panel.minimize()
        with self._panel.add_tab("Archive"):
            words = escape(title)  # of a folder called anything
            self._title = self._gui.add_html(f'<div style="padding:0.2em 0.6em">{words}</div>')
            self._plot = self._gui.add_html("")
            self._count = self._gui.add_markdown("")
            self._again = self._add_button("List all elites", self.change, selection.clear)
            with self._gui.add_form(None) as form:
                self._number = self._gui.add_text("Number, Enter", "0")
            form.on_submit(lambda event: self._post(self._tab.pick_typed, self._number.value))
            tabs = self._gui.add_tab_group()
            with tabs.add_tab("Elites"):
                self._add_list()
            with tabs.add_tab("Ranges"):
                self._sliders = {axis.name: self._add_slider(axis.name) for axis in axes.axes}
                self._add_button("Free all axes", self.change, selection.clear)

    def _add_list(self) -> None:
        orders = {words: name for name, words in ORDERS.items()}
        self._choosers = {
            "order": (self._add_chooser("Sort", "order", orders, FITNESS_WORDS), orders),
            "kind": (self._add_chooser("Only", "kind", kinds := self._axes.kinds()), kinds),
            "mode": (self._add_chooser("Mode", "mode", modes := self._axes.modes()), modes),
        }
        self._gui.add_markdown("Elite: what it is · goal reached, with its 95 % interval · base collision")
        self._lines = [self._add_button("", self._tab.pick_line, k) for k in range(PAGE)]
        count = len(self._axes.elites)
        turns = {"first": -count, "previous": -1, "next": 1, "last": count}
        _add_choices(self._gui, "Page", turns, lambda by: self._post(self.change, self._selection.turn, by))
        _add_choices(self._gui, "Elite", {"previous": -1, "next": 1}, lambda by: self._post(self._tab.step, by))

    def _add_chooser(self, label: str, name: str, options: Mapping[str, object], hint: str | None = None) -> Any:
        """A list of what a field of the choice can be."""
        chooser = self._gui.add_dropdown(label, tuple(options), hint=hint)
        _on_visit(chooser, lambda words: self._post(self.choose, name, options[str(words)]))
        return chooser

    def _post(self, act: Callable[..., None], *args: object, only_last: object = None) -> None:
        self._tab.common.post(act, *args, only_last=only_last)

    def _add_button(self, label: str, act: Callable[..., None], *args: object) -> Any:
        button = self._gui.add_button(label)
        button.on_click(lambda event: self._post(act, *args))
        return button

    def _add_slider(self, name: str) -> Any:
        axis = self._axes.axis(name)
        slider = self._gui.add_multi_slider(
            axis.label, min=axis.low, max=axis.high, step=axis.step, initial_value=(axis.low, axis.high)
        )
        _on_visit(slider, lambda value: self._post(self.brush, name, *value, only_last=(self, name)))
        return slider

    def change(self, act: Callable[..., object], *args: object) -> None:
        """Change what is listed, by a method of the selection, and show that."""
        act(*args)
        self.show()

    def brush(self, name: str, low: float, high: float) -> None:
        """List the elites in a range of an axis."""
        self.change(self._selection.brush, name, low, high)

    def choose(self, name: str, value: object) -> None:
        """List other elites, or in another order."""
        self._selection.choose(**{name: value})
        self.show()

    def show(self) -> None:
        """Draw plot and list anew."""
        selection = self._selection
        kept, listed = selection.kept, selection.listed
        self._plot.content = axes_svg(self._axes, kept, selection.ranges, selection.picked)
        pages = f" · page {selection.page + 1} of {selection.num_pages}"
        words = f"**{len(kept):,}** of {len(self._axes.elites):,} elites{pages}"
        if not len(kept):
            words = f"**None of {len(self._axes.elites):,} elites** is of this kind and mode within these ranges."
        self._count.content = words
        self._again.visible = not len(kept)
        for name, (chooser, options) in self._choosers.items():
            chosen = getattr(selection.choice, name)
            chooser.value = next(words for words, value in options.items() if value == chosen)
        for k, button in enumerate(self._lines):
            there = k < len(listed)
            button.visible = there
            if there:
                button.label = self._axes.line(listed[k])
                button.color = _PICKED if listed[k] == selection.picked else _OTHER
        self._number.value = str(selection.picked)
        for name, slider in self._sliders.items():
            axis = self._axes.axis(name)
            if name not in selection.ranges and slider.value != (axis.low, axis.high):
                slider.value = (axis.low, axis.high)


class CrossingPanel:
    """The picked elite, and the controls of its crossing."""

    def __init__(self, client: viser.ClientHandle, controllers: Sequence[str], tab: Any) -> None:
        """Lay it out.

        Args:
            client: The tab's browser.
            controllers: Their names.
            tab: The :class:`qd.show.view.tab.Tab`, which does what a visitor asks for.
        """
        gui, self._post = client.gui, tab.common.post
        is_phone = client.camera.image_width < PHONE  # where viser makes a sheet of it
        if not is_phone:
            gui.main_panel.dock_right()
            gui.main_panel.set_width(_WIDTH if client.camera.image_width >= _WIDE else _NARROW_WIDTH)
        self._details = gui.add_markdown("")
        self._controller = gui.add_dropdown("Controller", tuple(controllers) or ("none",), disabled=not controllers)
        _on_visit(self._controller, lambda name: self._post(tab.choose_controller, str(name)))
        self._ghost: Any = gui.add_dropdown("Ghost", tab.ghost.choices, disabled=not controllers)
        _on_visit(self._ghost, lambda name: self._post(tab.choose_ghost, str(name)))
        self._terrain: Any = gui.add_dropdown("Terrain", _TERRAINS, visible=False)
        _on_visit(self._terrain, lambda name: self._post(tab.choose_terrain, str(name) == _TERRAINS[1]))
        self._groups: Any = gui.add_dropdown("Episodes", ("none",), disabled=True)
        _on_visit(self._groups, lambda name: self._post(tab.choose_group, str(name)))
        self._episode: Any = gui.add_dropdown("Episode", ("none",), disabled=True)
        _on_visit(self._episode, lambda name: self._post(tab.choose_replica, int(str(name).split(":")[0]) - 1))
        self._status = gui.add_html("")
        self._ghost_status = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._play.on_click(lambda event: self._post(tab.play))
        self._time = gui.add_slider("Time [s]", min=0.0, max=20.0, step=_CONTROL_DT, initial_value=0.0)
        _on_visit(self._time, lambda value: self._post(tab.seek, float(value), only_last=(self, "time")))
        steps = {f"-{STEP_S} s": (tab.go_on, -STEP_S), f"+{STEP_S} s": (tab.go_on, STEP_S)}
        steps |= {"next mark": (tab.go_to_next_mark,), "next episode": (tab.step_replica, 1)}
        steps_shown = _add_choices(gui, "Go", steps, lambda asked: self._post(*asked))
        self._curves = gui.add_html("")
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 x")
        _on_visit(self._speed, lambda value: self._post(tab.set_speed, SPEEDS[value]))
        views = {"overview": (tab.overview,), "near": (tab.look, first_view_of)}
        _add_choices(gui, "View", views, lambda asked: self._post(*asked))
        copies = {"copy link": (tab.copy_link,), "copy command": (tab.copy_command,)}
        _add_choices(gui, "Share", copies, lambda asked: self._post(*asked))
        self._follow = self._add_switch(gui, "Follow", tab.set_follow, False)
        self._add_switch(gui, "Foot forces", tab.set_forces, True)
        self._add_switch(gui, "All paths", tab.scene.set_show_paths, True)
        self._add_switch(gui, "Names of feet", tab.set_names, False)
        self._numbers = gui.add_markdown("")
        with gui.add_folder("Legend", expand_by_default=False):
            gui.add_html(legend_html(controllers))
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown("\n".join(f"- **{key}** {words.lower()}" for key, words in KEY_WORDS))
        if is_phone:
            gui.add_html(_WHOLE_WIDTH)
            first = (self._status, self._ghost_status, self._progress, self._play, self._time, steps_shown)
            for place, handle in enumerate(first):  # so that they are in sight beside the picture
                handle.order = place - len(first)

    def _add_switch(self, gui: Any, label: str, switch: Callable[[bool], None], initial: bool) -> Any:
        box = gui.add_checkbox(label, initial)
        _on_visit(box, lambda value: self._post(switch, bool(value)))
        return box

    def show_elite(self, details: str) -> None:
        """Say what the archive knows of the picked elite, as Markdown."""
        self._details.content = details

    def show_terrain(self, has_minimal: bool, minimal: bool) -> None:
        """Say which terrain of the elite is shown, where it has two."""
        self._terrain.visible = has_minimal
        self._terrain.value = _TERRAINS[minimal]

    def show_controller(self, name: str | None) -> None:
        """Say whose crossings are shown."""
        if name is not None:
            self._controller.value = name

    def show_ghost(self, choice: str, words: str) -> None:
        """Say who the ghost is to be, and as HTML what became of it."""
        self._ghost.value = choice
        self._ghost_status.content = _small(words)

    def show_episodes(self, groups: Sequence[str], group: str, episodes: dict[int, str], shown: int) -> None:
        """Offer episodes.

        Args:
            groups: What episodes can have in common, in words.
            group: That of those offered.
            episodes: Words of each, by its number from 0.
            shown: Number of the one that is shown.
        """
        offered: tuple[tuple[Any, tuple[str, ...], str], ...] = (
            (self._groups, tuple(groups), group),
            (self._episode, tuple(episodes.values()), episodes[shown]),
        )
        for handle, options, value in offered:
            handle.disabled = False
            if handle.options != options:
                handle.options = options
            handle.value = value

    def show_status(self, text: str, share: float | None = None) -> None:
        """Say how the crossing ended, as HTML, or how far its recording is (0 to 1)."""
        self._status.content = _small(text)
        self._progress.visible = share is not None
        if share is not None:
            self._progress.value = 100.0 * share

    def show_controls(self, clock: Clock, *, enabled: bool) -> None:
        """Set the controls to where the crossing stands; without one they are off."""
        for handle in (self._play, self._time):
            handle.disabled = not enabled
        if not enabled:
            self._groups.disabled = self._episode.disabled = True
        self._time.max = max(round(clock.duration_s, 2), _CONTROL_DT)
        self.show_time(clock)

    def show_time(self, clock: Clock) -> None:
        """Set time and button."""
        self._time.value = round(clock.time_s, 2)
        label = "Pause" if clock.playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if clock.playing else viser.Icon.PLAYER_PLAY

    def show_follow(self, follow: bool) -> None:
        """Set the switch that follows."""
        self._follow.value = follow

    def show_moment(self, curves: str, numbers: str) -> None:
        """Show the penalties up to a time, as SVG, and the numbers of the moment, as Markdown."""
        self._curves.content = curves
        self._numbers.content = numbers


KEY_WORDS = (
    ("Space", "Plays or pauses"),
    ("Left, Right", f"Go {STEP_S} s back or on"),
    ("M", "Goes to the next mark"),
    ("N, P", "Show the next or the previous elite of the list"),
    ("1 to 9", "Show an episode"),
    ("F", "Follows the robot, or stays"),
    ("O", "Shows the whole terrain"),
)
"""Keys and what they do."""


def add_keys(client: viser.ClientHandle, tab: Any) -> None:
    """Have keys do what the panels do; those of a text field stay with it.

    Args:
        client: The tab's browser.
        tab: The :class:`qd.show.view.tab.Tab`, which does what a visitor asks for.
    """
    asked: dict[str, tuple[Any, tuple[Callable[..., None], object] | tuple[Callable[..., None]]]] = {
        "Play or pause": ("space", (tab.play,)),
        "Go back": ("arrowleft", (tab.go_on, -STEP_S)),
        "Go on": ("arrowright", (tab.go_on, STEP_S)),
        "Next mark": ("M", (tab.go_to_next_mark,)),
        "Next elite": ("N", (tab.step, 1)),
        "Previous elite": ("P", (tab.step, -1)),
        "Follow": ("F", (tab.toggle_follow,)),
        "Overview": ("O", (tab.overview,)),
        **{f"Episode {k}": (str(k), (tab.choose_replica, k - 1)) for k in range(1, 10)},
    }
    for label, (key, act) in asked.items():
        command = client.gui.add_command(label, hotkey=key)
        command.on_trigger(lambda event, act=act: tab.common.post(*act))


def _small(text: str) -> str:
    """HTML in small print."""
    return f'<div style="font-size:0.85em;padding:0.2em 0.6em">{text}</div>' if text else ""


def _add_choices(gui: Any, label: str, choices: dict[str, Any], act: Callable[[Any], None]) -> Any:
    """Buttons side by side, each with what to call ``act`` with."""
    buttons = gui.add_button_group(label, tuple(choices))
    buttons.on_click(lambda event: act(choices[event.target.value]))
    return buttons


def _on_visit(handle: Any, act: Callable[[Any], None]) -> None:
    """Acts on the value that a visitor sets a control to, and not on what this program sets."""
    handle.on_update(lambda event: act(event.target.value) if event.client is not None else None)
