"""What a visitor takes along from a tab: its link, the command that replays it, the terrain's files, a film."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import viser

from qd.show.view.address import copy_link, copy_text
from qd.show.view.command import SEARCHED
from qd.show.view.errands import Made
from sim.files.command import command_line, command_words
from sim.recording.file import write_recording

if TYPE_CHECKING:
    from qd.show.view.tab import Tab


class Taking:
    """Copies and makes what a tab shows; all methods are called by the loop."""

    def __init__(self, tab: "Tab") -> None:
        """Nothing is made yet.

        Args:
            tab: What is shown.
        """
        self._tab, self._client, self._show = tab, tab.client, tab.common.show

    @property
    def _name(self) -> str:
        """What files of the terrain are called."""
        return f"{'elite' if self._tab.genes is None else 'minimal'}-{self._tab.elite}"

    def _which(self) -> dict[str, object]:
        """The flags that name the terrain on a command line."""
        show, number = self._show, self._tab.elite
        which = {"elite": number} if self._tab.genes is None else {"minimal": number}
        return {"robot": show.robot.spec, "run": show.found.run, "space": show.cfg.space, **which}

    def link(self) -> None:
        """Copy the link to what the tab shows."""
        self._tab.show_address()
        copy_link(self._client)
        self._client.add_notification("Link copied", "It opens what this tab shows.", auto_close_seconds=3.0)

    def command(self) -> None:
        """Copy the command that replays what the tab shows."""
        name = self._tab.controller
        policy = None if name is None or name == SEARCHED else self._show.controllers[name]
        text = command_line("replay", **self._which(), policy=policy, replicas=self._show.cfg.replicas)
        copy_text(self._client, text)
        self._client.add_notification("Command copied", text, auto_close_seconds=6.0)

    def files(self) -> None:
        """Have the browser get the terrain as files."""
        which = self._which()

        def words(folder: Path) -> list[str]:
            return command_words("export", **which, out=folder / "files")

        self._run(f"{self._name}.zip", words, lambda folder: folder / "files")

    def film(self) -> None:
        """Have the browser get a film of the episode that is shown."""
        if self._tab.filmed is None:
            self._tab.refuse("There is no crossing to film yet.")
            return
        recording, replica = self._tab.filmed

        def words(folder: Path) -> list[str]:
            file = folder / "it.recording.npz"
            write_recording(file, recording)
            robot, count, out = self._show.robot.spec, recording.num_episodes, folder / "it.mp4"
            return command_words("film", recording=file, robot=robot, replicas=count, replica=replica, out=out)

        self._run(f"{self._name}-episode-{replica + 1}.mp4", words, lambda folder: folder / "it.mp4")

    def _run(self, name: str, words: Callable[[Path], Sequence[str]], made: Callable[[Path], Path]) -> None:
        """Have a command make a file for the browser, and say so."""
        note = self._client.add_notification(f"Making {name}", "The page goes on meanwhile.", loading=True)
        common = self._tab.common

        def done(result: Made) -> None:
            common.post(self.take, name, result, note)

        if not common.errands.run(self._client.client_id, words, made, done):
            note.remove()
            self._tab.refuse("Another file is being made for this tab: wait for it.")

    def take(self, name: str, made: Made, note: viser.NotificationHandle) -> None:
        """Hand a file to the browser, or say why there is none.

        Args:
            name: Of the file.
            made: How its errand ended.
            note: What says that it is being made.
        """
        note.remove()
        if made.error:
            self._tab.refuse(f"{name} was not made: {made.error}")
        else:
            self._client.send_file_download(name, made.content)
            self._client.add_notification(f"{name} is ready", "The browser has it.", auto_close_seconds=4.0)
