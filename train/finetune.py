"""Fine-tune a controller on the terrains that broke it."""

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from qd.evaluate.sets import TRAINED_ON, elites_sha256, hash_elites, read_trained_on, split_elites
from qd.faults.numbers import SPECIALIST as CERTIFIER
from qd.faults.searches import CERTIFIERS_FOLDER
from qd.search.directory import RunDirectory, find_directory, find_run, read_robot_archive
from sim.controllers.formats.onnx import export_onnx
from sim.controllers.loaders import load_actor
from sim.controllers.spec import SHIPPED, controller_hash
from sim.files.command import command_line
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.registry import load_space, space_at, space_key
from train.cfg import RUN, SPECIALIST, FinetuneCfg, RunCfg
from train.ppo import training
from train.ppo.checkpoint import CHECKPOINT, POLICY, STD, Start, read_start
from train.ppo.learner import Ranks
from train.task.tiles import Mix, TrainingElites

_CRITIC_ITERATIONS = 50


def finetune(robot: RobotCfg, cfg: FinetuneCfg, run_dir: Path, run: RunCfg = RUN) -> Path:
    """Trains a controller further by PPO, on hand-crafted terrains and on those of archives; returns its file.

    It goes on where the directory holds a checkpoint of the same settings; a finished training is left as it is.
    ``run_dir`` gets checkpoint, controller, record and TensorBoard's file.
    """
    device = training.find_device(run.device)
    if Ranks.from_environment().size > 1:
        raise ValueError("a fine-tuning must be one process, got several by torchrun: begin it without")
    cfg = cfg.sized(robot, device)
    checkpoint = run_dir / CHECKPOINT
    saved = training.read_saved(run_dir, "finetune", robot.name) if checkpoint.exists() else None
    # The first controller of a training that goes on may be gone.
    start = read_start(Path(cfg.policy or robot.policy_file) if saved is None else checkpoint, robot)
    if saved is None and cfg.recipe.noise_of is not None:
        noise = read_start(Path(cfg.recipe.noise_of), robot).actor
        start = replace(start, actor=start.actor | {key: noise[key] for key in noise if key == STD})
    cfg = replace(cfg, ppo=replace(cfg.ppo, hidden_dims=start.hidden_dims))
    elites = find_training_elites(robot, cfg)
    settings = {
        **training.dump_settings(cfg, robot),
        "elites": elites.archives,
        "spaces": list(dict.fromkeys(space_key(space.name, space.sha256) for space in elites.spaces)),
    }
    if saved is not None:
        training.check_resumed(run_dir, saved, settings)
        if training.is_finished(run_dir, cfg.iterations, run.export):
            print(f"{run_dir} is finished: all {cfg.iterations} iterations are done; with more it goes on.")
            return _write_onnx(run_dir / (POLICY if start.controller is None else training.DESCRIBED), robot)
    if start.controller and saved is None and run.export and (file := run.export.with_suffix(".toml")).exists():
        raise ValueError(f"export also writes {file}, which exists: name another file")
    with training.run_directory(run_dir, run.export):
        sizes = f"{cfg.num_envs} robots on {device}, {cfg.iterations} iterations"
        terrains = f"{cfg.terrains} terrains at a time ({cfg.mix})"
        print(f"Fine-tuning '{robot.name}' on {terrains}: {sizes}, in {run_dir}", flush=True)
        facts = saved or first_facts(robot, cfg, elites, start)
        facts = {name: facts[name] for name in (TRAINED_ON, "critic_iterations")}
        mix = Mix(cfg=cfg, elites=elites, device=device)
        how = {"settings": settings, "saved": saved, "mix": mix, "facts": facts, "start": start}
        policy = training.Training(robot, cfg, run_dir, device=device, **how).run(run.export)
    return _write_onnx(policy, robot)


def _write_onnx(policy: Path, robot: RobotCfg) -> Path:
    """Writes a controller's ONNX file beside it, unless it has a description; returns the controller's file."""
    if policy.name == POLICY:
        export_onnx(load_actor(policy, robot), policy.with_suffix(".onnx"))
    return policy


def train_specialist(robot: RobotCfg, run: Path, cfg: FinetuneCfg, options: RunCfg = RUN) -> None:
    """Trains a searched controller on all that it fails in fresh episodes, to be a certifier of its run."""
    archive = read_robot_archive(robot, run, cfg.space)
    searched = RunDirectory(run).read_config()["settings"]["policy"]
    policy = cfg.policy or (None if searched == SHIPPED else searched)
    if controller_hash(policy or robot.policy_file) != archive.policy_sha256:
        rule = f"policy must be the controller that {run} searched"
        raise ValueError(f"{rule}, got {policy or SHIPPED}, whose file differs: name it by --policy")
    cfg = replace(cfg, policy=policy, archive=(str(run),)).sized(
        robot, training.find_device(options.device), **SPECIALIST
    )
    specialist = run / CERTIFIERS_FOLDER / f"{CERTIFIER}.pt"
    finetune(robot, cfg, run / "specialist", replace(options, export=specialist))


def find_training_elites(robot: RobotCfg, cfg: FinetuneCfg) -> TrainingElites:
    """The elites to train on, without those that any archive holds out."""
    if cfg.mix != "generated":
        space = space_at(load_space(cfg.space), None, robot)
        return TrainingElites(genes=(np.zeros((0, space.num_genes), np.float32),), spaces=(space,))
    paths = tuple(map(Path, cfg.archive)) or (find_run(robot, published="first"),)
    archives = [read_robot_archive(robot, path, cfg.space) for path in paths]
    splits = [split_elites(archive, held_out=cfg.recipe.held_out) for archive in archives]
    held_out = set[str]()  # searches that begin alike may share an elite
    for archive, split in zip(archives, splits, strict=True):
        held_out.update(hash_elites(archive.genes[np.concatenate([split.test, split.validation])]))
    genes, goal_rates, records = [], [], []
    for archive, split, path in zip(archives, splits, paths, strict=True):
        rows = split.train
        if cfg.recipe.only == "failing":
            if archive.fresh is None:
                named_robot = robot.spec if archive.robot == robot.name and robot.settings_file else None
                space = archive.space if archive.space_sha256 else None
                judge = command_line("judge", robot=named_robot, run=find_directory(path), space=space)
                raise ValueError(f"{path} must have fresh episodes, which say what fails, got none: run `{judge}`")
            rows = rows[archive.failing[rows]]
        rows = rows[np.array([elite not in held_out for elite in hash_elites(archive.genes[rows])], bool)]
        genes.append(archive.genes[rows])
        goal_rates.append((archive.fresh or archive).goal_rate[rows])
        sizes = {"elites": len(archive), "trained_on": len(rows), "validation": len(split.validation)}
        records.append({**sizes, "sha256": elites_sha256(archive)})
    if not any(map(len, genes)):
        names = ", ".join(map(str, paths))
        raise ValueError(f"{names} must have elites to train on that are {cfg.recipe.only}, got none")
    spaces = tuple(archive.terrain_space for archive in archives)
    return TrainingElites(genes=tuple(genes), spaces=spaces, goal_rate=np.concatenate(goal_rates), archives=records)


def first_facts(robot: RobotCfg, cfg: FinetuneCfg, elites: TrainingElites, start: Start) -> dict[str, Any]:
    """What checkpoint and record of a new fine-tuning say beside its settings."""
    alone = cfg.recipe.critic_iterations
    alone = min(_CRITIC_ITERATIONS, cfg.iterations // 2) if alone is None else alone
    trained_before = read_trained_on(str(cfg.policy or robot.policy_file))
    trained_on = sorted({*chain(*map(hash_elites, elites.genes)), *trained_before})
    return {TRAINED_ON: trained_on, "critic_iterations": 0 if start.critic else alone}
