"""The look at a robot before any work: what it says of robots that are fine, and of those that are not."""

import dataclasses
import re

import pytest

from sim.commands import Stand
from sim.files.command import run_command
from sim.robots.find import get_robot
from sim.robots.stand import describe_model, describe_standing, stand
from tests.sim.dogs import KINDS, LEGS, write_dog


@pytest.fixture(scope="module", params=KINDS)
def dog(request, tmp_path_factory):
    return get_robot(str(write_dog(tmp_path_factory.mktemp("dog"), **KINDS[request.param])))


def test_a_dog_stands_on_its_feet(dog, device):
    found = stand(dog, device=device, drops=8)
    assert found.stands and found.finite and not found.overflowed
    assert set(found.carried) == {f"{leg}_foot" for leg in LEGS}
    assert sum(found.carried.values()) == pytest.approx(1.0, abs=0.03)
    # Thigh and shank of 0.15 m lean by 0.6 rad to either side: soles 0.3 cos 0.6 + 0.025 = 0.2726 m under the hips.
    assert found.gap == pytest.approx(0.29 - 0.2726, abs=1e-3)
    assert found.lowest in dog.foot_geoms
    assert found.height[0] == 0.29 and 0.24 < found.height[1] < 0.29
    assert found.tilt_deg < 2.0 and found.joint_error < 0.1
    assert 1.0 < found.contacts < dog.nconmax and 12 < found.rows <= dog.njmax
    text, fine = describe_standing(dog, found)
    assert fine and text.endswith("It stands.")


def test_who_is_off_the_ground_does_not_stand(dog, device):
    found = stand(dog, device=device, seconds=0.5, drops=1)
    assert found.stands
    assert not dataclasses.replace(found, carried={}).stands
    assert not dataclasses.replace(found, height=(0.29, 0.1)).stands
    assert not dataclasses.replace(found, tilt_deg=16.0).stands


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"default_base_height": 0.2},
            r"To mend: its feet start 0\.07\d m in the ground: .* 0\.29\d is right, got 0\.2",
        ),
        # 0.45 - 0.2726 m
        (
            {"default_base_height": 0.45},
            r"To mend: it starts with its feet 0\.177 m over .* 0\.29\d is right, got 0\.45",
        ),
        ({"default_joint_pos": (0.0, -2.6) * 4}, "in the default pose (F|H)(L|R)_(shank|thigh) is lower than the feet"),
        ({"njmax": 8}, "To mend: a buffer of the solver was too small: raise nconmax and njmax"),
        ({"default_joint_pos": (1.5, -0.1) * 4}, "It does not stand by itself"),
    ],
)
def test_what_has_to_be_mended_is_said(tmp_path, device, change, says):
    robot = dataclasses.replace(get_robot(str(write_dog(tmp_path))), **change)
    text, fine = describe_standing(robot, stand(robot, device=device, seconds=1.0, drops=4))
    assert re.search(says, text)
    assert fine == ("To mend" not in text)


def test_a_biped_falls_and_nothing_is_wrong_with_it(cassie, device):
    found = stand(cassie, device=device, drops=4)
    text, fine = describe_standing(cassie, found)
    assert not found.stands and fine
    assert "A biped may fall" in text and "pelvis" in found.carried


def test_the_height_is_computed_where_the_settings_have_none(tmp_path):
    file = write_dog(tmp_path)
    file.write_text(file.read_text().replace("    default_base_height=0.29,\n", ""))
    # Legs are longest with hips of 0.8 * 0.6 rad, knees of 0.8 * -1.2: soles 0.3 cos 0.48 + 0.025 = 0.2911 m below.
    assert get_robot(str(file)).default_base_height == pytest.approx(0.2911, abs=3e-3)


def test_feet_that_bounce_are_told_and_armature_or_softer_contact_mend_it(tmp_path, device):
    dog = get_robot(str(write_dog(tmp_path, **KINDS["urdf"])))
    bare = dataclasses.replace(dog, armature=(0.0,) * 8)
    found = stand(bare, device=device, drops=1)
    assert found.stands and found.bounce[0] < 0.8 < 1.2 < found.bounce[1]
    assert sum(found.carried.values()) == pytest.approx(1.0, abs=0.1)
    text, fine = describe_standing(bare, found)
    assert re.search(r"To mend: its feet bounce at rest: .* armature .* contact_time_constant_s", text) and not fine
    for mended in (dog, dataclasses.replace(bare, contact_time_constant_s=0.03)):
        assert describe_standing(mended, stand(mended, device=device, drops=1))[1]


def test_shipped_robots_are_in_the_right_units(anymal, cassie):
    assert "Warning" not in describe_model(anymal) + describe_model(cassie)


def run(*argv):
    return run_command(Stand, [*argv, "--device", "cpu"], name="stand")
