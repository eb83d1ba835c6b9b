"""Files of a robot's model are found by what names them."""

import pytest

from sim.robots.find import get_robot
from sim.robots.model_files import find_above, read_model_files
from tests.sim.dogs import mjcf

URDF = """<robot name="dog"><link name="trunk"><collision><geometry><mesh filename="package://dog_description/trunk.stl"/>
</geometry></collision></link></robot>"""


@pytest.mark.parametrize(
    ("name", "folder", "file"),
    [
        ("{LEGGED_GYM_ROOT_DIR}/a/policy.pt", "lab/b/c", "lab/a/policy.pt"),
        ("models/policy.pt", "lab/configs", "lab/models/policy.pt"),
        ("package://dog/meshes/trunk.stl", "lab/cat/urdf", "lab/dog/meshes/trunk.stl"),
        ("package://dog/meshes/trunk.stl", "a_dog/urdf", "a_dog/meshes/trunk.stl"),
        ("policy.pt", "lab/b", None),  # of a folder above it may be any other
        ("{ROOT}/a/policy.pt", "lab/b", None),
    ],
)
def test_what_stands_for_a_folder_is_looked_for_in_folders_above(tmp_path, name, folder, file):
    for path in (f"{folder}/readme.md", "lab/policy.pt", *filter(None, [file])):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert find_above(name, tmp_path / folder) == (file and tmp_path / file)


def test_a_mesh_of_a_package_is_among_the_files_of_a_model(tmp_path):
    model, mesh = tmp_path / "urdf" / "dog.urdf", tmp_path / "dog_description" / "trunk.stl"
    for file in (model, mesh):
        file.parent.mkdir()
        file.write_text(URDF)
    assert read_model_files(model).files == (model, mesh)


def test_a_robot_of_the_menagerie_is_known_by_its_name(tmp_path, monkeypatch):
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))  # a checkout, from which nothing is downloaded
    model, settings = tmp_path / "unitree_go2" / "go2.xml", tmp_path / "robot.toml"
    model.parent.mkdir()
    model.write_text(mjcf())
    settings.write_text('name = "dog"\nmodel_file = "menagerie:unitree_go2"')
    assert get_robot(str(settings)).model_file == model
    for name, named in (("unitree_go3", "unitree_go2"), ("unitree_go2/go3", "go2_mjx"), ("unitree_a1", "unitree_a1")):
        settings.write_text(f'model_file = "menagerie:{name}"')
        with pytest.raises(ValueError, match=named):
            get_robot(str(settings))
