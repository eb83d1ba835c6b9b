"""The panels of the page, the archive left and the crossing right, and what they stand at.

They hand on what a visitor does to the :class:`qd.show.view.app.App`, which does it in its loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import NDArray

from qd.show.view.plots import Axes, axes_svg

if TYPE_CHECKING:
    from qd.show.view.app import App

PAGE = 8
"""Lines of the list at once."""
SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}
_WIDTH = 380  # of a panel [pixels]: between two of them a window of 1,400 shows the terrain from start to goal
_PICKED, _OTHER = (213, 94, 0), (73, 80, 87)
_CONTROL_DT = 0.02  # step of the time slider [s]


class Selection:
    """Which elites are in the brushed ranges, and which of them is picked."""

    def __init__(self, axes: Axes) -> None:
        """Nothing brushed, the worst elite picked.

        Args:
            axes: Of at least one elite.
        """
        self._axes = axes
        self.ranges: dict[str, tuple[float, float]] = {}
        """Brushed ranges by axis; an axis that is open at both ends has none."""
        self.kept: NDArray[np.int64] = axes.within({})
        """Numbers of the elites in all ranges, worst first."""
        self.picked = 0
        """Number of the elite that is shown; it stays when a range leaves it out."""
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

    def clear(self) -> None:
        """Free all axes."""
        self.ranges.clear()
        self._keep()

    def _keep(self) -> None:
        self.kept = self._axes.within(self.ranges)
        self.page = 0

    def turn(self, pages: int) -> None:
        """Turn the list by some pages, no further than its ends."""
        self.page = int(np.clip(self.page + pages, 0, self.num_pages - 1))

    def pick(self, number: int) -> bool:
        """Show an elite, and its page of the list if it is in the ranges; returns whether it is another one."""
        place = np.searchsorted(self.kept, number)
        if place < len(self.kept) and self.kept[place] == number:
            self.page = int(place) // PAGE
        changed = number != self.picked
        self.picked = number
        return changed

    def step(self, by: int) -> int:
        """Number of the next (1) or previous (-1) elite in the ranges; the picked one if there is none."""
        if by > 0:
            later = self.kept[self.kept > self.picked]
            return int(later[0]) if len(later) else self.picked
        earlier = self.kept[self.kept < self.picked]
        return int(earlier[-1]) if len(earlier) else self.picked


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
    """The parallel axes, their ranges, and the list of the elites."""

    def __init__(self, server: viser.ViserServer, axes: Axes, selection: Selection, title: str, app: "App") -> None:
        """Lay it out.

        Args:
            server: The page.
            axes: The elites.
            selection: Those listed, and the one picked.
            title: What archive it is.
            app: Does what a visitor asks for.
        """
        self._axes, self._selection, self._app, self._gui = axes, selection, app, server.gui
        self._panel = server.gui.add_panel()
        self._panel.dock_left()
        self._panel.set_width(_WIDTH)
        with self._panel.add_tab("Archive"):
            words = escape(title)  # of a folder called anything
            self._title = server.gui.add_html(f'<div style="padding:0.2em 0.6em">{words}</div>')
            self._plot = server.gui.add_html("")
            self._count = server.gui.add_markdown("")
            tabs = server.gui.add_tab_group()
            with tabs.add_tab("Worst first"):
                self._add_list()
            with tabs.add_tab("Ranges"):
                self._sliders = {axis.name: self._add_slider(axis.name) for axis in axes.axes}
                self._add_button("Free all axes", self.change, selection.clear)

    def _add_list(self) -> None:
        self._gui.add_markdown("Elite: fitness · base collision · goal reached, with 95 % intervals")
        self._lines = [self._add_button("", self._app.pick_line, k) for k in range(PAGE)]
        pages = self._gui.add_button_group("Page", ("first", "previous", "next", "last"))
        turns = {"first": -len(self._axes.elites), "previous": -1, "next": 1, "last": len(self._axes.elites)}
        pages.on_click(lambda event: self._app.post(self.change, self._selection.turn, turns[event.target.value]))
        steps = self._gui.add_button_group("Elite", ("worse", "milder"))
        steps.on_click(lambda event: self._app.post(self._app.step, -1 if event.target.value == "worse" else 1))
        self._number = self._gui.add_number("Number", 0, min=0, max=len(self._axes.elites) - 1, step=1)
        _on_visit(self._number, lambda value: self._app.post(self._app.pick, int(value)))

    def _add_button(self, label: str, act: Callable[..., None], *args: object) -> Any:
        button = self._gui.add_button(label)
        button.on_click(lambda event: self._app.post(act, *args))
        return button

    def _add_slider(self, name: str) -> Any:
        axis = self._axes.axis(name)
        slider = self._gui.add_multi_slider(
            axis.label, min=axis.low, max=axis.high, step=axis.step, initial_value=(axis.low, axis.high)
        )
        _on_visit(slider, lambda value: self._app.post(self.brush, name, *value))
        return slider

    def change(self, act: Callable[..., object], *args: object) -> None:
        """Change what is listed, by a method of the selection, and show that."""
        act(*args)
        self.show()

    def brush(self, name: str, low: float, high: float) -> None:
        """List the elites in a range of an axis."""
        self.change(self._selection.brush, name, low, high)

    def show(self) -> None:
        """Draw plot and list anew."""
        selection = self._selection
        kept, listed = selection.kept, selection.listed
        self._plot.content = axes_svg(self._axes, kept, selection.ranges, selection.picked)
        pages = f" · page {selection.page + 1} of {selection.num_pages}" if len(kept) else ""
        self._count.content = f"**{len(kept):,}** of {len(self._axes.elites):,} elites in the ranges{pages}"
        for k, button in enumerate(self._lines):
            there = k < len(listed)
            button.visible = there
            if there:
                button.label = self._axes.line(listed[k])
                button.color = _PICKED if listed[k] == selection.picked else _OTHER
        self._number.value = selection.picked
        for name, slider in self._sliders.items():
            axis = self._axes.axis(name)
            if name not in selection.ranges and slider.value != (axis.low, axis.high):
                slider.value = (axis.low, axis.high)


class CrossingPanel:
    """The picked elite, and the controls of its crossing."""

    def __init__(self, server: viser.ViserServer, controllers: Sequence[str], replicas: int, app: "App") -> None:
        """Lay it out.

        Args:
            server: The page.
            controllers: Their names.
            replicas: Episodes of each elite.
            app: Does what a visitor asks for.
        """
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self._details = gui.add_markdown("")
        self._controller = gui.add_dropdown("Controller", tuple(controllers) or ("none",), disabled=not controllers)
        _on_visit(self._controller, lambda name: app.post(app.choose_controller, str(name)))
        self._replica = gui.add_slider("Episode", min=1, max=max(replicas, 2), step=1, initial_value=1)
        self._replica.disabled = replicas == 1
        _on_visit(self._replica, lambda value: app.post(app.choose_replica, int(value) - 1))
        self._status = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._play.on_click(lambda event: app.post(app.play))
        self._time = gui.add_slider("Time [s]", min=0.0, max=20.0, step=_CONTROL_DT, initial_value=0.0)
        _on_visit(self._time, lambda value: app.post(app.seek, float(value)))
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 x")
        _on_visit(self._speed, lambda value: app.post(app.set_speed, SPEEDS[value]))
        switches = (
            ("Follow", app.scene.set_follow, False),
            ("Foot forces (1 m: 1,000 N)", app.set_forces, True),
            ("All paths", app.scene.set_show_paths, True),
        )
        for label, switch, initial in switches:
            box = gui.add_checkbox(label, initial)
            _on_visit(box, lambda value, switch=switch: app.post(switch, bool(value)))
        self._curves = gui.add_html("")
        self._numbers = gui.add_markdown("")

    def show_elite(self, details: str) -> None:
        """Say what the archive knows of the picked elite, as Markdown."""
        self._details.content = details

    def show_status(self, text: str, share: float | None = None) -> None:
        """Say how the crossing ended, as HTML, or how far its recording is (0 to 1)."""
        self._status.content = f'<div style="font-size:0.85em;padding:0.2em 0.6em">{text}</div>'
        self._progress.visible = share is not None
        if share is not None:
            self._progress.value = 100.0 * share

    def show_controls(self, clock: Clock, replica: int, *, enabled: bool) -> None:
        """Set the controls to where the crossing stands; without one they are off."""
        self._replica.value = replica + 1
        for handle in (self._play, self._time):
            handle.disabled = not enabled
        self._time.max = max(round(clock.duration_s, 2), _CONTROL_DT)
        self.show_time(clock)

    def show_time(self, clock: Clock) -> None:
        """Set time and button."""
        self._time.value = round(clock.time_s, 2)
        label = "Pause" if clock.playing else "Play"
        if self._play.label != label:
            self._play.label = label
            self._play.icon = viser.Icon.PLAYER_PAUSE if clock.playing else viser.Icon.PLAYER_PLAY

    def show_moment(self, curves: str, numbers: str) -> None:
        """Show the penalties up to a time, as SVG, and the numbers of the moment, as Markdown."""
        self._curves.content = curves
        self._numbers.content = numbers


def _on_visit(handle: Any, act: Callable[[Any], None]) -> None:
    """Acts on the value that a visitor sets a control to, and not on what this program sets."""
    handle.on_update(lambda event: act(event.target.value) if event.client is not None else None)
