"""Pushes on links, against plain MuJoCo C, against momentum, and as conditions of a terrain."""

import dataclasses

import numpy as np
import pytest

from sim.robots.compiled import number_links, robot_spec
from sim.robots.find import get_robot
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS
from sim.terrains.spaces.registry import load_space
from sim.terrains.terrains import GroundMaps
from tests.sim.dogs import write_dog
from tests.sim.scenes import fall, free_body, mean_velocity, rows_of

SPACE = load_space("super_gaussian+pushes")
LINKS = 6
SIZE, BEGIN, STEPS = (0.12, -0.16), 2, 20
"""Of the pushes here [m/s]; the physics step in which they begin, and how many they last."""


def push(link, number=1, seconds=BEGIN * 0.005):
    values = {"x": SIZE[0], "y": SIZE[1], "time": seconds, "link": link}
    return {f"push_{number}_{name}": value for name, value in values.items()}


def test_a_push_on_each_link_is_that_of_mujoco_c(robot, device):
    links = range(-LINKS, LINKS + 1)
    loaded = {"payload": 0.2, "payload_x": 0.1, "payload_y": -0.1}
    rows = rows_of({}, loaded, *(push(link) for link in links), loaded | push(0), push(2) | push(-3, number=3))
    (before, _), (after, theirs) = fall(robot, rows, (BEGIN, BEGIN + STEPS), device)
    without = np.array([0] * len(links) + [1, 0])
    np.testing.assert_array_equal(before.qvel[2:], before.qvel[without])  # not before its time
    ours, plain = (states.qvel[2:] - states.qvel[without] for states in (after, theirs))
    sizes = np.linalg.norm(plain, axis=1)
    assert (np.linalg.norm(ours - plain, axis=1) < 1e-3 * sizes).all()
    apart = np.linalg.norm(plain[:, None] - plain, axis=2) + np.diag(sizes)
    assert apart.min() > 0.02  # each link is another one


def test_a_push_gives_its_impulse_in_a_tenth_of_a_second_whatever_the_step(robot):
    fine = dataclasses.replace(robot, physics_dt=0.001, decimation=20)
    rows = rows_of({}, push(0), push(-LINKS), push(3, number=2, seconds=0.02))
    for made, both in zip((10, 60, 130), fall(fine, rows, (10, 60, 130)), strict=True):
        share = np.clip((made - np.array([10, 10, 20])) / 100, 0.0, 1.0)  # of the 100 steps of each
        for moved in (mean_velocity(fine, states) for states in both):
            np.testing.assert_allclose(moved[1:] - moved[0], share[:, None] * [*SIZE, 0.0], atol=1.5e-3)


def test_links_are_numbered_from_the_base_on_by_their_side(anymal, tmp_path):
    model = robot_spec(anymal).compile()
    names = [model.body(body).name for body in number_links(anymal)]
    left = [f"L{leg}_{part}" for leg in "FH" for part in ("HIP", "THIGH", "SHANK")]
    assert names[LINKS:] == ["base", *left]
    assert names[:LINKS] == [name.replace("L", "R", 1) for name in reversed(left)]
    dog = get_robot(str(write_dog(tmp_path)))  # four links a side: two thighs and two shanks
    assert number_links(dog).tolist() == [9, 9, 8, 5, 5, 4, 1, 2, 3, 3, 6, 7, 7]
    assert number_links(free_body(tmp_path / "ball", 'type="sphere" size="0.1"', mass=1.0)).tolist() == [1] * 13


def test_pushes_are_three_parts_of_a_terrain():
    assert SPACE.conditions == GROUPS["pushes"] and SPACE.name == "super_gaussian+push_1+push_2+push_3"
    genes = np.zeros((1, SPACE.num_genes), np.float32)
    assert SPACE.condition_text(genes[0]) == "nominal conditions"
    values = {"push_1_x": 1.2, "push_1_y": 0.4, "push_1_time": 5.2, "push_1_link": -5}
    genes[0, 64:68], genes[0, 68:72] = (CONDITIONS[f"push_{k}"].to_genes({"push_2_y": -0.6} | values) for k in (1, 2))
    texts = (
        "pushed by 1.2 m/s ahead and 0.4 m/s to the left at link 5 of 6 on the right after 5.2 s",
        "pushed by 0.6 m/s to the right at the base after 6.0 s",
    )
    assert SPACE.parts(genes[0])[-3:] == (*texts, "no push_3")
    assert SPACE.condition_text(SPACE.without(genes, [8])[0]) == texts[1]
    signs = np.array([-1.0 if gene.mirrored else 1.0 for gene in CONDITIONS["push_1"].genes])
    mirrored = CONDITIONS["push_1"].text(signs * [*values.values()])
    assert mirrored == "pushed by 1.2 m/s ahead and 0.4 m/s to the right at link 5 of 6 on the left after 5.2 s"
    with pytest.raises(ValueError, match="push_2_link"):
        dataclasses.replace(GroundMaps.plain(1), conditions=rows_of(push(7, number=2)))
