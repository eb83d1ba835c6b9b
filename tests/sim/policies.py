"""Controllers that need no training."""

import torch

NUM_JOINTS = 12


def stand(observation):
    """Holds the default pose."""
    return torch.zeros((len(observation), NUM_JOINTS), device=observation.device)


def stretch(observation):
    """A deterministic function of the whole row: legs that stretch and bend with what the robot feels."""
    return 0.3 * torch.sin(observation[:, 12:24] * 3 + observation.sum(dim=1, keepdim=True))


def sway(observation):
    """Springs that overshoot, of the joint angles alone: two simulators that begin alike are told alike."""
    return -0.5 * torch.sin(3.0 * observation[:, 12:24])


class Remembers:
    """Stands; notes how many robots it is asked for. After ``most`` calls it returns NaN, as spoiled weights do."""

    def __init__(self, most=1_000_000):
        self.most, self.asked, self.resets = most, [], 0

    def reset(self):
        self.asked, self.resets = [], self.resets + 1

    def __call__(self, observation):
        self.asked.append(len(observation))
        return stand(observation) + (float("nan") if len(self.asked) > self.most else 0.0)
