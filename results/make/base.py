"""Rates of the shipped controller on hand-crafted, hard-random and flat ground: base.json."""

from collections.abc import Sequence

from qd.evaluate.evaluate import evaluate_rates
from qd.evaluate.labels import SetsCfg
from results.make.common import parse


def main(argv: Sequence[str] | None = None) -> None:
    """Crosses 300 terrains a set, 20 episodes each."""
    script = parse(__doc__, argv, "base.json")
    terrains, episodes = (6, 2) if script.small else (300, 20)
    cfg = SetsCfg(terrains=terrains, episodes=episodes, seed=script.seed)
    evaluate_rates(script.robot, script.policy, cfg, compute=script.compute, out=script.out)


if __name__ == "__main__":
    main()
