"""Methods of search by the names that ``--method`` and files have."""

from qd.search.methods.base import Method
from qd.search.methods.cma_mae import CmaMae
from qd.search.methods.cma_me import CmaMe
from qd.search.methods.map_elites import MapElites
from qd.search.methods.random import HardRandom, UniformRandom
from qd.search.methods.surrogate import SurrogateSearch

METHODS: dict[str, type[Method]] = {
    "surrogate": SurrogateSearch,
    "cma_mae": CmaMae,
    "cma_me": CmaMe,
    "map_elites": MapElites,
    "hard_random": HardRandom,
    "uniform_random": UniformRandom,
}
"""One line a method; a new one is registered before :mod:`qd.search.presets` is imported, which takes its settings."""
