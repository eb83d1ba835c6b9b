"""Seeds of episodes, and their streams: what must not share its episodes has a stream of its own."""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Stream(IntEnum):
    """What seeds are drawn for: the spawn key of their sequence, on which stored crossings and results depend."""

    SEARCH = 0
    FRESH = 1
    RECORDED_ELITE = 2
    ABLATED_ELITES = 3  # which results/make/ablation.py draws
    RECORDED_USER_TERRAIN = 4
    RESOLVED = 5
    OTHERS = 6
    OTHERS_RESOLVED = 7
    VARIED = 8
    MUJOCO_C = 9
    STEERED = 10
    MINIMISED = 11
    MINIMISED_FRESH = 12
    CROSSED = 13
    FRESH_AGAIN = 1001  # of results/make/search_noise.py
    ABOUT_CONDITIONS = 2000  # of results/make/conditions.py


def episode_seeds(seed: int, iteration: int, count: int, *, stream: int = Stream.SEARCH) -> NDArray[np.uint32]:
    """Seeds of the terrains of an evaluation, shape (count,); another ``stream`` shares no episodes with the search."""
    sequence = np.random.SeedSequence([seed, iteration], spawn_key=(stream,) if stream else ())
    return sequence.generate_state(count, np.uint32).astype(np.uint32)
