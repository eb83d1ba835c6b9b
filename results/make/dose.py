"""Which real obstacle at which size stops a controller: dose.json, and dose-resolved.json with contact resolved."""

from collections.abc import Sequence
from typing import Any

from qd.evaluate.dose import all_doses, measure_dose, parse_doses
from results.make.common import parse, published_controllers

DOSED = ("base", "C-G", "hardened")
TRIED = ("step_up=0.1,0.4", "segment_2=1", "push_1=2", "map_shift=0.2", "estimate=0.5")  # in a trial


def main(argv: Sequence[str] | None = None) -> None:
    """Lets the base, C-G and the hardened controller cross every value of every obstacle; parts are the files."""
    script = parse(__doc__, argv, "dose.json", parts=("search", "resolved"))
    published = published_controllers(script)
    controllers = {name: published[name] for name in (DOSED[:1] if script.small else DOSED)}
    borne = tuple(name for name in all_doses() if script.robot.arm_joints or not name.startswith("arms"))
    doses = parse_doses(TRIED if script.small else borne, ())
    size = 1 if script.small else None
    for engine in script.parts or (("search",) if script.small else ("search", "resolved")):
        resolved = engine == "resolved"
        out = script.out.with_stem(f"{script.out.stem}-resolved") if resolved else script.out
        sizes: dict[str, Any] = {"terrains": size, "episodes": size, "seed": script.seed}
        measure_dose(script.robot, controllers, doses, compute=script.compute, resolved=resolved, out=out, **sizes)


if __name__ == "__main__":
    main()
