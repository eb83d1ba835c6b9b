"""MAP-Elites with iso+line variation (Vassiliades and Mouret 2018)."""

from typing import Any

import numpy as np

from qd.search.methods.base import IsoLineCfg, Method, Setup


class MapElites(Method):
    """Elites varied by iso+line; hard-random terrains before there is an elite."""

    Cfg = IsoLineCfg
    text = "elites varied by iso+line (Vassiliades and Mouret 2018)"

    def _make_source(self, cfg: Any, setup: Setup, stream: np.random.SeedSequence) -> Any:
        from ribs.emitters import IsoLineEmitter

        first, later = stream.spawn(2)
        return IsoLineEmitter(
            setup.archive,
            iso_sigma=cfg.iso_sigma,
            line_sigma=cfg.line_sigma,
            initial_solutions=setup.space.hard_random(cfg.batch_size, np.random.default_rng(first)),
            bounds=[(-1.0, 1.0)] * setup.space.num_genes,
            batch_size=cfg.batch_size,
            seed=later,  # pyright: ignore[reportArgumentType] - handed to numpy's default_rng, which takes it
        )
