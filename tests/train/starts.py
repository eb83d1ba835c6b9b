"""Controllers and an archive that a fine-tuning begins with."""

import itertools
import json
from pathlib import Path

import numpy as np
import torch

from qd.evaluate.sets import TRAINED_ON, hash_elites
from train.cfg import PpoCfg
from train.ppo.checkpoint import STD

PPO = PpoCfg(steps_per_env=4, epochs=1, mini_batches=2)


def write_actor(path, *, hidden=(16, 8), critic=False, critic_hidden=None, **extra):
    """A controller of random layers, as rsl_rl writes it."""
    torch.manual_seed(0)

    def layers(*sizes):
        state = {}
        for k, (width, out) in enumerate(itertools.pairwise(sizes)):
            state |= {f"mlp.{2 * k}.weight": 0.05 * torch.randn(out, width), f"mlp.{2 * k}.bias": torch.zeros(out)}
        return state

    actor = {STD: torch.full((12,), 0.3), **layers(235, *hidden, 12), **extra}
    content = {"actor_state_dict": actor, "activation": "elu"}
    if critic:
        content["critic_state_dict"] = layers(235, *(critic_hidden or hidden), 1)
    torch.save(content, path)
    return path


def write_trained(folder: Path, genes: np.ndarray) -> Path:
    """A controller whose record says that it was trained on elites, genes of shape (num_elites, num_genes)."""
    path = write_actor(folder / "tuned.pt")
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: hash_elites(genes)}))
    return path
