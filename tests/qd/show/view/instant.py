"""A simulation that takes no time, in a module that a process imports at once."""


class Instant:
    """A simulation that names what it would cross; elite 13 breaks it, and policy `slow` takes its time."""

    def __init__(self, drop):
        self.wanted, self.drop = [], drop

    def put(self, wanted, robot):
        self.wanted.append((wanted, robot))

    def take(self, progress):
        wanted, robot = self.wanted.pop(0)
        if wanted.policy == "refused":
            return ValueError("no such controller")
        if int(wanted.terrain.seeds[0]) == 13:
            raise RuntimeError("broken")
        progress(0.5)
        if wanted.policy == "slow" and self.drop.wait(1.0):
            return None
        return f"{robot}: {wanted.policy} on {wanted.terrain.seeds[0]}"


def build(drop, num_terrains):
    return Instant(drop)
