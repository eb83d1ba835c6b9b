"""The published pack, sim/robots/<robot>/pack: 100 certified terrains, and how often controllers cross them.

They are of the independent search, which no published controller has trained on, nor on kin of it.
"""

from collections.abc import Sequence

from qd.evaluate.pack import make_pack
from qd.faults.judge import judge
from qd.faults.searches import find_search
from results.make.common import parse, published_controllers


def main(argv: Sequence[str] | None = None) -> None:
    """Chooses the terrains and lets the published controllers cross them."""
    script = parse(__doc__, argv, "pack/pack.json", published="sim/robots")
    size, episodes = (2, 2) if script.small else (100, 20)
    run = script.run_of_archive("archive" if script.small else "independent")
    if not script.small:
        judge(run, stages=("resolved", "others"), compute=script.compute)
    sizes = {"size": size, "episodes": episodes, "seed": script.seed}
    make_pack(find_search(run), published_controllers(script), compute=script.compute, out=script.out.parent, **sizes)


if __name__ == "__main__":
    main()
