"""CMA-ME: evolution strategies that follow what improves the archive (Fontaine et al. 2020)."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from qd.search.methods.base import Columns, Method, MethodCfg, Setup

Step = Annotated[float, Meta(ge=1e-6, le=1e3)]
"""A first step size that evolution strategies can reckon with; genes are float32 in [-1, 1]."""


@dataclass(frozen=True, kw_only=True)
class CmaMeCfg(MethodCfg):
    """Settings of evolution strategies."""

    sigma0: Step | None = None
    """First step size of an evolution strategy; genes live in [-1, 1]. The terrain space's own if None."""


class CmaMe(Method):
    """Evolution strategies that rank and select by what is new in the archive, and restart where nothing is."""

    Cfg: ClassVar[type[MethodCfg]] = CmaMeCfg
    text = "evolution strategies that follow what improves the archive (Fontaine et al. 2020)"

    def __init__(self, cfg: Any, setup: Setup) -> None:
        self.archive = self._make_archive(cfg, setup)
        super().__init__(cfg, setup)

    def _make_source(self, cfg: Any, setup: Setup, stream: np.random.SeedSequence) -> Any:
        from ribs.emitters import EvolutionStrategyEmitter

        return EvolutionStrategyEmitter(
            self.archive,
            x0=np.zeros(setup.space.num_genes),
            sigma0=setup.space.sigma0 if cfg.sigma0 is None else cfg.sigma0,
            batch_size=cfg.batch_size,
            seed=stream,  # pyright: ignore[reportArgumentType] - handed to numpy's default_rng, which takes it
            **self._rules(cfg),
        )

    def _make_archive(self, cfg: Any, setup: Setup) -> Any:
        """The archive that strategies are judged by."""
        return setup.archive

    def _rules(self, cfg: Any) -> dict[str, Any]:
        """How a strategy ranks, selects and restarts."""
        return {"ranker": "2imp", "selection_rule": "filter", "restart_rule": "no_improvement"}

    def _add(self, rows: Columns, added: Columns) -> Columns:
        """Status and value of each terrain by the archive that strategies are judged by."""
        return added

    def tell(self, evaluation: Any, rows: Columns, added: Columns, batches: dict[int, slice]) -> None:
        """Tells each strategy what became of its own terrains."""
        added = self._add(rows, added)
        if self.archive.empty:  # a strategy that restarts now would have no elite to start from
            return
        for emitter, batch in batches.items():
            if emitter in self.sources:
                self.sources[emitter].tell(
                    **{name: values[batch] for name, values in rows.items()},
                    add_info={name: values[batch] for name, values in added.items()},
                )
