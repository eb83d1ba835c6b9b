"""The panels of a tab, the archive left and the crossing right, its keys, and what they stand at.

They hand on what a visitor does to the :class:`qd.show.view.tab.Tab`, by the viewer's loop.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
    """Which elites are listed in which order, and which of them is picked; at first all, and the first of them."""

    def __init__(self, axes: Axes) -> None:
        self._axes = axes
        self.ranges: dict[str, tuple[float, float]] = {}
        """Brushed ranges by axis; an axis that is open at both ends has none."""
        self.choice = Choice(ranges=self.ranges)
        self.matching: NDArray[np.int64] = axes.listed(self.choice)
        """Numbers of the elites on all pages of the list, in their order."""
        self.picked = int(self.matching[0])
        """Number of the elite that is shown; it stays when it is not listed any more."""
        self.page = 0
        """Page of the list, from 0."""

    @property
    def num_pages(self) -> int:
        """Pages of the list, at least 1."""
        return max(1, -(-len(self.matching) // PAGE))

    @property
    def listed(self) -> list[int]:
        """Numbers of the elites on the page."""
        return self.matching[self.page * PAGE : (self.page + 1) * PAGE].tolist()

    def brush(self, name: str, low: float, high: float) -> None:
        """List only elites in a range of an axis, ends included; the axis's full range frees it."""
        axis = self._axes.axis(name)
        half = 0.5 * axis.step
        if low <= axis.low + half and high >= axis.high - half:
            self.ranges.pop(name, None)
        else:
            self.ranges[name] = (low, high)
        self.choose()

    def choose(self, **changes: Any) -> None:
        """List other elites, or in another order: fields of :class:`qd.show.view.plots.Choice`."""
        self.choice = replace(self.choice, **changes)
        self.matching = self._axes.listed(self.choice)
        self.page = 0

    def clear(self) -> None:
        """List all elites, in the order that was chosen."""
        self.ranges.clear()
        self.choose(kind="all", mode=None)

    def turn(self, pages: int) -> None:
        """Turn the list by some pages, no further than its ends."""
        self.page = int(np.clip(self.page + pages, 0, self.num_pages - 1))

    def pick(self, number: int) -> bool:
        """Show an elite, and its page of the list if it is listed; returns whether it is another one."""
        place = np.flatnonzero(self.matching == number)
        if len(place):
            self.page = int(place[0]) // PAGE
        changed = number != self.picked
        self.picked = number
        return changed

    def step(self, by: int) -> int:
        """Number of the next (1) or previous (-1) elite of the list; the picked one at the end of the list.

        If the picked one is not listed any more, its neighbours are those of its place among all elites.
        """
        everyone = self._axes.listed(Choice(ranges={}, order=self.choice.order))
        place = np.argsort(everyone)  # of each elite by its number
        ahead = place[self.matching] - place[self.picked]
        near = self.matching[ahead > 0][:1] if by > 0 else self.matching[ahead < 0][-1:]
        return int(near[0]) if len(near) else self.picked


@dataclass(kw_only=True)
class Clock:
    """Time within a crossing, run by real time."""

    duration_s: float = 0.0
    time_s: float = 0.0
    speed: float = 1.0
    """Simulated seconds in a real one."""
    playing: bool = False

    def load(self, duration_s: float) -> None:
        """Begin another crossing; playing goes on."""
        self.duration_s, self.time_s = duration_s, 0.0

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

    def __init__(self, client: viser.ClientHandle, selection: Selection, title: str, tab: Any) -> None:
        """Lay it out; the ``tab`` does what a visitor asks for."""
        self._selection, self._tab, self._gui = selection, tab, client.gui
        self._axes: Axes = tab.common.show.axes
        panel = client.gui.add_panel()
        panel.dock_left()
        panel.set_width(_WIDTH)
        if client.camera.image_width < _WIDE:
            panel.minimize()
        with panel.add_tab("Archive"):
            self._gui.add_html(f'<div style="padding:0.2em 0.6em">{escape(title)}</div>')
            self._plot = self._gui.add_html("")
            self.count = self._gui.add_markdown("")
            self._again = self._add_button("List all elites", self.change, selection.clear)
            with self._gui.add_form(None) as form:
                self.number = self._gui.add_text("Number, Enter", "0")
            form.on_submit(lambda event: self._post(tab.pick_typed, self.number.value))
            tabs = self._gui.add_tab_group()
            with tabs.add_tab("Elites"):
                self._add_list()
            with tabs.add_tab("Ranges"):
                self._sliders = {axis.name: self._add_slider(axis.name) for axis in self._axes.axes}
                self._add_button("Free all axes", self.change, selection.clear)

    def _add_list(self) -> None:
        orders = {words: name for name, words in ORDERS.items()}
        self._choosers = {
            "order": (self._add_chooser("Sort", "order", orders, f"Fitness is {FITNESS_WORDS}."), orders),
            "kind": (self._add_chooser("Only", "kind", kinds := self._axes.kinds()), kinds),
            "mode": (self._add_chooser("Mode", "mode", modes := self._axes.modes()), modes),
        }
        self._gui.add_markdown("Elite: what it is · goal reached, with its 95 % interval · base collision")
        self.lines = [self._add_button("", self._tab.pick_line, k) for k in range(PAGE)]
        count = len(self._axes.elites)
        turns = {"first": -count, "previous": -1, "next": 1, "last": count}
        turn, step = self._selection.turn, self._tab.step
        _add_choices(self._gui, "Page", {name: (self.change, turn, by) for name, by in turns.items()}, self._post)
        _add_choices(self._gui, "Elite", {"previous": (step, -1), "next": (step, 1)}, self._post)

    def _add_chooser(self, label: str, name: str, options: Mapping[str, object], hint: str | None = None) -> Any:
        chooser = self._gui.add_dropdown(label, tuple(options), hint=hint)
        _on_visit(
            chooser, lambda words: self._post(self.change, partial(self._selection.choose, **{name: options[words]}))
        )
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
        _on_visit(
            slider, lambda value: self._post(self.change, self._selection.brush, name, *value, only_last=(self, name))
        )
        return slider

    def change(self, act: Callable[..., object], *args: object) -> None:
        """Change what is listed, by a method of the selection, and show that."""
        act(*args)
        self.show()

    def show(self) -> None:
        """Draw plot and list anew."""
        selection, axes = self._selection, self._axes
        matching, listed = selection.matching, selection.listed
        self._plot.content = axes_svg(axes, matching, selection.ranges, selection.picked)
        pages = f" · page {selection.page + 1} of {selection.num_pages}"
        self.count.content = f"**{len(matching):,}** of {len(axes.elites):,} elites{pages}"
        self._again.visible = not len(matching)
        for name, (chooser, options) in self._choosers.items():
            chosen = getattr(selection.choice, name)
            chooser.value = next(words for words, value in options.items() if value == chosen)
        for k, button in enumerate(self.lines):
            button.visible = k < len(listed)
            if button.visible:
                button.label = axes.line(listed[k])
                button.color = _PICKED if listed[k] == selection.picked else _OTHER
        self.number.value = str(selection.picked)
        for name, slider in self._sliders.items():
            axis = axes.axis(name)
            if name not in selection.ranges and slider.value != (axis.low, axis.high):
                slider.value = (axis.low, axis.high)


class CrossingPanel:
    """The picked elite, and the controls of its crossing."""

    def __init__(self, client: viser.ClientHandle, controllers: Sequence[str], tab: Any) -> None:
        """Lay it out; the ``tab`` does what a visitor asks for."""
        gui, post = client.gui, tab.common.post
        is_phone = client.camera.image_width < PHONE  # where viser makes a sheet of it
        if not is_phone:
            gui.main_panel.dock_right()
            gui.main_panel.set_width(_WIDTH if client.camera.image_width >= _WIDE else _NARROW_WIDTH)
        self.details = gui.add_markdown("")
        self.controller = gui.add_dropdown("Controller", tuple(controllers) or ("none",), disabled=not controllers)
        _on_visit(self.controller, lambda name: post(tab.choose_controller, name))
        self.ghost: Any = gui.add_dropdown("Ghost", tab.ghost.choices, disabled=not controllers)
        _on_visit(self.ghost, lambda name: post(tab.choose_ghost, name))
        self.terrain: Any = gui.add_dropdown("Terrain", _TERRAINS, visible=False)
        _on_visit(self.terrain, lambda name: post(tab.choose_terrain, name == _TERRAINS[1]))
        self.groups: Any = gui.add_dropdown("Episodes", ("none",), disabled=True)
        _on_visit(self.groups, lambda name: post(tab.choose_group, name))
        self.episode: Any = gui.add_dropdown("Episode", ("none",), disabled=True)
        _on_visit(self.episode, lambda name: post(tab.choose_replica, int(name.split(":")[0]) - 1))
        self.status = gui.add_html("")
        self.ghost_status = gui.add_html("")
        self.progress = gui.add_progress_bar(0.0, visible=False)
        self.play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.play.on_click(lambda event: post(tab.play))
        self.time = gui.add_slider("Time [s]", min=0.0, max=20.0, step=_CONTROL_DT, initial_value=0.0)
        _on_visit(self.time, lambda value: post(tab.seek, float(value), only_last=(self, "time")))
        steps = {f"-{STEP_S} s": (tab.go_on, -STEP_S), f"+{STEP_S} s": (tab.go_on, STEP_S)}
        steps |= {"next mark": (tab.go_to_next_mark,), "next episode": (tab.step_replica, 1)}
        step_buttons = _add_choices(gui, "Go", steps, post)
        self.curves = gui.add_html("")
        speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 x")
        _on_visit(speed, lambda name: post(tab.set_speed, SPEEDS[name]))
        _add_choices(gui, "View", {"overview": (tab.overview,), "near": (tab.look, first_view_of)}, post)
        _add_choices(gui, "Share", {"copy link": (tab.copy_link,), "copy command": (tab.copy_command,)}, post)
        switches = {
            "Follow": (tab.set_follow, False),
            "Foot forces": (tab.set_forces, True),
            "All paths": (tab.scene.switch_paths, True),
            "Names of feet": (tab.set_names, False),
        }
        boxes = {label: gui.add_checkbox(label, value) for label, (_, value) in switches.items()}
        for label, (switch, _) in switches.items():
            _on_visit(boxes[label], lambda value, switch=switch: post(switch, value))
        self.follow = boxes["Follow"]
        self.numbers = gui.add_markdown("")
        with gui.add_folder("Legend", expand_by_default=False):
            gui.add_html(legend_html(controllers))
        with gui.add_folder("Keys", expand_by_default=False):
            gui.add_markdown(add_keys(client, tab))
        if is_phone:
            gui.add_html(_WHOLE_WIDTH)
            first = (self.status, self.ghost_status, self.progress, self.play, self.time, step_buttons)
            for place, handle in enumerate(first):  # so that they are in sight beside the picture
                handle.order = place - len(first)

    def show_terrain(self, has_minimal: bool, minimal: bool) -> None:
        """Say which terrain of the elite is shown, if it has two."""
        self.terrain.visible = has_minimal
        self.terrain.value = _TERRAINS[minimal]

    def show_ghost(self, choice: str, words: str) -> None:
        """Say which ghost is chosen, and its status as HTML."""
        self.ghost.value = choice
        self.ghost_status.content = _small(words)

    def show_episodes(self, groups: Sequence[str], group: str, episodes: dict[int, str], shown: int) -> None:
        """Offer the groups of episodes, and the episodes of one of them in words by their number from 0."""
        for handle, options, value in (
            (self.groups, tuple(groups), group),
            (self.episode, tuple(episodes.values()), episodes[shown]),
        ):
            handle.disabled = False
            if handle.options != options:
                handle.options = options
            handle.value = value

    def show_status(self, text: str, share: float | None = None) -> None:
        """Say how the crossing ended, as HTML, or how far its recording is (0 to 1)."""
        self.status.content = _small(text)
        self.progress.visible = share is not None
        self.progress.value = 100.0 * (share or 0.0)

    def show_controls(self, clock: Clock, *, enabled: bool) -> None:
        """Set the controls to where the crossing stands; without one they are off."""
        self.play.disabled = self.time.disabled = not enabled
        if not enabled:
            self.groups.disabled = self.episode.disabled = True
        self.time.max = max(round(clock.duration_s, 2), _CONTROL_DT)
        self.show_time(clock)

    def show_time(self, clock: Clock) -> None:
        """Set time and button."""
        self.time.value = round(clock.time_s, 2)
        label = "Pause" if clock.playing else "Play"
        if self.play.label != label:
            self.play.label = label
            self.play.icon = viser.Icon.PLAYER_PAUSE if clock.playing else viser.Icon.PLAYER_PLAY


def add_keys(client: viser.ClientHandle, tab: Any) -> str:
    """Have keys do what the panels do; those of a text field stay with it. Returns what they do, as Markdown."""
    tasks: dict[str, tuple[Any, tuple[Any, ...]]] = {
        "Play or pause": ("space", (tab.play,)),
        f"Go {STEP_S} s back": ("arrowleft", (tab.go_on, -STEP_S)),
        f"Go {STEP_S} s on": ("arrowright", (tab.go_on, STEP_S)),
        "Next mark": ("M", (tab.go_to_next_mark,)),
        "Next elite": ("N", (tab.step, 1)),
        "Previous elite": ("P", (tab.step, -1)),
        "Follow the robot, or stay": ("F", (tab.toggle_follow,)),
        "Overview": ("O", (tab.overview,)),
    }
    lines = [f"- **{key.removeprefix('arrow').title()}** {label.lower()}" for label, (key, _) in tasks.items()]
    tasks |= {f"Episode {k}": (str(k), (tab.choose_replica, k - 1)) for k in range(1, 10)}
    for label, (key, task) in tasks.items():
        command = client.gui.add_command(label, hotkey=key)
        command.on_trigger(lambda event, task=task: tab.common.post(*task))
    return "\n".join([*lines, "- **1 to 9** an episode"])


def _small(text: str) -> str:
    """HTML in small print."""
    return f'<div style="font-size:0.85em;padding:0.2em 0.6em">{text}</div>' if text else ""


def _add_choices(gui: Any, label: str, tasks: dict[str, tuple[Any, ...]], post: Callable[..., None]) -> Any:
    """Buttons side by side, each with what the loop is to call."""
    buttons = gui.add_button_group(label, tuple(tasks))
    buttons.on_click(lambda event: post(*tasks[event.target.value]))
    return buttons


def _on_visit(handle: Any, act: Callable[[Any], None]) -> None:
    """Acts on the value that a visitor sets a control to, and not on what this program sets."""
    handle.on_update(lambda event: act(event.target.value) if event.client is not None else None)
