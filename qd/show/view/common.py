"""What all tabs of the viewer share."""

from collections.abc import Callable
from dataclasses import dataclass

from qd.show.recordings import Recordings
from qd.show.view.meshes import Part
from qd.show.view.recorder import Recorder
from qd.show.view.show import Show
from sim.robots.skeleton import Skeleton


@dataclass(frozen=True, kw_only=True)
class Common:
    """What all tabs share."""

    show: Show
    skeleton: Skeleton
    parts: list[Part]
    """Of the robot."""
    recordings: Recordings
    recorder: Recorder
    films: Callable[[], Recorder]
    """What makes films, in a process of its own from the first call on."""
    post: Callable[..., None]
    """:meth:`qd.show.view.app.App.post`."""
