"""The paper's numbers (Esquerre-Pourtere, Kim and Park, arXiv 2506.01362).

Its rewards are sums of its own training task's; the weights of its two added penalties are not published, so that they
compare among its controllers, not with ours.
"""

TERRAINS = {"anymal": 300, "cassie": 180}
"""Terrains of each of its test sets."""
TRAINING_ELITES = 750
"""Elites that it trains on."""
ARCHIVES = {
    "cassie": {"elites": 930, "with_collision": 598, "without_collision": 332, "fitness": 4.7},
    "anymal": {"elites": 1129},
}
"""What it says of its archives after 1,000 iterations."""

_CONTROLLERS = ("C-HC", "C-HR", "C-G")
_SETS = ("hand_crafted", "hard_random", "generated")
_ROWS = {
    "cassie": {
        "success": ((0.997, 0.984, 0.999), (0.928, 0.982, 0.990), (0.743, 0.876, 0.957)),
        "reward": ((32.7, 29.7, 32.9), (31.0, 31.6, 32.3), (25.7, 27.6, 29.9)),
    },
    "anymal": {
        "success": ((0.971, 0.976, 0.980), (0.865, 0.954, 0.976), (0.598, 0.876, 0.914)),
        "reward": ((25.6, 24.8, 25.4), (22.7, 24.9, 25.6), (16.6, 20.1, 23.3)),
    },
}
Published = dict[str, dict[str, dict[str, float]]]
"""Measure -> set -> controller -> value."""


def published(robot: str) -> Published | None:
    """The paper's success rates (fractions) and rewards of a robot by set and controller; None if it has none.

    Source: its four tables, "Average rewards" and "Success rates" with the Cassie and with the ANYmal robot.
    """
    if robot not in _ROWS:
        return None
    return {
        measure: {name: dict(zip(_CONTROLLERS, row, strict=True)) for name, row in zip(_SETS, rows, strict=True)}
        for measure, rows in _ROWS[robot].items()
    }
