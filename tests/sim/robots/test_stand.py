"""The look at a robot before any work: what it says of robots that are fine, and of those that are not."""

import dataclasses

import pytest

from sim.robots.find import get_robot
from sim.robots.stand import describe_model, stand
from tests.sim.dogs import KINDS, LEGS, write_dog


@pytest.mark.parametrize("kind", KINDS)
def test_a_dog_stands_on_its_feet(tmp_path, device, kind):
    dog = get_robot(str(write_dog(tmp_path, **KINDS[kind])))
    standing = stand(dog, device=device, seconds=1.5, drops=4)
    assert standing.stands and standing.finite and not standing.overflowed
    assert set(standing.carried) == {f"{leg}_foot" for leg in LEGS}
    assert sum(standing.carried.values()) == pytest.approx(1.0, abs=0.03)
    assert standing.height[0] == 0.29 and 0.24 < standing.height[1] < 0.29
    assert standing.tilt_deg < 2.0 and standing.joint_error < 0.1
    assert 4 <= standing.contacts < dog.nconmax
    assert not standing.mistakes
    assert standing.describe().endswith("It stands.")
    for change in ({"carried": {}}, {"height": (0.29, 0.1)}, {"tilt_deg": 16.0}, {"finite": False}):
        assert not dataclasses.replace(standing, **change).stands


@pytest.mark.parametrize(
    ("change", "mistake", "parts"),
    [
        # Thigh and shank of 0.15 m lean by 0.6 rad to either side: soles 0.3 cos 0.6 + 0.025 = 0.2726 m under the hips.
        ({"default_base_height": 0.2}, "sunk", ("0.073", "default_base_height 0.29")),
        ({"default_base_height": 0.45}, "falls", ("0.177 m", "default_base_height 0.29")),  # 0.45 - 0.2726 m
        ({"default_joint_pos": (0.0, -2.6) * 4}, "feet are not lowest", ("default pose",)),
        ({"nconmax": 3}, "contacts", ("nconmax",)),
        ({"foot_geoms": ("FL_foot",)}, "weight without a role", ("FR_foot, HL_foot, HR_foot",)),
        ({"armature": (0.0,) * 8}, "bounces", ("armature", "contact_time_constant_s")),
    ],
)
def test_what_has_to_be_mended_is_named(tmp_path, device, change, mistake, parts):
    robot = dataclasses.replace(get_robot(str(write_dog(tmp_path, **KINDS["urdf"]))), **change)
    standing = stand(robot, device=device, seconds=1.5, drops=2)
    assert mistake in standing.mistakes
    text = standing.describe()
    mended = "\n".join(line for line in text.splitlines() if line.startswith("To mend"))
    assert all(part in mended for part in parts) and "biped" not in text
    dead = dataclasses.replace(standing, finite=False)
    assert "not finite" in dead.mistakes and "physics_dt" in dead.describe()


def test_a_biped_falls_and_nothing_is_wrong_with_it(cassie, device):
    standing = stand(cassie, device=device, drops=1)
    assert not standing.stands and "pelvis" in standing.carried and not standing.mistakes
    assert "biped" in standing.describe()


def test_motors_and_delay_are_listed(tmp_path):
    more = "saturation_effort=(35.0,) * 8, velocity_limit=(21.5,) * 8, drive_delay_steps=3,"
    first, heads, *rows = describe_model(get_robot(str(write_dog(tmp_path, more=more)))).splitlines()[1:11]
    assert "3 physics steps" in first and "saturation" in heads
    assert all(row.split()[-2:] == ["35", "21.5"] for row in rows)


def test_shipped_robots_are_in_the_right_units_and_grams_are_not(robot, tmp_path):
    assert "Warning" not in describe_model(robot)
    file = write_dog(tmp_path)
    model = file.with_suffix(".xml")
    model.write_text(model.read_text().replace('mass="8"', 'mass="8000"'))
    assert "kilograms" in describe_model(get_robot(str(file)))
