"""Terrain spaces by name: the shipped ones, and those of a user that the command line named."""

import re
from dataclasses import replace

from sim.controllers.spec import ControllerSpec
from sim.robots.find import fitting_space
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.base import CONDITIONS
from sim.terrains.ground import GROUND_KINDS
from sim.terrains.spaces.base import MAX_HEIGHT, ShippedSpace, TerrainSpace
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.user import find_user_space, load_user_space
from sim.terrains.spaces.wider import WiderSpace

SPACES: dict[str, ShippedSpace] = {SUPER_GAUSSIAN.name: SUPER_GAUSSIAN, COURSE.name: COURSE}
"""Every shipped space by its name."""


def split_name(name: str) -> tuple[str, tuple[str, ...]]:
    """The name of a space without its ground and conditions, and these: ``course+friction`` is of ``course``."""
    kinds, base, named = (*GROUND_KINDS, *CONDITIONS), name, set[str]()
    while (split := base.rpartition("+"))[0] and split[2] in kinds:
        base = split[0]
        named.add(split[2])
    return base, tuple(kind for kind in kinds if kind in named)


def is_user_space(name: str) -> bool:
    """Whether a space is a user's code."""
    base, _ = split_name(name)
    return base not in SPACES and ControllerSpec.parse(base).runs_code


def space_key(name: str, sha256: str | None) -> str:
    """What terrains depend on: the space's name, or the hash of its code if it has one, and its ground."""
    base, kinds = split_name(name)
    return "+".join((sha256 or base, *kinds))


def load_space(name: str | None) -> TerrainSpace:
    """A space that the command line names; a user's code is run, and :func:`get_space` finds it from then on.

    A name is a shipped space's, ``file.py:Space`` or ``module:Space``, and behind it ground and conditions, as in
    ``course+friction+push``; None is the paper's space.
    """
    base, kinds = split_name(name or SUPER_GAUSSIAN.name)
    once = "+".join((base, *kinds))
    if name and len(once) < len(name):
        raise ValueError(f"a space must have each kind of ground and condition once, got {name}: give {once}")
    if is_user_space(base):
        load_user_space(base)
    return get_space(once)


def get_space(name: str, sha256: str | None = None) -> TerrainSpace:
    """A space that a record names; no code runs that :func:`load_space` did not run.

    By the hash of its code in the record, code that has moved is found.
    """
    base, kinds = split_name(name)
    root, _, height = base.rpartition("@")
    space: TerrainSpace
    if root in SPACES and re.fullmatch(r"0?\.\d+", height):
        space = at_height(SPACES[root], float(height))
    elif base in SPACES:
        space = SPACES[base]
    elif is_user_space(base):
        space = find_user_space(base, sha256)
    else:
        kinds_text = ", ".join(f"+{kind}" for kind in (*GROUND_KINDS, *CONDITIONS))
        raise ValueError(
            f"unknown terrain space '{name}': expected one of {', '.join(SPACES)}, or file.py:CLASS, and behind it "
            f"some of {kinds_text}"
        )
    ground = [kind for kind in kinds if kind in GROUND_KINDS]
    if ground and space.ground:
        raise ValueError(f"the space {base} has its ground already, got {name}: leave +{'+'.join(ground)} out")
    return WiderSpace(space, kinds) if kinds else space


def space_at(space: TerrainSpace, height: float | None, robot: RobotCfg) -> TerrainSpace:
    """A space at a height [m], or, without one, at the height that fits the robot; prints it if it is another one."""
    if height is not None:
        return at_height(space, height)
    fits = MAX_HEIGHT * get_space(fitting_space(robot) or SUPER_GAUSSIAN.name).height_share
    if fits == MAX_HEIGHT or space.height_share != 1.0 or is_user_space(space.name):
        return space
    print(
        f"Heights up to {fits:g} m, as of the penalty scales of {robot.name} (--height, or --space "
        f"{SUPER_GAUSSIAN.name}@{MAX_HEIGHT:g}, says otherwise)."
    )
    return at_height(space, fits)


def at_height(space: TerrainSpace, height: float) -> TerrainSpace:
    """A shipped space whose heights are those of a robot for which the highest bump is ``height`` [m]."""
    if isinstance(space, WiderSpace):
        return WiderSpace(at_height(space.inner, height), space.kinds)
    if not isinstance(space, ShippedSpace):
        raise ValueError(f"height is for shipped spaces, got {space.name}: a user's space has its own heights")
    if not 0.0 < height <= MAX_HEIGHT:
        raise ValueError(f"height must lie above 0 and at most at {MAX_HEIGHT:g} m, got {height:g}")
    return replace(space, height=height)
