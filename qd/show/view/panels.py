"""The panels of the page: the archive left, the crossing right. They tell what a visitor does, and do nothing of it."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import viser

from qd.show.view.elites import Elites
from qd.show.view.pictures import axes_svg
from qd.show.view.state import PAGE, Clock, Selection

Emit = Callable[[str, Any], None]
"""Called with what a visitor did, and its value."""

SPEEDS = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}
_WIDTH = 380  # of a panel [pixels]: between two of them a window of 1,400 shows the terrain from start to goal
_PICKED, _OTHER = (213, 94, 0), (73, 80, 87)
_CONTROL_DT = 0.02  # step of the time slider [s]


class ArchivePanel:
    """The parallel axes, their ranges, and the list of the elites."""

    def __init__(self, server: viser.ViserServer, elites: Elites, title: str, emit: Emit) -> None:
        """Lay it out.

        Args:
            server: The page.
            elites: All of them.
            title: What archive it is.
            emit: Told of ``brush`` (axis, low, high), ``clear``, ``turn`` (pages), ``line`` (of the list), ``step``
                (-1 or 1) and ``pick`` (number).
        """
        self._elites, self._emit, self._gui = elites, emit, server.gui
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
                self._sliders = {axis.name: self._add_slider(axis.name) for axis in elites.axes}
                self._on_click("Free all axes", "clear", None)

    def _add_list(self) -> None:
        self._gui.add_markdown("Elite: fitness · base collision · goal reached, with 95 % intervals")
        self._lines = [self._on_click("", "line", k) for k in range(PAGE)]
        pages = self._gui.add_button_group("Page", ("first", "previous", "next", "last"))
        turns = {"first": -len(self._elites), "previous": -1, "next": 1, "last": len(self._elites)}
        pages.on_click(lambda event: self._emit("turn", turns[event.target.value]))
        steps = self._gui.add_button_group("Elite", ("worse", "milder"))
        steps.on_click(lambda event: self._emit("step", -1 if event.target.value == "worse" else 1))
        self._number = self._gui.add_number("Number", 0, min=0, max=len(self._elites) - 1, step=1)
        self._number.on_update(lambda event: self._tell(event, "pick", event.target.value))

    def _on_click(self, label: str, name: str, value: Any) -> Any:
        button = self._gui.add_button(label)
        button.on_click(lambda event: self._emit(name, value))
        return button

    def _add_slider(self, name: str) -> Any:
        axis = self._elites.axis(name)
        slider = self._gui.add_multi_slider(
            axis.label, min=axis.low, max=axis.high, step=axis.step, initial_value=(axis.low, axis.high)
        )
        slider.on_update(lambda event: self._tell(event, "brush", (name, *event.target.value)))
        return slider

    def _tell(self, event: Any, name: str, value: Any) -> None:
        if event.client is not None:  # a visitor did it, not this program
            self._emit(name, value)

    def show(self, selection: Selection) -> None:
        """Draw plot and list anew."""
        kept, listed = selection.kept, selection.listed
        self._plot.content = axes_svg(self._elites, kept, selection.ranges, selection.picked)
        pages = f" · page {selection.page + 1} of {selection.num_pages}" if len(kept) else ""
        self._count.content = f"**{len(kept):,}** of {len(self._elites):,} elites in the ranges{pages}"
        for k, button in enumerate(self._lines):
            there = k < len(listed)
            button.visible = there
            if there:
                button.label = self._elites.line(listed[k])
                button.color = _PICKED if listed[k] == selection.picked else _OTHER
        self._number.value = selection.picked
        for name, slider in self._sliders.items():
            axis = self._elites.axis(name)
            if name not in selection.ranges and slider.value != (axis.low, axis.high):
                slider.value = (axis.low, axis.high)


class CrossingPanel:
    """The picked elite, and the controls of its crossing."""

    def __init__(self, server: viser.ViserServer, controllers: Sequence[str], replicas: int, emit: Emit) -> None:
        """Lay it out.

        Args:
            server: The page.
            controllers: Their names.
            replicas: Episodes of each elite.
            emit: Told of ``controller`` (name), ``replica`` (number from 0), ``play``, ``seek`` [s], ``speed``,
                ``follow``, ``forces`` and ``paths`` (flags).
        """
        gui, self._emit = server.gui, emit
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self._details = gui.add_markdown("")
        self._controller = gui.add_dropdown("Controller", tuple(controllers) or ("none",), disabled=not controllers)
        self._told(self._controller, "controller", str)
        self._replica = gui.add_slider("Episode", min=1, max=max(replicas, 2), step=1, initial_value=1)
        self._replica.disabled = replicas == 1
        self._told(self._replica, "replica", lambda value: value - 1)
        self._status = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._play.on_click(lambda event: emit("play", None))
        self._time = gui.add_slider("Time [s]", min=0.0, max=20.0, step=_CONTROL_DT, initial_value=0.0)
        self._told(self._time, "seek", float)
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 x")
        self._told(self._speed, "speed", SPEEDS.__getitem__)
        for label, name, initial in (
            ("Follow", "follow", False),
            ("Foot forces (1 m: 1,000 N)", "forces", True),
            ("All ways", "paths", True),
        ):
            self._told(gui.add_checkbox(label, initial), name, bool)
        self._curves = gui.add_html("")
        self._numbers = gui.add_markdown("")

    def _told(self, handle: Any, name: str, convert: Callable[[Any], Any]) -> None:
        """Tells what a visitor sets a control to, and not what this program does."""
        handle.on_update(lambda event: event.client and self._emit(name, convert(event.target.value)))

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
