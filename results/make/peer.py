"""How fast mjlab trains a robot of its own on rough ground, for train_speed.py: prints a line of JSON at the end.

It begins with untrained networks, since no trained ones come with it.

It imports nothing of faultline, and runs where mjlab and the packages that it wants are on the path.
"""

import json
import statistics
import sys
from dataclasses import asdict
from importlib import import_module
from importlib.metadata import version
from types import ModuleType
from typing import Any

TASK = "Mjlab-Velocity-Rough-Unitree-Go1"
STEPS = 24
"""Control steps an iteration, as its task says."""
WARM_UP, TIMED = 3, 9
VIEWERS = ("viser", "viser.transforms", "viser.uplot", "mjviser", "mjviser.conversions")
UNUSED = ("wandb", "mediapy", "imageio_ffmpeg", *VIEWERS)
"""What mjlab imports for logs, films and its viewer, and a training without them never calls."""


class Unused(ModuleType):
    """A package of whose every name there is a class that does nothing."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__ = []

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *args: None})


def main(num_envs: int, device: str) -> None:
    """Trains for some iterations, and prints the median times of those behind the first ones."""
    sys.modules.update({name: Unused(name) for name in UNUSED})
    mjlab: Any = import_module("mjlab.envs")
    learning: Any = import_module("mjlab.rl")
    registry: Any = import_module("mjlab.tasks.registry")
    import_module("mjlab.utils.torch").configure_torch_backends()
    task, cfg = registry.load_env_cfg(TASK), registry.load_rl_cfg(TASK)
    assert cfg.num_steps_per_env == STEPS
    task.scene.num_envs = num_envs
    env = learning.RslRlVecEnvWrapper(mjlab.ManagerBasedRlEnv(cfg=task, device=device), clip_actions=cfg.clip_actions)
    runner = learning.MjlabOnPolicyRunner(env, asdict(cfg), None, device)
    timed: list[tuple[float, float]] = []
    runner.logger.log = lambda **told: timed.append((told["collect_time"], told["learn_time"]))
    runner.learn(WARM_UP + TIMED, init_at_random_ep_len=True)
    seconds = statistics.median(map(sum, timed[WARM_UP:]))
    collection_s, learning_s = map(statistics.median, zip(*timed[WARM_UP:], strict=True))
    row = {
        "peer": f"mjlab {version('mjlab')}",
        "task": TASK,
        "versions": {name: version(name) for name in ("mujoco-warp", "warp-lang", "rsl-rl-lib", "torch")},
        "num_envs": num_envs,
        "steps_per_env": STEPS,
        "epochs": cfg.algorithm.num_learning_epochs,
        "mini_batches": cfg.algorithm.num_mini_batches,
        "hidden_dims": cfg.actor.hidden_dims,
        "iteration_s": seconds,
        "collection_s": collection_s,
        "learning_s": learning_s,
        "train_env_steps_per_s": num_envs * STEPS / seconds,
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
