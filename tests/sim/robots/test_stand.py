"""The look at a robot before any work: what it says of robots that are fine, and of those that are not."""

import dataclasses
import re

import pytest

from sim.commands import Stand
from sim.files.command import run_command
from sim.robots.find import get_robot
from sim.robots.stand import describe_model, describe_standing, stand
from tests.sim.dogs import GAINS, KINDS, LEGS, MASS, urdf, write_dog


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


def test_what_was_read_is_listed(dog):
    text = describe_model(dog)
    assert f"{MASS:.2f} kg in 9 bodies, 8 joints, 51 observations" in text
    rows = {line.split()[0]: line.split() for line in text.splitlines()[3:]}
    assert rows["HR_knee"] == ["HR_knee", "-1.200", "-2.60", "to", "-0.10", "60", "2", "30", "0.01"]
    assert rows["FL_foot"][:3] == ["FL_foot", "foot", "FL_shank"]
    assert rows["trunk"][1] == "base" and rows["HL_thigh"][1] == "limb"


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


IN_CM = re.sub(
    r'(xyz|size|radius|length)="([^"]*)"',
    lambda found: (
        found[0]
        if found[2] == "0 1 0"  # an axis
        else f'{found[1]}="{" ".join(str(20 * float(word)) for word in found[2].split())}"'
    ),
    urdf(),
)
IN_DEGREES = (
    urdf().replace('"-1.5" upper="2.5"', '"-86" upper="143"').replace('"-2.6" upper="-0.1"', '"-149" upper="-6"')
)


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "says"),
    [
        (IN_CM, r"it reaches [6-9]\.\d* m from its base: are lengths in the model in metres"),  # 20 times 0.41 m
        (urdf().replace('mass value="', 'mass value="100'), r"it weighs 1\.\d*e\+04 kg.*in kilograms"),
        (urdf().replace('ixx="0.03"', 'ixx="300"'), r"gyration of trunk \(6\.12 m\)"),  # sqrt(300 / 8)
        (IN_DEGREES, r"default_joint_pos is beyond a full turn for FL_hip \(34\), FL_knee \(-69\).*radians"),
        (IN_DEGREES, r"joints turn by more than two full turns: FL_hip \(-86 to 143\).*radians"),
    ],
    ids=["cm", "g", "inertia", "pose", "limits"],
)
def test_other_units_are_warned_of_with_the_numbers(tmp_path, model, says):
    file = write_dog(tmp_path, model=model, suffix="urdf", more=GAINS)
    if model == IN_DEGREES:
        file.write_text(file.read_text().replace("(0.6, -1.2)", "(34.0, -69.0)"))
    assert re.search(f"Warning: .*{says}", describe_model(get_robot(str(file))))


def test_shipped_robots_are_in_the_right_units(anymal, cassie):
    assert "Warning" not in describe_model(anymal) + describe_model(cassie)


def run(*argv):
    return run_command(Stand, [*argv, "--device", "cpu"], name="stand")


def test_the_command(tmp_path, capsys):
    file = write_dog(tmp_path)
    assert run("--robot", str(file), "--seconds", "1", "--drops", "2") == 0
    assert capsys.readouterr().out.endswith("It stands.\n")
    file.write_text(file.read_text().replace("0.29", "0.2"))
    assert run("--robot", str(file), "--seconds", "1", "--drops", "2") == 1
    file.write_text(file.read_text().replace('"hip"', '"hop"'))
    assert run("--robot", str(file)) == 2
    assert "no joint named FL_hop, FR_hop, HL_hop, HR_hop in" in capsys.readouterr().err
    assert run("--robot", "anymal", "--drops", "0") == 2
