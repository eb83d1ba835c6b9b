"""Archives of made-up elites."""

from dataclasses import replace

import numpy as np

from qd.archive import Archive
from sim.files.records import robot_digest
from sim.robots.shipped import ROBOTS
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import small_archive

PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")


def make_archive(num_elites: int, *, robot: str = "anymal", seed: int = 0) -> Archive:
    """So many elites with random genes, one a cell."""
    genes = np.clip(SUPER_GAUSSIAN.hard_random(max(num_elites, 1), seed)[:num_elites], -1.0, 1.0)
    columns, rates = np.full((num_elites, 6), 1.0 / 6.0), np.zeros(num_elites)
    return replace(
        small_archive(num_elites),
        robot=robot,
        robot_sha256=robot_digest(ROBOTS[robot]) if robot in ROBOTS else None,
        penalties=PENALTIES,
        scales=(1.0,) * 6,
        iterations=3,
        genes=genes,
        ratios=columns,
        fitness=np.linspace(9.0, 1.0, num_elites),
        penalty_mean=columns,
        penalty_std=columns,
        collision_rate=rates,
        goal_rate=rates,
        fallen_rate=rates,
        end_position=np.full((num_elites, 2), 6.0, np.float32),
        iteration=np.ones(num_elites, np.int64),
    )
