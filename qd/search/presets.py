"""How a search asks for terrains, and how much it crosses: settings that its command shows, so they load quickly."""

from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from sim.files.settings import NonNegativeInt, PositiveInt, Share, check_settings

METHODS = ("cma_mae", "cma_me", "map_elites", "surrogate", "hard_random", "uniform_random")
Step = Annotated[float, Meta(ge=1e-6, le=1e3)]
"""A first step size that evolution strategies can reckon with; genes are float32 in [-1, 1]."""
Sigma = Annotated[float, Meta(ge=0, le=1e3)]
"""A standard deviation of changes of genes."""


@dataclass(frozen=True, kw_only=True)
class SchedulerCfg:
    """How terrains are asked for."""

    method: str = "surrogate"
    """Where new terrains come from: `surrogate`, elites varied by iso+line for some generations that networks judge
    (after DSAGE, Bhatt et al. 2022); `cma_mae` (Fontaine and Nikolaidis 2023); `cma_me` (Fontaine et al. 2020);
    `map_elites`, elites varied by iso+line (Vassiliades and Mouret 2018); `hard_random`, the paper's, every height at
    its limit; `uniform_random`. The last two learn nothing. Several are joined by a plus: emitters take them in turn,
    and where there are fewer emitters, the first methods count. docs/results.md compares them."""
    emitters: PositiveInt = 10
    """Emitters that ask, each with an evolution strategy or a stream of its own."""
    batch_size: Annotated[int, Meta(ge=2)] = 20
    """Terrains an emitter asks for in an iteration."""
    again: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """Terrains that are crossed again beside those of an emitter, the least known ones. All episodes of a terrain then
    count, and it holds its cell by what it is expected to add to the QD score of fresh ones. With 0 a terrain is
    crossed once, and the fittest of a cell holds it, as in the paper."""
    settling: NonNegativeInt = 0
    """Last iterations of a search, in which nothing new is crossed; needs --scheduler.again; fewer than
    --iterations."""
    groups: Annotated[int, Meta(ge=1, le=32)] = 1
    """Groups of emitters that ask and are told in turn, in a fixed order, at most one an emitter: robots have the
    terrains of the others to cross while the last robots of a group's terrains still walk."""
    learning_rate: Share = 0.09
    """Step of a cell's acceptance threshold toward the fitness found there; 1 is elitist, 0 pure optimisation."""
    sigma0: Step | None = None
    """First step size of an evolution strategy; genes live in [-1, 1]. The terrain space's own if None."""
    restart_rule: PositiveInt = 50
    """Iterations after which an evolution strategy restarts at an elite."""
    iso_sigma: Sigma = 0.02
    """Iso+line: standard deviation of each gene's own change (published: .01 of the genes' range)."""
    line_sigma: Sigma = 0.2
    """Iso+line: standard deviation of the step along the line to another elite, in its length (published: .2)."""
    crossover_share: Share = 0.3
    """Surrogate: share of the varied elites that take each of their parts, such as bumps, from a further elite with a
    chance of a half; of no effect where a space has no parts."""
    candidates: Annotated[int, Meta(ge=1, le=10_000)] = 20
    """Surrogate: terrains that the networks judge in each generation for one that robots cross."""
    generations: Annotated[int, Meta(ge=1, le=1_000)] = 10
    """Surrogate: generations that the networks judge before robots cross the best."""
    explore_share: Share = 0.25
    """Surrogate: share of its terrains that are elites varied once, whatever the networks say."""
    disagree_share: Share = 0.1
    """Surrogate: share of its terrains that the networks disagree most about."""
    training_steps: Annotated[int, Meta(ge=1, le=100_000)] = 100
    """Surrogate: steps of training an iteration, each on 64 terrains a network, or as many as an iteration has."""

    def __post_init__(self) -> None:
        check_settings(self)
        if not set(self.methods) <= set(METHODS) or len(set(self.methods)) < len(self.methods):
            raise ValueError(
                f"method must be one of {', '.join(METHODS)}, or several joined by a plus, each once, got {self.method}"
            )
        if self.explore_share + self.disagree_share > 1.0:
            raise ValueError(
                f"explore_share and disagree_share must be at most 1 together, got {self.explore_share} and "
                f"{self.disagree_share}"
            )
        if self.settling and not self.again:
            raise ValueError(f"again must be 1 or more where iterations settle, got 0 and settling {self.settling}")

    def check_iterations(self, iterations: int) -> None:
        """Refuses a search of so few iterations that all of them would settle."""
        if self.settling >= iterations:
            raise ValueError(f"scheduler.settling must be below the iterations, {iterations}, got {self.settling}")

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods joined in ``method``."""
        return tuple(self.method.split("+"))

    @property
    def num_groups(self) -> int:
        """Groups that there are."""
        return min(self.groups, self.emitters)

    @property
    def num_terrains(self) -> int:
        """Terrains of one iteration."""
        return self.emitters * (self.batch_size + self.again)


PRESETS: dict[str, dict[str, Any]] = {
    "wide": {
        "iterations": 125, "replicas": 2,
        "scheduler": SchedulerCfg(
            emitters=80, batch_size=110, again=90, groups=8, candidates=12, training_steps=400
        ),
    },
    "paper": {"iterations": 1000, "replicas": 20, "scheduler": SchedulerCfg()},
    "small": {
        "iterations": 20, "replicas": 4,
        "scheduler": SchedulerCfg(emitters=4, batch_size=8, groups=2, generations=3),  # judging takes time on a CPU
    },
}  # fmt: skip
"""Sizes of a search by name.

``paper`` is the paper's search: 10 emitters x 20 terrains x 20 episodes, 1,000 iterations. ``wide`` has as many
episodes, and eight times as many emitters and an eighth of the iterations, which fills a GPU. Its terrains are crossed
in two episodes, and those that last again and again, which finds about two thirds more failing terrains in as many
episodes (results/make/search_noise.py). ``small`` is one that a
laptop finishes while one waits: 4 emitters x 8 terrains x 4 episodes, 20 iterations.
"""


def preset_of(name: str) -> dict[str, Any]:
    """Iterations, replicas and scheduler of a preset; an unknown name is a ValueError."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset '{name}': expected one of {', '.join(PRESETS)}")
    return PRESETS[name]
