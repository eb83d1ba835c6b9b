"""What all tabs of the viewer share."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

from qd.show.recordings import Recordings, Wanted
from qd.show.view.plots import Axes
from qd.show.view.scene import Shapes
from qd.show.view.show import Show
from sim.robots.skeleton import Skeleton


@dataclass(frozen=True, kw_only=True)
class Common:
    """What all tabs share."""

    show: Show
    axes: Axes
    skeleton: Skeleton
    shapes: Shapes
    recordings: Recordings
    record: Callable[[Wanted | None, Hashable], None]
    """Asks for crossings on behalf of a tab or of its ghost; of each the last ones count."""
    record_ahead: Callable[[Sequence[Wanted], Hashable], None]
    """Has crossings recorded while nobody waits for others; of a tab the last ones asked for count."""
    post: Callable[..., None]
    """Has something done by the loop, with arguments; of what has equal ``only_last``, the last."""
