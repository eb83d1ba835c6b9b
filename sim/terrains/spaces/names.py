"""Names of spaces as files and command lines have them: ``course@0.06+friction+push``."""

import re
from collections.abc import Sequence

from sim.terrains.conditions.base import CONDITIONS
from sim.terrains.ground import GROUND_KINDS

_HEIGHT = re.compile(r"@(0?\.\d+)$")


def split_name(name: str) -> tuple[str, tuple[str, ...]]:
    """The name of a space without its ground and conditions, and these: ``course+friction`` is of ``course``."""
    kinds, base, named = (*GROUND_KINDS, *CONDITIONS), name, set[str]()
    while (split := base.rpartition("+"))[0] and split[2] in kinds:
        base = split[0]
        named.add(split[2])
    return base, tuple(kind for kind in kinds if kind in named)


def join_name(base: str, kinds: Sequence[str]) -> str:
    """The name of a space with ground or conditions."""
    return "+".join((base, *kinds))


def split_height(base: str) -> tuple[str, float | None]:
    """The name of a space without its height [m], and that: ``course@0.06`` is ``course``; None of a usual height."""
    found = _HEIGHT.search(base)
    return (base, None) if found is None else (base[: found.start()], float(found[1]))


def join_height(base: str, height: float) -> str:
    """The name of a space with another height [m] than its usual one."""
    return f"{base}@{height:g}"
