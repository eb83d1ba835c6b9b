"""The publishers' loops: a dog that stands, states that are fed back, and models without their large files."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from results.make.publishers import PUBLISHERS, Publisher, load_model, load_network, read_mjcf, walk
from tests.sim.dogs import JOINTS, mjcf, urdf


@pytest.fixture
def dog(tmp_path):
    """Its drives hold the default pose, whatever the network says."""
    (tmp_path / "dog.xml").write_text(mjcf())
    (tmp_path / "dog.urdf").write_text(urdf())
    torch.jit.save(torch.jit.script(torch.nn.Linear(3, 8)), tmp_path / "net.pt")
    pose = np.array([0.6, -1.2] * 4)
    return Publisher(tmp_path / "dog.xml", tmp_path / "net.pt", JOINTS, pose, lambda s: s.command, 0.0, 0.005)


@pytest.mark.parametrize("drive", [{}, {"kp": 60.0, "kd": 2.0}, {"suffix": ".urdf", "kp": 60.0, "kd": 2.0}])
def test_a_dog_that_stands_goes_nowhere(dog, drive):
    dog = replace(dog, model=dog.model.with_suffix(drive.pop("suffix", ".xml")), dt=0.002, **drive)
    result = walk(dog, episodes=2, speed=0.75, duration_s=1.0)
    assert result["episodes"] == 2 and result["goal"] == 0.0 and abs(result["speed"]) < 0.3
    assert load_model(dog).opt.timestep == 0.002


def test_states_of_an_onnx_are_fed_back(tmp_path):
    # action = row + h, and it is the next h: 1 2, then 2 4.
    names = ("row", "h", "a", "h_out")
    row, h, action, out = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 2]) for name in names)
    nodes = [helper.make_node("Add", ["row", "h"], ["a"]), helper.make_node("Identity", ["a"], ["h_out"])]
    model = helper.make_model(helper.make_graph(nodes, "net", [row, h], [action, out]), ir_version=8)
    model.opset_import[0].version = 17
    onnx.save(model, tmp_path / "net.onnx")
    network = load_network(tmp_path / "net.onnx")
    assert [network(np.array([1.0, 2.0])).tolist() for _ in range(2)] == [[1.0, 2.0], [2.0, 4.0]]


def test_meshes_that_are_not_there_are_left_out(tmp_path):
    mesh = '<mesh name="hull" file="hull.stl"/>'
    (tmp_path / "dog.xml").write_text(mjcf(trunk='type="mesh" mesh="hull"', asset=mesh))
    spec, missing = read_mjcf(tmp_path / "dog.xml")
    assert len(missing) == 1 and "trunk" not in [geom.name for geom in spec.geoms]


def test_every_controller_has_a_loop_that_says_its_source():
    assert len(PUBLISHERS) >= 12 and all(":" in str(loop.func.__doc__) for loop in PUBLISHERS.values())
