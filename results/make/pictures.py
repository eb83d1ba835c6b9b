"""The pictures of README and docs: ``make pictures``, or ``python -m results.make.pictures`` with some of their kinds.

``film`` makes docs/pictures/fault.gif from terrains that are kept beside it, so that new archives do not change it; the
robots' controllers of the day cross them. ``conditions`` films minimal examples of the published searches under
conditions, and ``stills`` shows the worst course where its search is here (results.make.spaces).
``training`` films ANYmal before and after its hardening. ``pages`` takes the pictures of the viewer and of the report.
``curves`` draws what the published files say of searches, ``drawings`` the elements of a course, the loop of a search,
the probes of a robot and the terrains of its pack.
"""

import itertools
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image
from scipy.spatial.transform import Rotation

from kernels.course import GENES_PER_ELEMENT, SPACING
from kernels.episode import Outcome
from qd.evaluate.pack import find_pack, read_pack
from qd.faults.searches import controllers_in
from qd.search.archive import read_archive
from qd.show.crossed import count_rates, find_typical_episode, make_title
from qd.show.elites import open_run
from qd.show.figures import draw_archive, save_figure
from qd.show.film import GIF_FPS, Picture, Shot, as_gif, render_pictures
from qd.show.replay import ReplaySource, save, source_from_map, source_from_run
from results.make.common import runs_of_today
from results.make.docs import PAPER, PICTURES, ROBOTS, least_minimum, note_picture, read
from results.make.search_noise import DESIGNS
from sim.files.figures import new_figure
from sim.rates import typical_outcome
from sim.robots.find import get_robot
from sim.rollout import Rollout
from sim.terrains.bank import make_heights
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.elements.kinds import ELEMENTS
from sim.terrains.maps.picture import height_colors
from sim.terrains.spaces.course import Course
from sim.terrains.terrains import Terrains

STILL_SIZE = (640, 360)
"""Width and height [pixels]."""
CLIPS = (("anymal", "trench.npz", "a trench before stairs", None), ("cassie", "hole.npz", "a hole", "C-G"))
"""Robot, terrain, what it is in words, and the controller of the panel that is shown beside."""
FILMED = {
    "estimate": ("anymal", "conditions"),
    "grip": ("cassie", "conditions"),
    "map_drift": ("anymal", "conditions"),
    "push_2": ("anymal", "conditions"),
    "segment_1": ("anymal", "route"),
}
"""Conditions of which the smallest example of a robot's search is filmed."""
GROWN = {
    "archive": ("default", "C0"),
    "independent": ("default, two other seeds", "C9"),
    "third": (None, "C9"),
    "archive_cma_mae": ("CMA-MAE", "C1"),
}
"""Published searches whose growth is drawn, with label and colour."""
FILM_SIZE, FILM_BYTES = (400, 225), 300_000
"""Width and height of a small film [pixels], and its largest file."""
SHORT: dict[str, Any] = {"before_s": 1.5, "after_s": 0.5, "fps": GIF_FPS}
"""What a film on a page shows about a failure."""


def clip(named: str, file: str, words: str, beside: str | None) -> list[Picture]:
    """Four seconds about the failure of a robot's typical episode: 1.5 s, one at half speed, and half a second."""
    robot = get_robot(named)
    source = source_from_map(PICTURES / file, robot)
    (recording,) = source.record("cpu")
    other = (beside, source.record("cpu", source.requests(controllers_in(robot.panel)[beside]))[0]) if beside else None
    episode, title = find_typical_episode(recording, source.scales), make_title(replace(recording, labels=(words,)))
    longer: Any = SHORT | {"before_s": 2.5, "slowness": 2.0}
    shot = Shot(recording=recording, episode=episode, title=title, beside=other, **longer)
    return [*render_pictures(shot, robot, shot.times)]


def take_still(source: ReplaySource, name: str) -> None:
    """The moment at which the robot fails on a terrain: needs no GPU, but a renderer."""
    (recording,) = source.record("cpu")
    episode = find_typical_episode(recording, source.scales)
    shot = Shot(recording=recording, episode=episode, title=make_title(recording))
    moment = shot.end if shot.moment is None else shot.moment
    (picture,) = render_pictures(shot, source.robot, np.array([moment]), STILL_SIZE)
    Image.fromarray(picture).save(PICTURES / f"{name}.jpg", quality=85)
    note_picture(f"{name}.jpg", "results/anymal/spaces.json#spaces/course")


def film_failure(source: ReplaySource, name: str, words: str, *made_of: str) -> None:
    """A small film of the commonest failure on a terrain, made of these files; none where robots do not fail today."""
    (recording,) = source.record("cpu")
    stopped = [outcome for outcome in recording.outcome[0] if outcome not in (Outcome.GOAL, Outcome.INVALID)]
    if not stopped:
        return
    episode = find_typical_episode(recording, source.scales, int(typical_outcome(np.array(stopped))))
    title = make_title(replace(recording, labels=(words,)))
    shot = Shot(recording=recording, episode=episode, title=title, **SHORT)
    pictures = render_pictures(shot, source.robot, shot.times, FILM_SIZE)
    save(PICTURES / f"{name}.gif", as_gif([*pictures], FILM_BYTES), "Film")
    note_picture(f"{name}.gif", *made_of)


def film_conditions() -> None:
    """Films of the smallest examples of the published searches under conditions."""
    for kind, (robot, search) in FILMED.items():
        if (least := least_minimum(robot, kind, search)) is not None:
            run = f"results/{robot}/{search}"
            source = source_from_run(open_run(robot, Path(run)), minimal=str(least["elite"]))
            film_failure(source, kind, CONDITIONS[kind].cause, f"{run}/minimal.npz", f"sim/robots/{robot}.pt")


def film_training() -> None:
    """Of a search that no training saw, the worst elite that always stops ANYmal and never the hardened one."""
    run, hardened = "results/anymal/independent", "results/anymal/hardened.pt"
    opened = open_run("anymal", Path(run))
    for number in opened.rank().worst(len(opened.archive)):
        source = source_from_run(opened, str(number))
        (before,), (after,) = source.record("cpu"), source.record("cpu", source.requests(hardened))
        rates = [count_rates(recording)["goal_rate"] for recording in (before, after)]
        if rates[0].hits == 0 and rates[1].hits == rates[1].count:
            what: Any = {"episode": find_typical_episode(before, source.scales), "title": make_title(before)}
            shot = Shot(recording=before, beside=("hardened", after), slowness=2.0, **what, **SHORT)
            pictures = render_pictures(shot, opened.robot, shot.times)
            save(PICTURES / "hardened.gif", as_gif([*pictures], 1_000_000), "Film")
            note_picture("hardened.gif", f"{run}/archive.npz", hardened, "sim/robots/anymal.pt")
            return


def course_source() -> ReplaySource | None:
    """The worst terrain of ANYmal's search of courses by today's sources; None if it is not on this machine."""
    run = runs_of_today() / "anymal/spaces/course"
    if not (run / "archive.npz").exists():
        print(f"{run} is not here: the picture of a course stays as it is.")
        return None
    return source_from_run(open_run("anymal", run))


def draw_noise() -> Figure:
    """Searches under noise: corrected elites against the share of elites that is in its cell again."""
    figure, handles, designs = new_figure(12, 4.2), dict[str, Any](), list(DESIGNS)
    for axes, (robot, words) in zip(figure.subplots(1, len(ROBOTS)), ROBOTS.items(), strict=True):
        axes.set(title=words, xlabel="share of elites in their cell again", ylabel="corrected elites")
        rows = read(f"results/{robot}/search_noise.json")["rows"]
        for row in sorted(rows, key=lambda row: row["search"]):
            label = row["search"].partition(", seed")[0]
            mark, color = "*" if label.endswith("a million") else "o", f"C{designs.index(row['design'])}"
            place = row["elites_same_cell"] / row["elites"], row["corrected_elites"]
            (handles[label],) = axes.plot(*place, mark, color=color)
        axes.grid(alpha=0.3)
    figure.legend([*handles.values()], [*handles], fontsize=7, loc="outside right center")
    return figure


def draw_growth() -> Figure:
    """Corrected and failing elites of the published searches over their episodes."""
    figure = new_figure(12, 3.6)
    for axes, (robot, words) in zip(figure.subplots(1, len(ROBOTS)), ROBOTS.items(), strict=True):
        axes.set(title=words, xlabel="million episodes", ylabel="elites")
        for name, (of_search, color) in GROWN.items():
            rows = read(f"results/{robot}/{name}/curve.json")["curve"]
            for count, style in {"corrected_elites": "-", "failing": "--"}.items():
                episodes, counts = [row["episodes"] / 1e6 for row in rows], [row[count] for row in rows]
                label = of_search and f"{of_search}: {count.replace('_', ' ')}"
                axes.plot(episodes, counts, style, marker=".", color=color, label=label)
        axes.axhline(read(PAPER)[robot]["archive"]["elites"], color="0.5", label="the paper's elites, as found")
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), fontsize=8, loc="outside right center")
    return figure


def draw_elements() -> Figure:
    """Every element of a course but flat ground, each alone, and as hard as it is there."""
    course = Course()
    kinds = [ELEMENTS[name] for name in course.kinds]
    genes = np.full((len(kinds), 6, GENES_PER_ELEMENT), -1.0, np.float32)  # flat ground of no length is what is left
    ends = {"low": -1.0, "high": 1.0, "either": 1.0}
    for number, kind in enumerate(kinds):
        genes[number, 0, :2] = (2 * number + 1) / len(kinds) - 1.0, -0.9  # kind, and a little flat ground before it
        genes[number, 0, 2:] = [ends.get(limits.hard, 0.0) for limits in kind.ranges]
    genes = genes[1:].reshape(len(kinds) - 1, -1)
    heights = make_heights(genes, course)
    figure = new_figure(12, 7.2)
    y, x = (SPACING * np.arange(size) for size in heights.shape[1:])
    shown = np.ix_((y >= 3.0) & (y <= 5.0), (x >= 3.6) & (x <= 7.6))
    lowest, highest = heights.min(), heights.max()
    light, limits = LightSource(azdeg=315, altdeg=35), Normalize(-0.8, 0.8)
    for number, (row, grid) in enumerate(zip(genes, heights, strict=True), 1):
        axes: Any = figure.add_subplot(3, -(-len(genes) // 3), number, projection="3d")
        part, (across, along) = grid[shown], np.meshgrid(y[shown[0].ravel()], x[shown[1].ravel()], indexing="ij")
        colours = light.shade(part, colormaps["cividis"], norm=limits, dx=SPACING, dy=SPACING, blend_mode="soft")
        axes.plot_surface(along, across, part, facecolors=colours, rstride=1, cstride=1, lw=0, antialiased=False)
        axes.set(zlim=(lowest, highest))
        axes.set_title(textwrap.fill(course.describe(row), 36), fontsize=9, y=1.0)
        axes.set_box_aspect((np.ptp(along), np.ptp(across), highest - lowest), zoom=1.15)
        axes.view_init(elev=28, azim=-125)
        axes.set_axis_off()
    return figure


def draw_probes() -> Figure:
    """ANYmal from the side on rubble: its probes, those that touch, and the ground under the way."""
    robot, course = get_robot("anymal"), Course()
    genes = np.full((6, GENES_PER_ELEMENT), -1.0, np.float32)
    genes[0, :2] = (2 * [*course.kinds].index("rubble") + 1) / len(course.kinds) - 1.0, 0.0
    genes[0, 2:] = 1.0
    terrains = Terrains(genes=genes.reshape(1, -1), seeds=np.zeros(1, np.uint32), space=course)
    rollout = Rollout(robot, str(robot.policy_file), num_terrains=1, replicas=1, device="cpu", space=course)
    rollout.put(terrains)
    sim = rollout.sim
    while sim.joint_q.numpy()[0, 0] < 6.5:
        rollout.control_step()
    sim.collide()
    probes, poses, bodies = sim.probes, sim.poses, sim.poses.column_of_body.numpy()
    strips = np.diff(probes.strip_start.numpy())
    column = bodies[np.repeat(probes.bundle_body.numpy(), np.diff(probes.bundle_start.numpy()))].repeat(strips)
    turns = Rotation.from_quat(poses.xquat.numpy()[0, column], scalar_first=True)
    centres = poses.xpos.numpy()[0, column] + turns.apply(probes.position.numpy())
    figure = new_figure(9, 3.6)
    axes = figure.subplots()
    for (x, _, z), radius in zip(centres, probes.strip_radius.numpy().repeat(strips), strict=True):
        axes.add_patch(Circle((x, z), radius, fc="C0", ec="C0", alpha=0.25))
    contacts = sim.contacts
    count = int(contacts.count.numpy()[0])
    points, normals = (array.numpy()[0, :count] for array in (contacts.point, contacts.normal))
    axes.quiver(*points[:, ::2].T, *normals[:, ::2].T, color="C3", scale=12, width=0.004, zorder=4)
    heights = sim.bank.terrain.heights.numpy()[0]
    shown = slice(round(5.6 / SPACING), round(7.4 / SPACING) + 1)
    x = SPACING * np.arange(heights.shape[1])[shown]
    for y in {round(float(point[1]) / SPACING) for point in points}:
        axes.plot(x, heights[y, shown], color="0.3", lw=1)
    axes.set(xlim=(x[0], x[-1]), aspect="equal", xlabel="x [m]", ylabel="z [m]")
    return figure


def draw_pack() -> Figure:
    """Terrains of ANYmal's pack from above, forty of them."""
    heights = read_pack(find_pack("anymal")).heights
    figure = new_figure(12, 3.4)
    for axes, grid in zip(figure.subplots(5, 8).flat, heights[:: max(1, len(heights) // 40)], strict=False):
        axes.imshow(height_colors(grid), origin="lower")
        axes.set_axis_off()
    return figure


def draw_loop() -> Figure:
    """A search as a loop: who hands what to whom."""
    figure = new_figure(9, 3.0)
    axes = figure.subplots()
    boxes = {
        "emitters": (0.0, 1.0, "method of search\nvaries elites; networks\njudge what it asks for"),
        "terrains": (1.0, 1.0, "terrains\ngenes become heights"),
        "robots": (2.0, 1.0, "crossings\n32,000 robots at once,\nthe controller a black box"),
        "scores": (2.0, 0.0, "penalties\nhow badly, how reliably,\nin which shares"),
        "archive": (1.0, 0.0, "archive\na cell for each way to struggle\nkeeps the hardest terrain"),
        "faults": (0.0, 0.0, "judged at the end\nfresh episodes, finer physics,\nother controllers, MuJoCo C"),
    }
    for x, y, words in boxes.values():
        box = {"boxstyle": "round,pad=0.5", "fc": "0.95", "ec": "C0"}
        axes.text(x, y, words, ha="center", va="center", fontsize=8, bbox=box)
    way = ("emitters", "terrains", "robots", "scores", "archive", "faults")
    for begin, end in (*itertools.pairwise(way), ("archive", "emitters")):
        (x0, y0, _), (x1, y1, _) = boxes[begin], boxes[end]
        aside, up = 0.36 * np.sign(x1 - x0) * (y0 == y1), 0.26 * np.sign(y1 - y0)  # leaves room for both boxes
        ends: Any = {"xy": (x1 - aside, y1 - up), "xytext": (x0 + aside, y0 + up)}
        axes.annotate("", **ends, arrowprops={"arrowstyle": "-|>", "color": "C0", "lw": 1.5})
    axes.set(xlim=(-0.5, 2.5), ylim=(-0.45, 1.45))
    axes.set_axis_off()
    return figure


def draw(name: str, figure: Figure, *made_of: str) -> None:
    """Writes a figure, made of these files."""
    save_figure(PICTURES / name, figure)
    note_picture(name, *made_of)


def main() -> None:
    """Makes the pictures that the command line names, all without any."""
    wanted = sys.argv[1:] or ["film", "conditions", "training", "stills", "pages", "curves", "drawings"]
    if "film" in wanted:
        pictures = [picture for about in CLIPS for picture in clip(*about)]
        save(PICTURES / "fault.gif", as_gif(pictures), "Film")
        made_of = [f"docs/pictures/{file}" for _, file, *_ in CLIPS] + [f"sim/robots/{robot}.pt" for robot in ROBOTS]
        note_picture("fault.gif", *made_of, *(f"results/{robot}/{name}.pt" for robot, *_, name in CLIPS if name))
    if "conditions" in wanted:
        film_conditions()
    if "training" in wanted:
        film_training()
    if "stills" in wanted and (course := course_source()) is not None:
        take_still(course, "course")
    if "drawings" in wanted:
        draw("elements.png", draw_elements())
        draw("loop.png", draw_loop())
        draw("probes.png", draw_probes(), "sim/robots/anymal.xml", "sim/robots/anymal.pt")
        draw("pack.png", draw_pack(), f"{find_pack('anymal').relative_to(Path.cwd())}/pack.npz")
    if "curves" in wanted:
        draw("noise.png", draw_noise(), *(f"results/{robot}/search_noise.json" for robot in ROBOTS))
        curves = [f"results/{robot}/{name}/curve.json" for robot in ROBOTS for name in GROWN]
        draw("growth.png", draw_growth(), *curves)
        archive = "results/cassie/archive_cma_mae"
        draw("axes.png", draw_archive(read_archive(Path(archive))), f"{archive}/archive.npz")
    if "pages" in wanted:
        subprocess.run([sys.executable, "-m", "tests.qd.show.view.browser"], check=True)


if __name__ == "__main__":
    main()
