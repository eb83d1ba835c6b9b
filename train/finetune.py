"""Fine-tune a controller on what broke it: ``python -m train.finetune --robot anymal --mix generated``.

Ctrl-C or ``--max-seconds`` saves and stops; ``--resume RUN_DIR`` goes on where it stopped.
"""

import shlex
import sys
import time
from dataclasses import asdict

import tyro

from sim.files.atomic import to_json, write_atomically
from sim.files.command import exit_code_of
from sim.files.provenance import provenance
from sim.policy.loaders import MlpPolicy, load_policy
from train.evaluate.held_out import TRAINED_ON
from train.finetune_job import FinetuneCfg, Job, job_of
from train.ppo.learner import Learner
from train.ppo.ppo import CapturedPPO
from train.ppo.progress import Progress
from train.ppo.run import (
    CHECKPOINT,
    CONFIG,
    POLICY,
    RESERVE_S,
    StopRequest,
    claimed,
    finish,
    iterate,
    plain,
    resumable,
)
from train.task.task import CommandTask
from train.task.vec_env import CommandVecEnv


class Tuning:
    """A fine-tuning at work: the learner, and the terrains that are exchanged under it."""

    def __init__(self, job: Job) -> None:
        """Begin, or go on from the checkpoint of the job."""
        self.job, self.mix = job, job.mix
        tiles = self.mix.restore(job.saved["extra"]["mix"]) if job.saved else self.mix.next()
        self.task = CommandTask(
            job.robot, job.task, num_envs=job.num_envs, device=job.device, seed=job.seed, tiles=tiles
        )
        # Every episode is whole, at the beginning as after an exchange: who crossed which terrain is counted.
        self.learner = Learner(CommandVecEnv(self.task), job.cfg.ppo, seed=job.seed, random_ages=False)
        if job.saved is not None:
            self.learner.resume(job.saved)
        elif job.start is not None:
            self.learner.start_from(job.start.actor, job.start.critic)
        about = {**provenance(job.device, job.seed), "settings": job.settings}
        saved = job.saved and job.saved["extra"]
        rows = job.cfg.rows
        self.progress = Progress(job.run_dir, self.learner, job.iterations, rows=rows, about=about, saved=saved)

    def before_iteration(self) -> None:
        """Exchange the terrains where that is due, and let the actor learn once its critic has had its time."""
        iteration = self.learner.iteration
        if iteration // self.mix.cfg.swap_every > self.mix.swap:
            self.task.exchange(self.mix.next(self.task.counts()))
            self.learner.begin_again()
        alg = self.learner.alg
        assert isinstance(alg, CapturedPPO)
        alone = self.job.settings["critic_iterations"]
        alg.let_actor_learn(iteration >= alone)
        if iteration == alone:
            alg.begin_actor()

    def save(self) -> None:
        """A checkpoint of all of it."""
        state = {**self.progress.state(), "mix": self.mix.state(self.task.counts()), TRAINED_ON: self.job.trained_on}
        self.learner.save(self.job.run_dir / CHECKPOINT, state)


def _write_onnx(job: Job) -> None:
    """The controller as ONNX beside the checkpoint, where the packages for it are."""
    path, policy = job.run_dir / POLICY, load_policy(job.run_dir / POLICY, job.robot, "cpu")
    command = f"python -m sim.policy.export --robot {job.robot.name} --policy {shlex.quote(str(path))}"
    try:
        from sim.policy.export import export_onnx
    except ImportError as error:
        print(f"No ONNX file was written ({error}); where onnx is installed:  {command}")
        return
    assert isinstance(policy, MlpPolicy)
    export_onnx(policy, path.with_suffix(".onnx"))
    print(f"The same as ONNX: {path.with_suffix('.onnx')}")


def _weights(job: Job) -> str:
    """Which reward terms weigh otherwise than the robot's own, in words."""
    own = asdict(job.robot.training.rewards)
    other = {name: weight for name, weight in asdict(job.task.rewards).items() if weight != own[name]}
    if not other:
        return "Rewards: the robot's own"
    given = ", ".join(f"{name}={weight:g}" for name, weight in other.items())
    return f"Rewards: {given} (the robot's own: {', '.join(f'{own[name]:g}' for name in other)})"


def _comparison(job: Job) -> str:
    """The command that holds the controller against the shipped one, on elites held out of its training too."""
    policies = shlex.quote(f"base=shipped tuned={shlex.quote(str(job.run_dir / POLICY))}")
    command = f"make evaluate ROBOT={shlex.quote(job.robot.spec)} POLICIES={policies}"
    archive = job.settings["archive"]
    if archive is None:
        return command
    split = f" SPLIT_SEED={archive['split_seed']}" if archive["split_seed"] else ""
    return f"{command} ARCHIVE={shlex.quote(archive['path'])}{split}"


def finetune(cfg: FinetuneCfg) -> int:
    """Fine-tune as told; returns the exit status: 0, or 130 after Ctrl-C.

    Raises:
        ValueError: If something asked for cannot be had; raised before any long work.
        FloatingPointError: If the training leaves the finite numbers; the last checkpoint is kept.
    """
    began = time.monotonic()
    job = job_of(cfg)
    run_dir = job.run_dir
    print(
        f"Fine-tuning '{job.robot.name}' on {job.mix.cfg.terrains} terrains at a time ({job.mix.cfg.mix}): "
        f"{job.num_envs} robots on {job.device}, {job.iterations} iterations, in {run_dir}",
        flush=True,
    )
    print(_weights(job))
    alone = job.settings["critic_iterations"]
    if alone >= job.iterations:
        print(
            f"The critic learns alone for the first {alone} iterations: the controller stays as it is. To change it, "
            "give more --iterations or fewer --critic-iterations."
        )
    with StopRequest() as stop, claimed(run_dir):
        tuning = Tuning(job)
        write_atomically(run_dir / CONFIG, to_json({**plain(asdict(job.cfg)), "device": job.device}))
        deadline = began + cfg.max_seconds - RESERVE_S if cfg.max_seconds else float("inf")
        learner, progress, save = tuning.learner, tuning.progress, tuning.save
        try:
            iterate(
                learner, progress, save=save, save_every_s=cfg.save_every_s, stop=stop, deadline=deadline,
                before=tuning.before_iteration,
            )  # fmt: skip
            policies = [run_dir / POLICY, *([cfg.export] if cfg.export else [])]
            finish(learner, progress, save=save, policies=policies, about={TRAINED_ON: job.trained_on})
            _write_onnx(job)
        except OSError as error:
            raise resumable(run_dir, error) from error
        except FloatingPointError as error:
            kept = "the last checkpoint is kept" if (run_dir / CHECKPOINT).exists() else "nothing was saved before"
            raise FloatingPointError(f"{error}; {kept} in {run_dir}: lower --ppo.learning-rate") from error
    if learner.iteration < job.iterations:
        print(f"Stopped after {learner.iteration} of {job.iterations} iterations. Go on with: --resume {run_dir}")
    else:
        print(f"Next, see what it did:  {_comparison(job)}")
    return 130 if stop.requested else 0


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(FinetuneCfg, description=__doc__)
    return exit_code_of(lambda: finetune(cfg))


if __name__ == "__main__":
    sys.exit(main())
