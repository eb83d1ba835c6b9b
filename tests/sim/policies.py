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


class NanAfterASecond:
    """Stands for a second, then returns NaN: weights that training has spoiled, say."""

    def __init__(self):
        self.calls = 0

    def reset(self):
        self.calls = 0

    def __call__(self, observation):
        self.calls += 1
        return stand(observation) + (float("nan") if self.calls > 50 else 0.0)  # 50 control steps of 0.02 s
