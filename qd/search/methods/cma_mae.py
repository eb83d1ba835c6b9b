"""CMA-MAE: evolution strategies on an archive whose thresholds lag behind (Fontaine and Nikolaidis 2023)."""

from dataclasses import dataclass
from typing import Any

from qd.search.methods.base import Columns, Setup
from qd.search.methods.cma_me import CmaMe, CmaMeCfg
from sim.files.settings import PositiveInt, Share


@dataclass(frozen=True, kw_only=True)
class CmaMaeCfg(CmaMeCfg):
    """Settings of evolution strategies and of their thresholds."""

    learning_rate: Share = 0.09
    """Step of a cell's acceptance threshold toward the fitness found there; 1 is elitist, 0 pure optimisation."""
    restart_rule: PositiveInt = 50
    """Iterations after which an evolution strategy restarts at an elite."""


class CmaMae(CmaMe):
    """Evolution strategies that are judged by an archive of their own, with thresholds."""

    Cfg = CmaMaeCfg
    text = "evolution strategies on thresholds that lag behind the archive (Fontaine and Nikolaidis 2023), the paper's"

    def _make_archive(self, cfg: Any, setup: Setup) -> Any:
        from qd.search.fitness import FITNESS_FLOOR
        from qd.search.grid import make_grid

        learning = {"learning_rate": cfg.learning_rate, "threshold_min": FITNESS_FLOOR}
        return make_grid(setup.space.num_genes, setup.cells, setup.stream(0), **learning)

    def _rules(self, cfg: Any) -> dict[str, Any]:
        return {"ranker": "imp", "selection_rule": "mu", "restart_rule": cfg.restart_rule}

    def _add(self, rows: Columns, added: Columns) -> Columns:
        return self.archive.add(**rows)
