"""Settings of the surrogate."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from qd.search.methods.base import IsoLineCfg
from sim.files.settings import Share


@dataclass(frozen=True, kw_only=True)
class SurrogateCfg(IsoLineCfg):
    """Settings of the networks and of the search that they judge."""

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
        super().__post_init__()
        if self.explore_share + self.disagree_share > 1.0:
            raise ValueError(
                f"explore_share and disagree_share must be at most 1 together, got {self.explore_share} and "
                f"{self.disagree_share}"
            )
