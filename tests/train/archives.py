"""Archives of made-up elites."""

import numpy as np

from kernels.penalties import PENALTY_DEFINITION
from qd.archive import Archive
from sim.space import SUPER_GAUSSIAN

PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")


def make_archive(num_elites: int, *, robot: str = "anymal", seed: int = 0) -> Archive:
    """So many elites with random genes, one a cell."""
    genes = np.clip(SUPER_GAUSSIAN.hard_random(max(num_elites, 1), seed)[:num_elites], -1.0, 1.0)
    columns, rates = np.full((num_elites, 6), 1.0 / 6.0), np.zeros(num_elites)
    counts = np.zeros(num_elites, np.int64)
    return Archive(
        robot=robot,
        penalty_definition=PENALTY_DEFINITION,
        space="super_gaussian",
        penalties=PENALTIES,
        scales=(1.0,) * 6,
        intervals=10,
        collision_bit=False,
        iterations=3,
        genes=genes,
        ratios=columns,
        cell=np.arange(num_elites),
        fitness=np.linspace(9.0, 1.0, num_elites),
        penalty_mean=columns,
        penalty_std=columns,
        collision_rate=rates,
        goal_rate=rates,
        fallen_rate=rates,
        invalid_episodes=counts,
        episodes=counts + 4,
        iteration=counts + 1,
    )
