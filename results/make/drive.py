"""How many failures are of the drive, an actuator network in place of PD gains: results/<robot>/drive.json.

``--net FILE`` is a network in TorchScript, as legged_gym's anydrive_v3_lstm.pt of ANYmal; it is not published. A
controller is trained with it by the shipped recipe, and searched, as is the shipped one with its gains, by the same
scales of penalties. What fails either with contact resolved too is crossed by both controllers with both drives.
"""

import argparse
import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qd.evaluate.level import measure_level_ground
from qd.evaluate.tables import valid_interval
from qd.faults.judge import count_outcomes, elite_seeds, judge
from qd.faults.numbers import EPISODES
from qd.search.archive import Archive, goal_rates
from qd.search.directory import RunDirectory
from qd.search.fitness import FAILING_GOAL_RATE
from qd.search.loop import search
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream
from results.make.common import FRESH_COUNTS, Script, parse
from sim.files.atomic import read_json, to_json, write_atomically
from sim.files.intervals import RATES
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg, robot_identity
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from train.cfg import RunCfg, TrainCfg
from train.ppo.training import train

ITERATIONS = 8  # of preset wide: 241,600 episodes
_SETTINGS = """from dataclasses import replace
from sim.robots.find import get_robot
from sim.robots.robot import ActuatorNetCfg

NET = ActuatorNetCfg(file="net.pt")
ROBOT = replace(get_robot("{0}"), name="{0}-net", label="", actuator_net=NET, max_speed=300.0)  # of legs in falls
"""


def train_with_net(script: Script, net: Path) -> RobotCfg:
    """The robot with the network as its drives and a controller; in a trial that is the shipped one."""
    home = script.runs / "drive" / "robot"
    home.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(net, home / "net.pt")
    (home / "robot.py").write_text(_SETTINGS.format(script.robot.name))
    robot = get_robot(str(home / "robot.py"))
    write_atomically(robot.scales_file, to_json(read_json(script.robot.scales_file) | robot_identity(robot)))
    sizes = {"num_envs": 4, "iterations": 1} if script.small else {}
    cfg = replace(TrainCfg.of(robot), seed=script.seed, **sizes)
    trained = train(robot, cfg, home / "training", RunCfg(device=script.device))
    shutil.copyfile(script.policy if script.small else trained, robot.policy_file)
    return robot


def cross_failures(archive: Archive, crossers: dict[str, Crosser], policies: dict[str, str], seed: int) -> Any:
    """How many confirmed failures a controller crosses with a drive, by drive and controller."""
    rows = np.flatnonzero(archive.confirmed)
    families = None if archive.family is None else archive.family[rows]
    seeds = elite_seeds(archive, seed, stream=Stream.OTHERS)[rows]
    terrains = Terrains(genes=archive.genes[rows], seeds=seeds, space=SUPER_GAUSSIAN)
    crossed: dict[str, Any] = {drive: {} for drive in crossers}
    for drive, crosser in crossers.items():
        for name, policy in policies.items():
            label = f"{drive} drive, controller of {name}"
            result = crosser.cross(policy, terrains, replicas=EPISODES, label=label, invalid_ok=True)
            passes = (goal_rates(count_outcomes(result)) >= FAILING_GOAL_RATE).astype(np.float64)
            interval = valid_interval(passes, seed, families, RATES)
            crossed[drive][name] = {"terrains": int(passes.sum()), "share_interval": interval}
    return crossed


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Trains, searches and crosses; a run that was stopped goes on."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--net", type=Path, required=True)
    args, others = parser.parse_known_args(argv)
    script = parse(__doc__, others, "drive.json")
    robots = {"pd": script.robot, "net": train_with_net(script, args.net)}
    policies = {drive: str(robot.policy_file) for drive, robot in robots.items()}
    runs = script.runs / "drive"
    crossers = {name: Crosser(robot, script.compute, cache=runs / "crossings") for name, robot in robots.items()}
    drives = dict[str, Any]()
    for drive, robot in robots.items():
        cfg = replace(script, robot=robot).search_cfg(ITERATIONS, seed=script.seed, crossed=0.0)
        search(cfg, runs / drive, script.compute, robot=robot)
        archive = judge(runs / drive, stages=("fresh", "resolved"), compute=script.compute, robot=robot.spec)
        summary = RunDirectory(runs / drive).read_summary()
        drives[drive] = {
            **robot_identity(robot),
            "level": {name: measure_level_ground(crossers[drive], file)["searched"] for name, file in policies.items()},
            "archive": {count: summary.get(count) for count in (*FRESH_COUNTS, "confirmed")},
            "crossed": cross_failures(archive, crossers, policies, script.seed),
        }
    net = {"net": args.net.name, "net_sha256": hashlib.sha256(args.net.read_bytes()).hexdigest()}
    return script.write(net | {"drives": drives})


if __name__ == "__main__":
    main()
