"""A simulation that takes no time, in a module that a process imports at once."""

import time


class Instant:
    """A simulation that names what it would cross; elite 13 breaks it, and policy `slow` takes its time.

    Policy `droppable` takes long and can be dropped.
    """

    def __init__(self, policy, drop):
        if policy == "refused":
            raise ValueError("no such controller")
        self.policy, self.terrains, self.drop = policy, [], drop

    def put(self, terrains, seeds):
        self.terrains.append(terrains[0, 0])

    def take(self, progress):
        terrain = self.terrains.pop(0)
        if terrain == 13.0:
            raise RuntimeError("broken")
        progress(0.5)
        if self.policy == "slow":
            time.sleep(1.0)
        if self.policy == "droppable" and self.drop.wait(1.0):
            return None
        return f"{self.policy} on {terrain:.0f}"


def build(cfg, num_terrains):
    _, first, drop = cfg
    return Instant(first.policy, drop)
