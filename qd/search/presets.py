"""How a search asks for terrains, and how much it crosses: settings that its command shows, so they load quickly."""

from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from qd.search.methods import METHODS
from sim.files.settings import NonNegativeInt

_CFGS = list(dict.fromkeys(method.Cfg for method in METHODS.values()))
_BASES: Any = [cfg for cfg in _CFGS if not any(issubclass(other, cfg) for other in _CFGS if other is not cfg)]


@dataclass(frozen=True, kw_only=True)
class SchedulerCfg(*_BASES):
    """How terrains are asked for, with the settings of all methods."""

    method: str = "surrogate"
    """Where new terrains come from, as --method."""
    settling: NonNegativeInt = 0
    """Last iterations of a search, in which nothing new is crossed; needs --scheduler.again; fewer than
    --iterations."""
    groups: Annotated[int, Meta(ge=1, le=32)] = 1
    """Groups of emitters that ask and are told in turn, in a fixed order, at most one an emitter: robots have the
    terrains of the others to cross while the last robots of a group's terrains still walk."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not set(self.methods) <= set(METHODS) or len(set(self.methods)) < len(self.methods):
            rule = f"one of {', '.join(METHODS)}, or several joined by a plus, each once"
            raise ValueError(f"method must be {rule}, got {self.method}")
        if self.settling and not self.again:
            raise ValueError(f"again must be 1 or more where iterations settle, got 0 and settling {self.settling}")

    def check_iterations(self, iterations: int) -> None:
        """Refuses a search of so few iterations that all of them would settle."""
        if self.settling >= iterations:
            raise ValueError(f"scheduler.settling must be below the iterations, {iterations}, got {self.settling}")

    def check_worth(self, **weights: float) -> None:
        """Refuses that what nobody crosses, or what is unlikely, earns less where no search goes by it."""
        for name, weight in weights.items():
            if weight and not self.learns_crossed:
                rule = f"fitness.{name} must be 0 unless the method is surrogate alone and scheduler.again 1 or more"
                got = f"got {weight:g} with {self.method} and {self.again}"
                raise ValueError(f"{rule}, {got}: give --scheduler.again 90, as preset wide has")

    @property
    def learns_crossed(self) -> bool:
        """Whether a search learns what nobody crosses, and a pool goes by it."""
        return self.methods == ("surrogate",) and self.again > 0

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods joined in ``method``."""
        return tuple(self.method.split("+"))

    @property
    def num_groups(self) -> int:
        """Groups that there are."""
        return min(self.groups, self.emitters)


PRESETS: dict[str, dict[str, Any]] = {
    "wide": {
        "iterations": 125,
        "replicas": 2,
        "scheduler": SchedulerCfg(emitters=80, batch_size=110, again=90, groups=8, candidates=12, training_steps=400),
    },
    "paper": {"iterations": 1000, "replicas": 20, "scheduler": SchedulerCfg()},
    "small": {
        "iterations": 20,
        "replicas": 4,
        "scheduler": SchedulerCfg(emitters=4, batch_size=8, groups=2, generations=3),  # networks take time on a CPU
    },
}
"""Sizes of a search by name.

``paper`` is the paper's search. ``wide`` has as many episodes, and eight times as many emitters and an eighth of the
iterations, which fills a GPU. Its terrains are crossed in two episodes, and those that last again and again, which
finds about two thirds more failing terrains (results/make/search_noise.py). A laptop finishes ``small`` in minutes.
"""


def read_preset(name: str) -> dict[str, Any]:
    """Iterations, replicas and scheduler of a preset; an unknown name is a ValueError."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset '{name}': expected one of {', '.join(PRESETS)}")
    return PRESETS[name]
