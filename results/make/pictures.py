"""The pictures of README and docs: ``make pictures``, or ``python -m results.make.pictures [film] [pages]``.

``film`` makes docs/pictures/fault.gif from terrains that are kept beside it, so that new archives do not change it; the
robots' controllers of the day cross them. ``pages`` takes the pictures of the viewer and of the report.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from qd.judge import controllers_in
from qd.show.crossed import title_of, typical_episode
from qd.show.film import GIF_FPS, Picture, Shot, as_gif, pictures_of
from qd.show.replay import save, source_of_map
from sim.robots.find import get_robot

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"
CLIPS = (("anymal", "trench.npz", "a trench before stairs", None), ("cassie", "hole.npz", "a hole", "C-G"))
"""Robot, terrain, what it is in words, and the controller of the panel that is shown beside."""


def clip(named: str, file: str, words: str, beside: str | None) -> list[Picture]:
    """Four seconds about the failure of a robot's typical episode: 1.5 s, one at half speed, and half a second."""
    robot = get_robot(named)
    source = source_of_map(FOLDER / file, robot)
    (recording,) = source.record("cpu")
    other = (beside, source.record("cpu", controllers_in(robot.panel)[beside])[0]) if beside else None
    episode, title = typical_episode(recording, source.scales), title_of(replace(recording, labels=(words,)))
    shot = Shot(recording=recording, episode=episode, title=title, beside=other)
    return [*pictures_of(shot, robot, shot.times(GIF_FPS, before_s=2.5, after_s=0.5, slowness=2.0))]


def main() -> None:
    """Makes the pictures that the command line names, all without any."""
    wanted = sys.argv[1:] or ["film", "pages"]
    if "film" in wanted:
        pictures = [picture for about in CLIPS for picture in clip(*about)]
        save(FOLDER / "fault.gif", as_gif(pictures), "Film")
    if "pages" in wanted:
        subprocess.run([sys.executable, "-m", "tests.qd.show.view.screenshots"], check=True)


if __name__ == "__main__":
    main()
