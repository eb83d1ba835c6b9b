"""Terrains for other programs: what they read is the ground that the robots of the simulation stand on."""

import io
import json
import warnings
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from sim.mujoco_c.model import surface_heights
from sim.robots.shipped import ROBOTS
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.maps.heightmap import as_terrain, read_heightmap
from sim.terrains.maps.terrain_files import FORMATS, ExportedTerrain, block_of, check_formats, write_terrain
from tests.sim.plain_mujoco import rays_from_above

FLAT = np.full((NUM_ROWS, NUM_COLS), 0.2, np.float32)


@pytest.fixture(scope="module")
def rough():
    """Heights that are different at every node: any turn, mirror image or other cut of the cells is another ground."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (NUM_ROWS, NUM_COLS)).astype(np.float32)


def ray_heights(heights, tmp_path, points):
    """Where rays from above meet the exported scene."""
    path = tmp_path / "terrain.xml"
    path.write_bytes(FORMATS["xml"](ExportedTerrain(heights=heights)))
    return rays_from_above(mujoco.MjModel.from_xml_path(str(path)), points)[0]


def test_rays_meet_the_exported_scene_where_the_simulations_surface_is(rough, tmp_path):
    rng, limits = np.random.default_rng(1), np.array([NUM_COLS - 1, NUM_ROWS - 1])
    halves = rng.integers(2, 2 * limits - 1, (600, 2)) / 2 + 1e-3  # beside nodes, middles of cell edges and of cells
    places = SPACING * np.concatenate([halves, rng.uniform(0.01, limits - 0.01, (200, 2))])  # a ray may miss an edge
    expected = surface_heights(rough, *np.transpose(places))
    np.testing.assert_allclose(ray_heights(rough, tmp_path, places), expected, atol=1e-4)
    # The corners by name: x along the course, y across it.
    corners = [(1e-3, 1e-3), (15.999, 1e-3), (1e-3, 7.999), (15.999, 7.999)]
    expected = [rough[0, 0], rough[0, -1], rough[-1, 0], rough[-1, -1]]
    np.testing.assert_allclose(ray_heights(rough, tmp_path, corners), expected, atol=0.05)
    # Flat ground has no range, where a size may not be 0.
    assert ray_heights(FLAT, tmp_path, [(8.0, 4.0)]) == pytest.approx([0.2], abs=1e-5)


def test_a_scene_has_the_simulations_options_and_takes_its_robots(rough):
    scene = mujoco.MjSpec.from_string(FORMATS["xml"](ExportedTerrain(heights=rough, timestep=0.002)).decode())
    model = scene.compile()
    assert model.opt.timestep == 0.002 and model.opt.gravity.tolist() == [0, 0, -9.81] and model.nlight == 1
    assert model.site("start").pos.tolist() == pytest.approx([2, 4, rough[80, 40]])
    assert model.site("goal").pos.tolist() == pytest.approx([14, 4, rough[80, 280]])
    scene = mujoco.MjSpec.from_string(FORMATS["xml"](ExportedTerrain(heights=FLAT)).decode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of options that differ
        robot = mujoco.MjSpec.from_file(str(ROBOTS["anymal"].model_file))
        scene.attach(robot, prefix="robot/", frame=scene.worldbody.add_frame(pos=(2, 4, 0.25)))
    model = scene.compile()
    data = mujoco.MjData(model)
    for _ in range(100):
        mujoco.mj_step(model, data)
    assert 0.2 < data.xpos[1, 2] - 0.2 < 0.7  # it has come down on the ground, and not through it


def test_an_image_of_flat_ground_reads_back_and_says_where_it_lies(tmp_path):
    terrain = ExportedTerrain(heights=FLAT, name="a")
    (path, _) = write_terrain(tmp_path, terrain, formats=["png"], about={"robot": "anymal"})
    meaning = json.loads((tmp_path / "a.json").read_text())
    assert meaning["size_m"] == pytest.approx([16, 8]) and meaning["nodes"] == [161, 321]
    assert meaning["robot"] == "anymal" and meaning["goal"] == pytest.approx([14, 4, 0.2])
    assert meaning["scale_m"] == pytest.approx(1e-3 / 65535) and np.asarray(Image.open(path)).dtype == np.uint16
    np.testing.assert_allclose(as_terrain(read_heightmap(path)), FLAT, rtol=0, atol=1e-6)


def test_an_sdf_is_a_static_model_of_the_mesh(rough, tmp_path):
    write_terrain(tmp_path, ExportedTerrain(heights=rough, name="elite-0.1"), formats=["stl", "sdf"], about={})
    model = ET.parse(tmp_path / "elite-0.1.sdf").getroot().find("model")
    assert model.get("name") == "elite-0.1" and model.findtext("static") == "true"
    uris = [model.findtext(f"link/{part}/geometry/mesh/uri") for part in ("collision", "visual")]
    assert uris == ["elite-0.1.stl"] * 2


def test_an_npy_is_what_terrain_generators_hold(rough):
    whole = np.load(io.BytesIO(FORMATS["npy"](ExportedTerrain(heights=rough))))
    assert whole.dtype == np.int16 and whole.shape == (NUM_COLS, NUM_ROWS)  # x along the rows
    np.testing.assert_allclose(0.001 * whole[30, 7], rough[7, 30], atol=0.00051)
    with pytest.raises(ValueError, match="npy"):
        FORMATS["npy"](ExportedTerrain(heights=FLAT + 40.0))


def test_a_mesh_is_a_closed_block_with_the_simulations_surface_on_top(rough):
    small = rough[:9, :13]
    mesh = trimesh.load(io.BytesIO(FORMATS["stl"](ExportedTerrain(heights=small))), file_type="stl", force="mesh")
    assert mesh.is_watertight and mesh.is_winding_consistent
    # The volume between the terrain and the bottom, half a metre below its lowest point.
    cells = [small[:-1, :-1], small[:-1, 1:], small[1:, :-1], small[1:, 1:]]
    ends, cut = (cells[0] + cells[3]).astype(float), (cells[1] + cells[2]).astype(float)
    above = SPACING**2 * ((ends + 2 * cut) / 6 - small.min() + 0.5).sum()
    assert mesh.volume == pytest.approx(above, rel=1e-4)
    top = block_of(rough).triangles[: 2 * (NUM_ROWS - 1) * (NUM_COLS - 1)]
    for x, y, z in top.mean(axis=1)[::997]:
        assert z == pytest.approx(surface_heights(rough, x, y), abs=1e-6)


def test_a_glb_stands_upright_and_is_coloured_by_height():
    heights = np.zeros((9, 13), np.float32)
    heights[:, 6:] = 1.0
    scene = trimesh.load(io.BytesIO(FORMATS["glb"](ExportedTerrain(heights=heights))), file_type="glb")
    (mesh,) = scene.geometry.values()
    # 0.6 m along x, -0.5 to 1 m along y, which is up in glTF, and 0.4 m along -z.
    np.testing.assert_allclose(scene.bounds, [[0.0, -0.5, -0.4], [0.6, 1.0, 0.0]], atol=1e-6)
    colors = mesh.visual.vertex_colors[: 9 * 13].reshape(9, 13, 4)
    assert len(np.unique(colors.reshape(-1, 4), axis=0)) == 2 and (colors[:, 5] != colors[:, 6]).any(axis=1).all()


@pytest.mark.parametrize("formats", [[], ["npz", "gif"], ["sdf"]])  # an SDF needs its mesh
def test_unknown_formats_are_refused(formats):
    with pytest.raises(ValueError, match="formats"):
        check_formats(formats)
