"""Ten errors planted into the contracts of public controllers, and whether `faultline check` names them: planted.json.

Each ROBOT is the robot.toml of an import, beside its controller.toml, of a controller that walks. An error that changes
the speed on level ground by under 3 % is replaced by the next of its kind, or by a spare one, and the file says so.
"""

import argparse
import json
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from qd.why import Change, describe_ranked, propose_changes, rank_changes, write_out
from results.make.common import read_alike
from sim.controllers.described import read_controller
from sim.controllers.spec import controller_identity, weights_file
from sim.device import resolve_device
from sim.files.atomic import to_json, write_atomically
from sim.files.provenance import provenance
from sim.robots.find import get_robot
from sim.trials import MEASURES, Variant, walk_variants

ERRORS = {
    "one sign": r"sign of the action|direction of",
    "two joints swapped": r"order of \S+_\S+ and \S+_\S+$",
    "action scale": r"action_scale x 0\.5$",
    "gyro frame": r"signs of .. of ang_vel$",
    "order of history": r"history\.(newest|by)",
    "default pose": r"default$",
    "position gain": r"stiffness x 2\.0$",
    "delay": r"action_delay_steps$",
    "command scale": r"command x (0\.5|2\.0)$",
    "time step": r"decimation$",
}
SPARES = {
    "scale of a term": r"(joint_vel|joint_pos|last_action) x (0\.25|4\.0)$",
    "order of terms": r"order of (lin_vel|ang_vel|gravity) and",
    "velocity gain": r"damping x",
}
"""Ten kinds, by the changes of :func:`qd.why.propose_changes`, and those in place of what there is not."""
LEAST_CHANGE = 0.03


def plant_errors(
    base: Variant, weights: Path, device: str, seed: int
) -> Iterator[tuple[str, Change, float, list[str]]]:
    """Kind, error, speed with it [m/s], and errors in whose place it stands; the base's description is written out."""
    changes, rng = propose_changes(base), np.random.default_rng(seed)
    drawn: list[tuple[str, Change]] = []
    for kind, pattern in (ERRORS | SPARES).items():
        matching = [change for change in changes if re.match(pattern, change.text)]
        drawn += [(kind, matching[k]) for k in rng.permutation(len(matching))[:4]]
    variants = [base, *(change.variant for _, change in drawn)]
    walks = np.nan_to_num(walk_variants(variants, weights, device=device, seconds=6.0, replicas=8, seed=2))
    alive, speed = (walks[..., MEASURES.index(name)] for name in ("alive", "speed"))
    walked, *speeds = np.where(alive == 1.0, speed, 0.0).mean(axis=1).tolist()
    errors = [(kind, change, other) for (kind, change), other in zip(drawn, speeds, strict=True)]
    for kind in ERRORS:
        replaced = [] if kind in dict(drawn) else ["it has none"]
        for error in [error for drawn_kind in (kind, *SPARES) for error in errors if error[0] == drawn_kind]:
            if abs(error[2] - walked) >= LEAST_CHANGE * walked:
                errors.remove(error)
                yield *error, replaced
                break
            replaced.append(f"{error[1].text}: {error[2]:.3f} m/s of {walked:.3f}")


def measure(file: Path, device: str, seed: int, done: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """What is named for each planted error of a robot.toml, with one error more each time, and what was ``done``."""
    robot, path = get_robot(str(file)), file.with_name("controller.toml")
    weights = weights_file(path)
    assert weights is not None
    base = Variant(controller=write_out(read_controller(path), robot), robot=robot)
    identity = controller_identity(robot, str(path))
    rows, former = [], {row["planted"]: row for row in done}
    for kind, error, speed, replaced in plant_errors(base, weights, device, seed):
        started = time.perf_counter()
        if (row := former.get(error.text)) is None:
            ranked = rank_changes(error.variant, weights, device=device)
            lines = list(describe_ranked(error.variant, ranked))
            rank = next((k for k, change in enumerate(ranked, 1) if change.variant == base), None)
            named = ranked[0].variant == base and lines[0].startswith("It walks best")
            row = {"kind": kind, "planted": error.text, "replaced": replaced, "speed": speed, "named": named}
            row |= {"rank": rank, "first_line": lines[0], "wall_s": time.perf_counter() - started}
            print(json.dumps(row), flush=True)
        rows.append(row)
        yield {**identity, "named": sum(row["named"] for row in rows), "errors": rows}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Plants errors into every controller that is named, and writes the file after each; what is there stays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robots", type=Path, nargs="+", metavar="ROBOT")
    parser.add_argument("--device", help="a CUDA device if there is one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/planted.json"))
    args = parser.parse_args(argv)
    device = resolve_device(args.device)
    origin, content = provenance(device, args.seed), dict[str, Any]()

    def read_rows() -> dict[str, Any]:  # of other processes too
        return read_alike(args.out, origin, "sources_sha256", "seed").get("controllers", {})

    for file in args.robots:
        for numbers in measure(file, device, args.seed, read_rows().get(file.parent.name, {}).get("errors", ())):
            rows = read_rows() | {file.parent.name: numbers}
            named = sum(row["named"] for row in rows.values())
            planted = sum(len(row["errors"]) for row in rows.values())
            content = origin | {"named": named, "planted": planted, "controllers": rows}
            write_atomically(args.out, to_json(content))
    return content


if __name__ == "__main__":
    main()
