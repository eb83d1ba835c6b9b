"""Pushes on links: a force on one body of the robot for a moment, up to three in an episode, each a condition."""

from typing import Any

import warp as wp

from kernels.conditions import BASE, LINKS, ForcedStep, push_body
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, Array, Condition, Gene, push_text, round_steps
from sim.terrains.quantities import Sweep

PUSH_S = wp.constant(0.1)
"""How long a push lasts [s]."""


@wp.func
def _force_push(step: ForcedStep, row: wp.array[float], first: int, env: int):
    since = step.memory.steps[env] - int(wp.round(row[first + 2] / step.dt))
    count = wp.max(1, int(wp.round(PUSH_S / step.dt)))
    if since >= 0 and since < count:
        impulse = step.body_subtreemass[env, BASE] * wp.vec3(row[first], row[first + 1], 0.0)
        body = step.links[LINKS + int(wp.round(row[first + 3]))]
        push_body(step, env, body, impulse / (float(count) * step.dt))


class LinkPush(Condition):
    """A steady force on the mass centre of a link for 0.1 s.

    Its numbers are the impulse over the whole robot's mass along the way and to its left [m/s], when it begins [s], and
    the link (:func:`sim.robots.compiled.number_links`).
    """

    cause = "push on a link"
    force = _force_push

    def __init__(self, number: int) -> None:
        """The push of a number, from 1."""
        self.name, self.moment = f"push_{number}", f"push_{number}_time"
        speed: dict[str, Any] = {"low": -2.0, "middle": 0.0, "high": 2.0, "unit": "m/s"}
        link: dict[str, Any] = {"low": -LINKS, "middle": 0, "high": LINKS, "step": 1, "limits": (-LINKS, LINKS)}
        self.genes = (
            Gene(name=f"{self.name}_x", **speed),
            Gene(name=f"{self.name}_y", mirrored=True, **speed),
            Gene(name=self.moment, low=0.0, middle=6.0, high=12.0, unit="s", hard_at_limits=False),
            Gene(name=f"{self.name}_link", mirrored=True, hard_at_limits=False, **link),
        )
        if number == 1:
            sizes = (0.0, 0.5, 1.0, 1.5, 2.0)
            self.dose = Sweep(f"{self.name}_y", sizes, {self.moment: 5.0}, "push on the base for 0.1 s")

    def span(self, values: Array, duration_s: float) -> tuple[float, float]:
        """From its moment on for as long as it lasts."""
        begin = float(values[2])
        return begin, begin + PUSH_S

    def text(self, values: Array) -> str:
        """Its impulse, its link and its time."""
        link = round(values[3])
        side = "left" if link > 0 else "right"
        where = f"link {abs(link)} of {LINKS} on the {side}" if link else "the base"
        pushed = push_text(values)
        return pushed and f"{pushed} at {where} after {values[2]:.1f} s"

    def force_plain(self, episodes: Any, values: Array, running: Any, step: int) -> None:
        """Applies the force to the body."""
        from sim.robots.compiled import number_links

        dt = episodes.robot.physics_dt
        count = max(1, round_steps(PUSH_S, dt))
        if 0 <= step - round_steps(values[2], dt) < count:
            body = number_links(episodes.robot)[LINKS + round(values[3])]
            force = episodes.model.body_subtreemass[1] * values[:2] / (count * dt)
            for k in running:
                episodes.data[k].xfrc_applied[body, :2] += force


GROUPS["pushes"] = ("push_1", "push_2", "push_3")
CONDITIONS.update((name, LinkPush(number)) for number, name in enumerate(GROUPS["pushes"], 1))
