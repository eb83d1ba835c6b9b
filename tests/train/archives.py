"""Archives of made-up elites."""

from dataclasses import replace

import numpy as np

from qd.archive import Archive, FaultCounts
from sim.files.records import PENALTY_DEFINITION, robot_digest
from sim.robots.shipped import ROBOTS
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values

PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")


def make_archive(num_elites: int, *, robot: str = "anymal", seed: int = 0) -> Archive:
    """So many elites with random genes, one a cell."""
    genes = np.clip(SUPER_GAUSSIAN.hard_random(max(num_elites, 1), seed)[:num_elites], -1.0, 1.0)
    columns, rates = np.full((num_elites, 6), 1.0 / 6.0), np.zeros(num_elites)
    counts = np.zeros(num_elites, np.int64)
    return Archive(
        robot=robot,
        robot_sha256=robot_digest(ROBOTS[robot]) if robot in ROBOTS else None,
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
        end_position=np.full((num_elites, 2), 6.0, np.float32),
        invalid_episodes=counts,
        episodes=counts + 4,
        iteration=counts + 1,
    )


def certified_archive(
    num_elites: int, crossed: int, certifiers: dict[str, str], *, searched: str = "f" * 64
) -> Archive:
    """An archive whose controller fails every elite; each certifier crosses the first few of them.

    Args:
        num_elites: How many.
        crossed: So many have certificates.
        certifiers: Hash of each certifier by its name.
        searched: Hash of the controller that was searched.
    """
    archive = make_archive(num_elites)
    outcomes = np.zeros((num_elites, len(certifiers), 4), np.int64)
    outcomes[:crossed, :, 0], outcomes[crossed:, :, 1] = 20, 20
    faults = replace(
        FaultCounts.none_of(num_elites), certifiers=tuple(certifiers), certifier_sha256=tuple(certifiers.values()),
        certifier_outcomes=outcomes, certifier_resolved_outcomes=outcomes,
    )  # fmt: skip
    fresh = replace(fresh_values(archive), goal_rate=np.zeros(num_elites))
    return replace(archive, fresh=fresh, faults=faults, policy_sha256=searched)
