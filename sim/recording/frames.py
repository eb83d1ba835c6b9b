"""Frames of episodes: what a robot did at every control step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sim.terrains.terrains import GroundMaps

FRAME_ARRAYS = {
    "base_position": np.float32,
    "base_quaternion": np.float32,
    "joint_position": np.float16,
    "foot_force": np.float16,
    "penalties": np.float32,
    "command": np.float16,
    "touching": np.bool_,
}
"""Arrays with a row a frame, and how exact they are kept: half a milliradian of a joint moves a foot by 0.3 mm. In
memory floats are float32, in which a force can be squared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """T terrains as they were simulated, K episodes of each, up to F frames of each; NaN from ``num_frames`` on."""

    num_frames: NDArray[np.int32]
    """Frames of each episode, shape (T, K)."""
    base_position: NDArray[np.float32]
    """World-local [m], shape (T, K, F, 3)."""
    base_quaternion: NDArray[np.float32]
    """Base to world frame, w x y z as MuJoCo has it, shape (T, K, F, 4)."""
    joint_position: NDArray[np.float32]
    """[rad], shape (T, K, F, J)."""
    foot_force: NDArray[np.float32]
    """Contact force on each foot in the last physics step, world frame [N], shape (T, K, F, num_feet, 3)."""
    penalties: NDArray[np.float32]
    """Raw penalty sums so far, times the physics step, shape (T, K, F, P)."""
    command: NDArray[np.float32]
    """Command of the coming control step: v_x, v_y [m/s], yaw rate [rad/s], yaw frame; 0 once ended; (T, K, F, 3)."""
    touching: NDArray[np.bool_]
    """Whether each geom was pushed with more than 0.1 N in the last physics step, shape (T, K, F, G); the base's also
    where its collision ended the episode, whenever in the last control step that was. False from ``num_frames`` on."""
    heights: NDArray[np.float32]
    """Height grids [m], shape (T, nrow, ncol), row along y, column along x, 0.05 m apart."""
    ground: GroundMaps | None = None
    """Friction, softness and conditions of the terrains; None where ground is as always."""

    def __getitem__(self, rows: slice | NDArray[Any]) -> Self:
        longest = int(self.num_frames[rows].max(initial=0))
        arrays = {name: values for name, values in vars(self).items() if isinstance(values, np.ndarray | GroundMaps)}
        values: dict[str, Any] = {name: array[rows] for name, array in arrays.items()}
        return replace(self, **values | {name: values[name][:, :, :longest] for name in FRAME_ARRAYS})

    @staticmethod
    def join(parts: Sequence["Frames"]) -> "Frames":
        """The frames of all terrains of some parts, in their order."""
        longest = max(part.touching.shape[2] for part in parts)
        grounds = [part.ground for part in parts if part.ground is not None]
        arrays = {name: [getattr(part, name) for part in parts] for name in (*FRAME_ARRAYS, "num_frames", "heights")}
        for name, dtype in FRAME_ARRAYS.items():  # empty frames behind those of shorter episodes
            empty = False if dtype == np.bool_ else np.nan
            widths = [[(0, 0), (0, 0), (0, longest - v.shape[2]), *[(0, 0)] * (v.ndim - 3)] for v in arrays[name]]
            arrays[name] = [np.pad(v, w, constant_values=empty) for v, w in zip(arrays[name], widths, strict=True)]
        joined = {name: np.concatenate(values) for name, values in arrays.items()}
        return Frames(**joined, ground=reduce(GroundMaps.joined, grounds) if grounds else None)
