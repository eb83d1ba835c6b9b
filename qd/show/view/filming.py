"""*Film this*: the film of an episode, made in a process of its own and offered for download."""

from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from qd.search.directory import folder_for
from qd.show.film import film
from qd.show.view.crosser import Common
from qd.show.view.recorder import Report
from sim.files.atomic import prepare_output
from sim.recording.recorder import Recording


class Filming:
    """The film that a tab has made."""

    def __init__(self, client: viser.ClientHandle, common: Common, say: Callable[[str], None]) -> None:
        """Make none yet; ``say`` shows how far it is, in words."""
        self._client, self._common, self._say = client, common, say
        self._wanted: partial[None] | None = None

    def begin(self, recording: Recording, replica: int, stem: str, **how: Any) -> None:
        """Film an episode, counted from 0, unless a film is made already; more fields of a film."""
        if self._wanted is not None:
            return
        opened_run = self._common.show.opened_run
        by = f"-{how['by']}" if how["by"] else ""
        name = f"{stem}{by}-episode-{replica + 1}.mp4"
        file = folder_for(opened_run.path, opened_run.robot.name) / name
        try:
            prepare_output(file)
        except (OSError, ValueError) as error:
            self._say(f"No film: {error}")
            return
        self._wanted = partial(film, recording, opened_run.robot, out=file, episode=replica, **how)
        self._say("Filming: the film process starts …")
        self._common.films().record(self._wanted, tab=self._client.client_id)

    def cancel(self) -> None:
        """Make it no further."""
        if self._wanted is not None:
            self._common.films().cancel(self._wanted)
            self._wanted = None
            self._say("Cancelled.")

    def take_report(self, report: Report) -> None:
        """Say how far it is, and offer it when it is made; nothing on another's report."""
        if self._wanted is None or report.wanted is not self._wanted:
            return
        if report.result is None:
            self._say(f"No film: {report.text}" if report.failed else f"Filming: {report.share:.0%}")
            self._wanted = None if report.failed else self._wanted
            return
        self._wanted, content = None, report.result.read_bytes()
        self._say(f"{report.result} ({len(content) / 1e6:.1f} MB): click to download it in the notice on the picture.")
        self._client.send_file_download(report.result.name, content)
