"""Run by torchrun: two processes agree, train and go on, and notice networks that have drifted apart."""

import sys

import torch
from torch import distributed

import faultline
from train.ppo.learner import Ranks

_TRAIN = (
    "train --device cpu --num-envs 4 --task.curriculum.num-columns 2 --task.curriculum.noise-columns 1 "
    "--ppo.hidden-dims 16 --ppo.steps-per-env 4 --ppo.epochs 1"
)


def main() -> None:
    """Exits with another code than 0 where something is wrong."""
    for iterations in ("1", "2"):
        assert faultline.main([*_TRAIN.split(), "--run-dir", sys.argv[1], "--iterations", iterations]) == 0
        distributed.init_process_group = lambda backend: None  # the group of the first training is there yet
    ranks = Ranks.from_environment()
    assert not ranks.all_true(ranks.rank == 0, "cpu")
    assert ranks.all_true(True, "cpu")
    ranks.check_same([torch.ones(3), torch.zeros(2, 2)])
    try:
        ranks.check_same([torch.ones(3), torch.full((2,), 1e-7 * ranks.rank)])
    except FloatingPointError:
        distributed.destroy_process_group()
        return
    sys.exit(3)


if __name__ == "__main__":
    main()
