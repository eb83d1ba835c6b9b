"""Words for what an evaluation reports: sets of terrains, measures, and what became of a terrain."""

HELD_OUT = ("generated", "generated_far")
"""Sets of elites held out of training: all, and the third that lies farthest from those trained on."""
INDEPENDENT = "generated_independent"
"""Set of elites of another search."""
COMPARED = "elites"
"""Set of elites that neither of two controllers was trained on, ``old`` and ``new``, which are compared on it."""
FROM_ARCHIVE = (*HELD_OUT, INDEPENDENT)
"""Sets made of elites."""
SETS = {
    "hand_crafted": "hand-crafted",
    "hard_random": "hard-random",
    "generated": "generated, held out",
    "generated_far": "generated, farthest third",
    INDEPENDENT: "generated, another search",
}
"""Sets of the tables, in words."""
MEASURES = {
    "goal": "goal reached",
    "success": "no base collision",
    "fallen": "fallen",
    "reward": "training reward",
}
"""Measures beside the penalties, in words: three rates as fractions, and the sum of the reward over 20 s. No base
collision is what the paper calls success."""
CERTIFIED = {"certified_goal": "goal", "certified_success": "success"}
"""Measures on the certified terrains of a set alone, by what they measure."""
RATES = ("goal", "success", "fallen", *CERTIFIED)
"""Measures that lie between 0 and 1, and so do their intervals."""
FATES = {fate: fate.replace("_", " ") for fate in ("mended", "still_failing", "newly_broken", "fine")}
"""What may have become of a terrain from one controller to another: failed by the first, both, the second, neither."""
