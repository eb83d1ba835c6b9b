"""Run by torchrun: processes agree on what all want, and notice networks that have drifted apart."""

import sys

import torch
from torch import distributed

from train.ppo.learner import Ranks


def main() -> None:
    """Prints what the first process finds; exits with 3 where the drift goes unnoticed."""
    distributed.init_process_group("gloo")
    ranks = Ranks.of_environment()
    assert not ranks.all_want(ranks.rank == 0, "cpu")
    assert ranks.all_want(True, "cpu")
    ranks.check_same([torch.ones(3), torch.zeros(2, 2)])
    try:
        ranks.check_same([torch.ones(3), torch.full((2,), 1e-7 * ranks.rank)])
    except FloatingPointError:
        distributed.destroy_process_group()
        return
    sys.exit(3)


if __name__ == "__main__":
    main()
