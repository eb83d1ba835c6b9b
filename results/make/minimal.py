"""Which parts of failing terrains it takes to fail: minimal.json, minimal.npz and their figure, of the archive.

They lie beside the published archive, results/<robot>/archive, of whose elites they are.
"""

from collections.abc import Sequence

from qd.faults.minimise import minimise
from results.make.common import parse


def main(argv: Sequence[str] | None = None) -> None:
    """Takes 200 failing elites apart, faults first, and has what is left of them judged."""
    script = parse(__doc__, argv, "archive/minimal.json")
    run = script.run_of_archive()
    elite = str(int(script.read_archive().failing.argmax())) if script.small else None
    minimise(run, compute=script.compute, elite=elite, how="greedy" if script.small else None, judged=not script.small)
    script.publish(run, script.out.parent, ("minimal.*",))


if __name__ == "__main__":
    main()
