"""What robots are asked for: each is called by its name, and only where there is a goal one is drawn."""

from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import Kind, Outcome
from qd.faults.families import rank, summarise_search
from qd.faults.numbers import describe_judgement
from qd.show.crossed import draw_crossing, get_ending, make_title
from qd.show.figures import relief
from qd.show.view.viewed import count_endings, render_rates
from sim.rates import SUCCESS, rate_labels
from sim.recording.renderer import scene_model
from sim.robots.compiled import mj
from sim.terrains.bank import make_terrains
from sim.terrains.maps.picture import places
from sim.terrains.spaces.registry import get_space
from sim.terrains.terrains import asked_of
from tests.builders import judged_archive
from tests.qd.recordings import recording_of

ASKED = {
    "super_gaussian": (Kind.CROSS, "reaches the goal"),
    "super_gaussian+push": (Kind.CROSS, "reaches the goal"),
    "super_gaussian+command": (Kind.ROUTE, "follows its route"),
    "super_gaussian+stand": (Kind.STAND, "stays standing"),
}
GREEN = (0, 158, 115)


@pytest.mark.parametrize("name", ASKED)
def test_what_robots_are_asked_for_has_one_name_everywhere(name, anymal):
    space, (asks, success) = get_space(name), ASKED[name]
    assert SUCCESS[asks] == success
    _, ground = make_terrains(np.zeros((1, space.num_genes), np.float32), space)
    assert asked_of(ground) == space.asks == asks
    recording = replace(recording_of([Outcome.GOAL, Outcome.GOAL, Outcome.STRAYED], [6.0] * 3), ground=ground)
    assert make_title(recording) == f"ANYmal C, made up: {success}, 2 of 3"
    assert get_ending(recording, 1).label == success and get_ending(recording, 2).label == "strays"
    labels = [text.get_text() for text in draw_crossing(recording, "").legends[0].get_texts()]
    assert labels[0] == f"{success} (2)" and ("goal" in labels) == (asks == Kind.CROSS) and "start" in labels
    column = count_endings("here", recording)
    assert column[2] == {"goal_rate": 2, "collision_rate": 0, "other_rate": 1, "fallen_rate": 0}
    assert f"<th>{success}</th>" in render_rates([column], rate_labels(asks))
    known = judged_archive()
    genes = np.zeros((len(known), space.num_genes), np.float32)
    genes[:, :64] = known.genes
    archive = replace(known, genes=genes, space=name)
    ranking = rank(archive, space, half_width=0.4)
    assert ranking.name(4) == f"{success}, 20 of 40" and ranking.ending(4) == (success, "goal_rate")
    assert summarise_search(ranking, archive).startswith("The robot fails 4 of 5 terrains")
    assert all(f": {success}, " in text for text in describe_judgement(archive, 0)[:-1])


@pytest.mark.parametrize("name", ASKED)
def test_a_goal_is_drawn_only_where_there_is_one(name, anymal):
    space, (asks, *_) = get_space(name), ASKED[name]
    heights, ground = make_terrains(np.zeros((1, space.num_genes), np.float32), space)
    has_goal = asks == Kind.CROSS
    assert [*places(asks)] == ["start", "goal"][: 1 + has_goal]
    pixels = relief(heights[0], ground)
    assert (pixels == GREEN).all(axis=-1).any() == has_goal
    model = scene_model(anymal, heights[0], width=64, height=64, ground=ground)
    green = model.geom_bodyid[(model.geom_type == mj.mjtGeom.mjGEOM_CYLINDER) & (model.geom_group == 0)]
    assert len(green[green == 0]) == 2 * has_goal  # a post and a rim, of the world
