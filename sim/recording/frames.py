"""Frames of episodes: what a robot did at every control step."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.terrains.ground import GroundMaps

FRAME_ARRAYS: dict[str, type[np.floating]] = {
    "base_position": np.float32,
    "base_quaternion": np.float32,
    "joint_position": np.float16,
    "foot_force": np.float16,
    "penalties": np.float32,
    "command": np.float16,
}
"""Arrays with a row a frame, and how exact they are kept: half a milliradian of a joint moves a foot by 0.3 mm. In
memory all are float32, in which a force can be squared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """T terrains, K episodes of each, up to F frames of each, and the terrains as they were simulated."""

    num_frames: NDArray[np.int32]
    """Frames of each episode, shape (T, K)."""
    arrays: dict[str, NDArray[Any]]
    """Those of :data:`FRAME_ARRAYS` and ``touching``, shape (T, K, F, ...); NaN or False from ``num_frames`` on."""
    heights: NDArray[np.float32]
    """Height grids [m], shape (T, nrow, ncol)."""
    ground: GroundMaps | None
    """Friction, softness and conditions of the terrains; None where ground is as always."""

    def __getitem__(self, rows: slice | NDArray[Any]) -> "Frames":
        num_frames = self.num_frames[rows]
        longest = int(num_frames.max(initial=0))
        return Frames(
            num_frames=num_frames,
            arrays={name: values[rows, :, :longest] for name, values in self.arrays.items()},
            heights=self.heights[rows],
            ground=None if self.ground is None else self.ground[rows],
        )

    @staticmethod
    def join(parts: Sequence["Frames"]) -> "Frames":
        """The frames of all terrains of some parts, in their order."""
        longest = max(int(part.num_frames.max(initial=0)) for part in parts)
        grounds = [part.ground for part in parts if part.ground is not None]
        return Frames(
            num_frames=np.concatenate([part.num_frames for part in parts]),
            arrays={
                name: np.concatenate([_lengthen(part.arrays[name], longest) for part in parts])
                for name in parts[0].arrays
            },
            heights=np.concatenate([part.heights for part in parts]),
            ground=reduce(GroundMaps.joined, grounds) if grounds else None,
        )


def _lengthen(values: NDArray[Any], num_frames: int) -> NDArray[Any]:
    """Frames (T, K, F, ...) with empty ones behind."""
    fill = False if values.dtype == np.bool_ else np.nan
    width = [(0, 0), (0, 0), (0, num_frames - values.shape[2]), *[(0, 0)] * (values.ndim - 3)]
    return np.pad(values, width, constant_values=fill)
