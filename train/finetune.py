"""Fine-tune a controller on the terrains that broke it."""

from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.marks import TRAINED_ON, hash_elites, read_trained_on
from qd.evaluate.sets import elites_sha256, read_elites, read_space, split_elites
from qd.faults.judge import CERTIFIERS_FOLDER
from qd.faults.numbers import SPECIALIST as CERTIFIER
from qd.search.directory import RunDirectory, directory_of, find_run
from sim.controllers.loaders import load_actor
from sim.controllers.onnx import export_onnx
from sim.controllers.spec import SHIPPED, controller_hash
from sim.files.command import command_line
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import identity, load_space, space_at
from train.cfg import RUN, SPECIALIST, FinetuneCfg, RunCfg
from train.ppo.checkpoint import CHECKPOINT, POLICY, STD, Start, read_start
from train.ppo.learner import Ranks
from train.ppo.training import (
    DESCRIBED,
    Kind,
    Training,
    check_settings,
    device_of,
    is_finished,
    read_saved,
    run_directory,
    settings_of,
)
from train.task.mix import Mix

_CRITIC_ITERATIONS = 50


def finetune(robot: RobotCfg, cfg: FinetuneCfg, run_dir: Path, run: RunCfg = RUN) -> Path:
    """Trains a controller further by PPO, on hand-crafted terrains and on those of archives; returns its file.

    Where the directory holds a checkpoint of the same settings, the training goes on; one that is over is left as it
    is. ``run_dir`` gets checkpoint, controller, record and TensorBoard's file; ``run`` says where.
    """
    device = device_of(run.device)
    if Ranks.of_environment().size > 1:
        raise ValueError("a fine-tuning must be one process, got several by torchrun: begin it without")
    cfg = cfg.sized(robot, device)
    checkpoint = run_dir / CHECKPOINT
    saved = read_saved(run_dir, "finetune", robot.name) if checkpoint.exists() else None
    # Where it goes on, the first controller may be gone.
    start = read_start(Path(cfg.policy or robot.policy_file) if saved is None else checkpoint, robot)
    if saved is None and cfg.recipe.noise_of is not None:
        noise = read_start(Path(cfg.recipe.noise_of), robot).actor
        start = replace(start, actor=start.actor | {key: noise[key] for key in noise if key == STD})
    controller = start.controller
    cfg = replace(cfg, ppo=replace(cfg.ppo, hidden_dims=start.hidden_dims))
    elites = elites_of(robot, cfg)
    settings = {
        **settings_of(cfg, robot),
        "elites": elites.about,
        "spaces": list(dict.fromkeys(identity(space.name, space.sha256) for space in elites.spaces)),
    }
    if saved is not None:
        check_settings(run_dir, saved, settings)
        if is_finished(run_dir, cfg.iterations, run.export):
            print(f"{run_dir} is finished: all {cfg.iterations} iterations are done; with more it goes on.")
            return _with_onnx(run_dir / (POLICY if controller is None else DESCRIBED), robot)
    beside = None if run.export is None else run.export.with_suffix(".toml")
    if controller is not None and beside is not None and beside.exists() and saved is None:
        raise ValueError(
            f"export {run.export} must have no {beside.name} beside it, which is written too: name another"
        )
    with run_directory(run_dir, run.export):
        sizes = f"{cfg.num_envs} robots on {device}, {cfg.iterations} iterations"
        terrains = f"{cfg.terrains} terrains at a time ({cfg.mix})"
        print(f"Fine-tuning '{robot.name}' on {terrains}: {sizes}, in {run_dir}", flush=True)
        training = FineTuning(
            robot, cfg, run_dir, device=device, settings=settings, saved=saved, elites=elites, start=start
        )
        policy = training.run(run.export)
    return _with_onnx(policy, robot, anew=True)


def _with_onnx(policy: Path, robot: RobotCfg, *, anew: bool = False) -> Path:
    """A controller as it is, once its ONNX file lies beside it; one with a description has none."""
    onnx = policy.with_suffix(".onnx")
    if policy.name == POLICY and (anew or not onnx.exists()):
        export_onnx(load_actor(policy, robot), onnx)
    return policy


def train_specialist(robot: RobotCfg, run: Path, cfg: FinetuneCfg, options: RunCfg = RUN) -> None:
    """Trains a search's own specialist, by :meth:`FinetuneCfg.specialist`, and puts it with the certifiers of its run.

    It is the controller of the search, trained further on the elites that it fails by their fresh episodes, all of
    them: a certificate is a proof of existence, so it may have trained on the terrain. The training works in
    ``<run>/specialist``.
    """
    archive = read_elites(run, robot, cfg.space)
    searched = RunDirectory(run).read_config()["settings"]["policy"]
    policy = cfg.policy or (None if searched == SHIPPED else searched)
    if controller_hash(policy or robot.policy_file) != archive.policy_sha256:
        raise ValueError(f"the controller of {run} must be the one that was searched, got {policy or SHIPPED}, another "
                         "now: name it by --policy")  # fmt: skip
    cfg = replace(cfg, policy=policy, archive=(str(run),)).sized(robot, device_of(options.device), **SPECIALIST)
    specialist = run / CERTIFIERS_FOLDER / f"{CERTIFIER}.pt"
    finetune(robot, cfg, run / "specialist", replace(options, export=specialist))


@dataclass(frozen=True, kw_only=True)
class Elites:
    """Elites to train on."""

    genes: tuple[NDArray[np.float32], ...]
    """A part of each archive, shape (E, genes of its space); E sums up over the parts."""
    spaces: tuple[TerrainSpace, ...]
    """Of each part; without elites one, that of hard-random terrains."""
    goal_rate: NDArray[np.float64] | None = None
    """Of each, as its archive has it, shape (E,)."""
    about: list[dict[str, Any]] = field(default_factory=list)
    """Of each archive, for the record."""


def elites_of(robot: RobotCfg, cfg: FinetuneCfg) -> Elites:
    """The elites to train on."""
    if cfg.mix != "generated":
        space = space_at(load_space(cfg.space), None, robot)
        return Elites(genes=(np.zeros((0, space.num_genes), np.float32),), spaces=(space,))
    paths = tuple(map(Path, cfg.archive)) or (find_run(robot, published="first"),)
    archives = [read_elites(path, robot, cfg.space) for path in paths]
    splits = [split_elites(archive, held_out=cfg.recipe.held_out) for archive in archives]
    held_out = set[str]()  # searches that begin alike may share an elite
    for archive, split in zip(archives, splits, strict=True):
        held_out.update(hash_elites(archive.genes[np.concatenate([split.test, split.validation])]))
    chosen = []
    for archive, split, path in zip(archives, splits, paths, strict=True):
        rows = split.train
        if cfg.recipe.only == "failing":
            if archive.fresh is None:
                own = robot.spec if archive.robot == robot.name and robot.settings_file else None
                space = archive.space if archive.space_sha256 else None
                judge = command_line("judge", robot=own, run=directory_of(path), space=space)
                raise ValueError(f"{path} must have fresh episodes, which say what fails, got none: run `{judge}`")
            rows = rows[archive.failing[rows]]
        is_free = [mark not in held_out for mark in hash_elites(archive.genes[rows])]
        chosen.append((archive, rows[np.array(is_free, bool)], split))
    if not any(len(rows) for _, rows, _ in chosen):
        places = ", ".join(map(str, paths))
        raise ValueError(f"{places} must have elites to train on that are {cfg.recipe.only}, got none")
    return Elites(
        genes=tuple(archive.genes[rows] for archive, rows, _ in chosen),
        spaces=tuple(map(read_space, archives)),
        goal_rate=np.concatenate([(archive.fresh or archive).goal_rate[rows] for archive, rows, _ in chosen]),
        about=[
            {"elites": len(archive), "trained_on": len(rows), "validation": len(split.validation),
             "sha256": elites_sha256(archive)} for archive, rows, split in chosen
        ],
    )  # fmt: skip


class FineTuning(Training):
    """A fine-tuning at work: the terrains are exchanged under the learner."""

    kind: Kind = "finetune"

    def __init__(
        self,
        robot: RobotCfg,
        cfg: FinetuneCfg,
        run_dir: Path,
        *,
        device: str,
        settings: dict[str, Any],
        saved: dict[str, Any] | None,
        elites: Elites,
        start: Start,
    ) -> None:
        """Begin with networks, or go on from a checkpoint; as of :class:`Training`."""
        self.mix = Mix(
            kind=cfg.mix, num_terrains=cfg.terrains, draw=cfg.recipe.draw, genes=elites.genes, spaces=elites.spaces,
            seed=cfg.seed, device=device, goal_rate=elites.goal_rate if cfg.recipe.draw == "learnable" else None,
        )  # fmt: skip
        if saved is None:
            before = read_trained_on(str(cfg.policy or robot.policy_file))
            alone = 0
            if start.critic is None:
                most = min(_CRITIC_ITERATIONS, cfg.iterations // 2)
                alone = most if cfg.recipe.critic_iterations is None else cfg.recipe.critic_iterations
            marks = sorted({*chain(*map(hash_elites, elites.genes)), *before})
            facts, tiles = {TRAINED_ON: marks, "critic_iterations": alone}, self.mix.next()
        else:
            facts = {name: saved[name] for name in (TRAINED_ON, "critic_iterations")}
            tiles = self.mix.restore(saved["mix"])
        self._swap_every = cfg.recipe.swap_every
        super().__init__(
            robot, cfg, run_dir, device=device, settings=settings, saved=saved, tiles=tiles, facts=facts,
            controller=start.controller,
        )  # fmt: skip
        if saved is None:
            self.learner.start_from(start)

    def before_iteration(self) -> None:
        """Exchanges the terrains where that is due, and lets the actor learn once its critic has had its time."""
        iteration = self.learner.iteration
        if iteration // self._swap_every > self.mix.swap:
            self.task.exchange(self.mix.next(self.task.counts()))
            self.learner.begin()
        self.learner.alg.let_actor_learn(iteration >= self.critic_iterations)
        if iteration == self.critic_iterations:
            self.learner.alg.begin_actor()

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps, the terrains among it."""
        return {**super().state(), "mix": self.mix.state(self.task.counts())}
