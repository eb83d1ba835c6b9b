"""Train a base controller from scratch on rough terrain."""

from pathlib import Path

from sim.robots.robot import RobotCfg
from train.cfg import RUN, RunCfg, TrainCfg
from train.ppo.checkpoint import CHECKPOINT
from train.ppo.learner import Ranks
from train.ppo.training import Training, check_resumed, dump_settings, find_device, read_saved, run_directory


def train(robot: RobotCfg, cfg: TrainCfg, run_dir: Path, run: RunCfg = RUN) -> Path:
    """Trains a controller by PPO on legged_gym's rough-terrain task; returns its file, ``<run_dir>/policy.pt``.

    If the directory holds a checkpoint of the same settings, the training goes on. torchrun may start several processes
    of it, each with its GPU and ``cfg.num_envs`` robots. ``run_dir`` gets checkpoint, controller, record and
    TensorBoard's file. ``run`` has the device and an export.
    """
    device = find_device(run.device)
    cfg = cfg.sized(robot, device)
    settings = dump_settings(cfg, robot)
    saved = read_saved(run_dir, "train", robot.name) if (run_dir / CHECKPOINT).exists() else None
    if saved is not None:
        check_resumed(run_dir, saved, settings)
    with run_directory(run_dir, run.export):
        if Ranks.from_environment().is_first:
            sizes = f"{cfg.num_envs} robots on {device}, {cfg.iterations} iterations"
            print(f"Training '{robot.name}': {sizes}, in {run_dir}", flush=True)
        training = Training(robot, cfg, run_dir, device=device, settings=settings, saved=saved)
        return training.run(run.export)
