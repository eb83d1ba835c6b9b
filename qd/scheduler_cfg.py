"""How a search asks for terrains: methods and their settings. Nothing here imports pyribs, which takes seconds."""

from dataclasses import dataclass

METHODS = ("cma_mae", "cma_me", "map_elites", "directions", "hard_random", "uniform_random")
ES_KINDS = ("cma_es", "sep_cma_es")
RESTART_RULES = ("basic", "no_improvement")
STEPS = (1e-6, 1e3)
"""Step sizes that evolution strategies and iso+line can reckon with; genes are float32 and live in [-1, 1]."""


@dataclass(frozen=True, kw_only=True)
class SchedulerCfg:
    """How terrains are asked for."""

    method: str = "cma_mae+map_elites"
    """Where new terrains come from: `cma_mae` (Fontaine and Nikolaidis 2023); `cma_me` (Fontaine et al. 2020);
    `map_elites`, elites varied by iso+line (Vassiliades and Mouret 2018); `directions`, toward higher and lower ratios;
    or none is learned from: `hard_random` (the paper's: every height at its limit) and `uniform_random`. Several are
    joined by a plus: emitters take them in turn, and where they are fewer, the first ones. After 75 iterations of the
    paper preset the default's corrected QD score was 6,103, that of CMA-MAE alone 5,675 (one seed each;
    `results/anymal/compare_long.json`)."""
    emitters: int = 10
    """Emitters, each with an evolution strategy or a stream of its own."""
    batch_size: int = 20
    """Terrains an emitter asks for in an iteration."""
    learning_rate: float = 0.09
    """Step of a cell's acceptance threshold toward the fitness found there; 1 is elitist, 0 pure optimisation."""
    sigma0: float = 2.0
    """First step size; genes live in [-1, 1]. So wide a start asks for terrains at the genes' limits, which are the
    hard ones: 172 elites after 15 iterations of the paper preset, against 152 from 1.0 and 114 from 0.5 (a seed each).
    """
    restart_rule: str = "50"
    """When an emitter restarts at an elite: every so many iterations, or one of `basic` and `no_improvement`."""
    es: str = "cma_es"
    """Evolution strategy: `cma_es` adapts all covariances, `sep_cma_es` the variances alone."""
    iso_sigma: float = 0.02
    """Iso+line: standard deviation of each gene's own change (published: .01 of the genes' range)."""
    line_sigma: float = 0.2
    """Iso+line: standard deviation of the step along the line to another elite, in its length (published: .2)."""
    direction_sigma: float = 0.5
    """Directions: first step size."""
    direction_restart: int = 20
    """Directions: iterations along each."""

    def __post_init__(self) -> None:
        if not set(self.methods) <= set(METHODS) or len(set(self.methods)) < len(self.methods):
            raise ValueError(
                f"method must be one of {', '.join(METHODS)}, or several joined by a plus, each once, got {self.method}"
            )
        for name in ("iso_sigma", "line_sigma"):
            if not 0.0 <= getattr(self, name) <= STEPS[1]:
                raise ValueError(f"{name} must lie in [0, {STEPS[1]:g}], got {getattr(self, name)}")
        if self.emitters < 1 or self.batch_size < 2:
            raise ValueError(
                f"emitters must be at least 1 and batch_size at least 2, got {self.emitters} and {self.batch_size}"
            )
        if not 0.0 <= self.learning_rate <= 1.0:
            raise ValueError(f"learning_rate must lie in [0, 1], got {self.learning_rate}")
        for name in ("sigma0", "direction_sigma"):
            if not STEPS[0] <= getattr(self, name) <= STEPS[1]:
                raise ValueError(f"{name} must lie in [{STEPS[0]:g}, {STEPS[1]:g}], got {getattr(self, name)}")
        if self.direction_restart < 1:
            raise ValueError(f"direction_restart must be at least 1, got {self.direction_restart}")
        if self.es not in ES_KINDS:
            raise ValueError(f"es must be one of {', '.join(ES_KINDS)}, got {self.es}")
        if self.restart_rule not in RESTART_RULES and not (self.restart_rule.isdecimal() and int(self.restart_rule)):
            raise ValueError(
                f"restart_rule must be a positive number of iterations or one of {', '.join(RESTART_RULES)}, "
                f"got {self.restart_rule}"
            )

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods joined in ``method``."""
        return tuple(self.method.split("+"))

    @property
    def num_terrains(self) -> int:
        """Terrains of one iteration."""
        return self.emitters * self.batch_size
