"""The published packs, sim/robots/<robot>/packs: 100 terrains that can be crossed, and how often controllers do.

They come from two searches of their own, of preset wide to 192,000 episodes, judged by the panel. No controller of
theirs has trained on them, nor on kin of them: C-G trained on the published archive. The hardened one is left out,
since no archive of its rounds is published to compare with. A published pack does not change.
"""

from collections.abc import Sequence
from typing import Any

from qd.evaluate.pack import make_pack
from qd.faults.judge import judge
from qd.faults.searches import find_search
from qd.search.loop import search
from results.make.common import parse, published_controllers

VERSION = 2
SEEDS = (7000, 7001)
"""Of the searches, which no other search has."""
EPISODES = 192_000
STAGES = ("fresh", "resolved", "others")


def main(argv: Sequence[str] | None = None) -> None:
    """Searches, judges, chooses the terrains, and lets controllers cross them; each search and the rest are parts.

    A trial takes terrains of the published archive.
    """
    names = (*(f"search {seed}" for seed in SEEDS), "choose")
    script = parse(__doc__, argv, f"packs/{VERSION}/pack.json", published="sim/robots", parts=names)
    runs, parts = [script.runs / "packs" / str(seed) for seed in SEEDS], script.parts or names
    for name, seed, run in zip(names, SEEDS, runs, strict=False):
        if not script.small and name in parts:
            search(script.search_cfg(episodes=EPISODES, seed=seed), run, script.compute)
            judge(run, stages=STAGES, compute=script.compute)
    if "choose" not in parts:
        return
    if script.small:
        runs = [script.run_of_archive()]
    trained = {name: file for name, file in published_controllers(script).items() if name != "hardened"}
    sizes: dict[str, Any] = {"size": 2, "episodes": 2} if script.small else {"size": 100, "episodes": 20}
    apart_from = [] if script.small else [script.read_archive()]
    how = {"compute": script.compute, "apart_from": apart_from, "licence": "Apache-2.0", **sizes}
    make_pack([*map(find_search, runs)], trained, seed=script.seed, version=VERSION, out=script.out.parent, **how)


if __name__ == "__main__":
    main()
