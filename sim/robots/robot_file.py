"""A robot's file as MuJoCo compiles it, in the one form that simulations and pictures are made of.

Each joint has at most one actuator; geoms touch the ground and nothing else; options are MuJoCo's but gravity and
``impratio``.
"""

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim.files.command import with_traceback
from sim.robots.drives import Drives, drive_problems, read_drives
from sim.robots.elements import mj, touching_geoms
from sim.robots.model_files import ModelFiles, read_model_files
from sim.robots.refused import refused_elements, structure_problems
from sim.robots.urdf import read_urdf


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """Content of a robot's file, without its settings."""

    spec: Any
    """The ``MjSpec``, stripped to what simulations use; every touching geom has a name."""
    model: Any
    drives: Drives
    home: list[float] | None
    """Joint angles of its keyframe ``home`` [rad]; None without one."""
    is_urdf: bool


def read_robot_file(model_file: Path, *, visuals: bool = False) -> RobotFile:
    """Reads a robot's file; an error says all that is wrong with it."""
    files = read_model_files(model_file, visuals=visuals)
    try:
        spec = read_urdf(files.root) if files.is_urdf else mj.MjSpec.from_file(str(model_file))
        home = next((list(key.qpos) for key in spec.keys if key.name == "home"), [])
        _name_geoms(spec)
        refused = [*refused_elements(spec)]
        _strip(spec)
        spec.fuse_static()
        model = spec.compile()
    except Exception as error:  # MuJoCo's own type has no name
        reason = _quote_urdf(" ".join(str(error).split()), files)
        raise ValueError(with_traceback(error, f"{model_file} cannot be read by MuJoCo: {reason}")) from None
    problems = [*structure_problems(model)]
    if refused := [*refused, *drive_problems(spec, model)]:
        problems.append(f"{', '.join(refused)} cannot be simulated: take it out, or write it otherwise")
    if len(home) not in (0, model.nq):
        problems.append(f"qpos of the keyframe home must be {model.nq} numbers, got {len(home)}")
    if problems:
        raise ValueError("; ".join(f"{model_file}: {_quote_urdf(problem, files)}" for problem in problems))
    return RobotFile(spec=spec, model=model, drives=read_drives(model), home=home[7:] or None, is_urdf=files.is_urdf)


def _quote_urdf(text: str, files: ModelFiles) -> str:
    """A message with the elements of a URDF in place of line numbers, which are not those of the file."""
    lines = dict(enumerate(ET.tostring(files.root, encoding="unicode").split("\n"), 1)) if files.is_urdf else {}
    return re.sub(r"line (\d+)", lambda line: lines.get(int(line[1]), line[0]).strip(), text)


def _name_geoms(spec: Any) -> None:
    """Gives touching geoms without a name that of their body, and lets them touch the ground alone."""
    taken = {geom.name for geom in spec.geoms}
    for index, body in enumerate(spec.bodies):
        for number, geom in enumerate(touching_geoms(body)):
            if not geom.name:
                geom.name = f"{body.name or f'body_{index}'}_geom_{number}"
                while geom.name in taken:
                    geom.name += "_"
            taken.add(geom.name)
            geom.contype, geom.conaffinity = 1, 0


def _strip(spec: Any) -> None:
    """Takes out what simulations leave out of a file; whatever names a body would keep it from being fused."""
    for element in (*spec.sensors, *spec.keys, *spec.excludes, *spec.pairs, *spec.cameras, *spec.lights, *spec.tuples):
        spec.delete(element)
    kept = {name: getattr(spec.option, name) for name in ("gravity", "impratio")}
    kept["gravity"] = kept["gravity"].copy()
    spec.option = mj.MjSpec().option
    for name, value in kept.items():
        setattr(spec.option, name, value)
