"""Labels of what an evaluation reports: sets of terrains, measures, and what became of a terrain; settings of sets."""

from dataclasses import dataclass
from pathlib import Path

from sim.files.settings import NonNegativeInt, PositiveInt

HELD_OUT = ("generated", "generated_far")  # elites held out: all, and the third farthest from those trained on
INDEPENDENT = "generated_independent"  # set of elites of another search
COMPARED = "elites"  # elites that neither of two controllers, old and new, was trained on
SETS = {
    "hand_crafted": "hand-crafted",
    "hard_random": "hard-random",
    "generated": "generated, held out",
    "generated_far": "generated, farthest third",
    INDEPENDENT: "generated, another search",
}
"""Label of each set of the tables."""
MEASURES = {"goal": "goal reached", "success": "no base collision", "fallen": "fallen", "reward": "training reward"}
"""Label of each measure beside the penalties: three rates as fractions, and the sum of the reward over 20 s. No base
collision is what the paper calls success."""
CERTIFIED = {"certified_goal": "goal", "certified_success": "success"}  # measures on certified terrains alone
RATES = ("goal", "success", "fallen")  # measures that lie between 0 and 1, and so do their intervals
FATES = {fate: fate.replace("_", " ") for fate in ("mended", "still_failing", "newly_broken", "fine")}
"""What may have become of a terrain from one controller to another: failed by the first, both, the second, neither."""


@dataclass(frozen=True, kw_only=True)
class SetsCfg:
    """Which terrains controllers are evaluated on, and how often they cross them."""

    archive: Path | None = None
    """Run of a search, or its archive.npz: its held-out elites are the generated terrains."""
    independent: Path | None = None
    """Run of another search, with another seed, or its archive.npz: elites that share no ancestor with those trained
    on, drawn from all of its elites. They are the terrains of generated_independent."""
    space: str | None = None
    """Terrain space of the hard-random terrains: super_gaussian, course, or file.py:CLASS, with ground as in
    course+friction; super_gaussian if left out. If the archive is of a space of your own, name it here."""
    sets: tuple[str, ...] = ()
    """Sets of the tables: hand_crafted, hard_random, with --archive generated and generated_far, and with --independent
    generated_independent. All of them if left out."""
    terrains: PositiveInt | None = None
    """Terrains a set; 300 on CUDA (tables of Cassie: 180), 24 on the CPU."""
    episodes: PositiveInt | None = None
    """Episodes a terrain; 20 on CUDA, 4 on the CPU."""
    seed: NonNegativeInt = 0
    """Draws other test sets."""
