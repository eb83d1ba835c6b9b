"""Controllers by name: several on one command line, and in the names of files about them."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sim.files.provenance import controller_hash
from sim.policy.spec import SHIPPED, ControllerSpec, spec_of

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

MARK = "@"
"""Between the kind of a controller and its seed: C-G, C-G@1 and C-G@2 are of kind C-G."""


def kind_of(name: str) -> str:
    """The kind of a controller by its name."""
    return name.split(MARK)[0]


def controllers_of(policies: Sequence[str], robot: "RobotCfg") -> dict[str, str]:
    """Policy of each controller by its name, in the order given; the shipped one as ``base`` if there is none.

    Args:
        policies: ``NAME=FILE``, ``NAME=module:callable`` or ``NAME=shipped``; several may stand in one, apart by
            spaces, as make hands them over.
        robot: The robot, whose controller is the shipped one.

    Raises:
        ValueError: If one has no name, or two have the same.
    """
    text = " ".join(policies).strip() or f"base={SHIPPED}"
    found: dict[str, str] = {}
    for item in re.split(r"\s+(?=[^\s=]+=)", text):  # a file's name may hold spaces: split where the next name is
        name, _, policy = item.partition("=")
        if not re.fullmatch(r"[\w.+@-]+", name) or not policy:
            raise ValueError(
                f"policies must be NAME=FILE each, the name of letters, digits and . _ + @ -, got '{item}': "
                "write for example C-G=runs/tuned/policy.pt"
            )
        if name in found:
            raise ValueError(f"policies must have different names, got '{name}' twice: rename one of them")
        found[name] = spec_of(policy, robot)
    return found


def controller_suffix(policy: str, usual: str) -> str:
    """What the name of a file about a controller ends with: nothing for the usual one, else such as -C-G."""
    if is_same(policy, usual):
        return ""
    label = ControllerSpec.parse(policy).label.removesuffix(".pt").removesuffix(".onnx")
    return "-" + re.sub(r"[^A-Za-z0-9_.-]+", "-", label)


def who_crossed(robot: "RobotCfg", policy: str) -> str:
    """What files about a robot and its controller are called: by its name, and by the controller if not the shipped."""
    return robot.name + controller_suffix(policy, str(robot.policy_file))


def is_same(policy: str, other: str) -> bool:
    """Whether two names are of the same controller, by name or by its files."""
    digest = controller_hash(policy)
    return policy == other or (digest is not None and digest == controller_hash(other))
