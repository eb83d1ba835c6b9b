"""Maps of a user and terrains for other programs: what they read is the ground that robots stand on."""

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
from sim.robots.robot import ROBOTS
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.maps.heightmap import Heightmap, as_terrain, fitted, read_heightmap
from sim.terrains.maps.terrain_files import ExportedTerrain, block_of, check_formats, encode_terrain, write_terrain
from tests.sim.plain_mujoco import rays_from_above

X = SPACING * np.arange(NUM_COLS)
Y = SPACING * np.arange(NUM_ROWS)


def sampled(function, size, nodes):
    """A map of a function of x and y, its middle in the middle of the terrain; nodes along x and along y."""
    x = 8.0 + np.linspace(-0.5, 0.5, nodes[0]) * size[0]
    y = 4.0 + np.linspace(-0.5, 0.5, nodes[1]) * size[1]
    return Heightmap(heights=function(x[None, :], y[:, None]) + np.zeros((nodes[1], nodes[0])), size_m=size)


@pytest.mark.parametrize("nodes", [(2, 2), (17, 33), (321, 161), (97, 401), (801, 1601)])
def test_a_slope_stays_the_slope_whatever_the_nodes_of_the_map(nodes):
    # Linear interpolation and any symmetric mean keep a plane; at the rim a finer map's mean is one-sided, by a cell.
    terrain = as_terrain(sampled(lambda x, y: 0.1 * x - 0.05 * y, (16.0, 8.0), nodes))
    expected = 0.1 * X[None, :] - 0.05 * Y[:, None]
    np.testing.assert_allclose(terrain[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-6)
    np.testing.assert_allclose(terrain, expected, atol=0.002)


def test_a_small_map_is_continued_by_its_edge_and_a_large_one_is_cut_to_its_middle():
    ramp = sampled(lambda x, y: x - 8.0, (4.0, 8.0), (81, 161))
    expected = np.broadcast_to(np.clip(X - 8.0, -2.0, 2.0), (NUM_ROWS, NUM_COLS))
    np.testing.assert_allclose(as_terrain(ramp), expected, atol=1e-6)
    assert "81 x 161 nodes over 4 x 8 m, heights -2.00 to 2.00 m" in fitted(ramp) and "cut" not in fitted(ramp)
    wide = sampled(lambda x, y: 0.1 * (x - 8.0) + 0.2 * (y - 4.0), (40.0, 10.0), (401, 101))
    np.testing.assert_allclose(as_terrain(wide), 0.1 * (X[None, :] - 8) + 0.2 * (Y[:, None] - 4), atol=1e-6)
    assert "16 m along x" in fitted(wide) and "8 m along y" in fitted(wide)


def test_a_finer_map_is_averaged_not_picked_from():
    # Ridges 5 mm apart, every second 1 m high: a node sees their mean, not whichever it happens to lie on.
    comb = np.zeros((161, 3201))
    comb[:, ::2] = 1.0
    np.testing.assert_allclose(as_terrain(Heightmap(heights=comb, size_m=(16.0, 8.0)))[:, 1:-1], 0.5, atol=0.02)


def write_png(path, gray, **meaning):
    Image.fromarray(gray).save(path)
    if meaning:
        path.with_suffix(".json").write_text(json.dumps(meaning))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_an_image_with_its_scale_beside_it_or_given(tmp_path, dtype):
    gray = np.zeros((9, 17), dtype)
    gray[0, 3] = 200  # the topmost row: y = 8 m
    path = tmp_path / "hill.png"
    write_png(path, gray)
    given = read_heightmap(path, size_m=(16, 8), scale_m=0.01, offset_m=-0.5)
    write_png(path, gray, size_m=[16, 8], scale_m=0.02, offset_m=-1.0, colour="of no interest")
    beside = read_heightmap(path)
    mixed = read_heightmap(path, scale_m=0.01)
    for heightmap, scale, offset in ((given, 0.01, -0.5), (beside, 0.02, -1.0), (mixed, 0.01, -1.0)):
        expected = np.full((9, 17), offset)
        expected[8, 3] += 200 * scale
        np.testing.assert_allclose(heightmap.heights, expected)
        assert heightmap.size_m == (16.0, 8.0)
    assert as_terrain(beside)[160, 60] == pytest.approx(3.0)


def test_an_npz_with_its_size_in_it_or_given(tmp_path):
    path, heights = tmp_path / "hill.npz", np.float32([[0, 1, 2], [3, 4, 5]])
    np.savez(path, heights=heights, size_m=[16.0, 8.0])
    assert read_heightmap(path).size_m == (16.0, 8.0)
    np.testing.assert_array_equal(read_heightmap(path).heights, heights)
    assert read_heightmap(path, size_m=(10, 5)).size_m == (10.0, 5.0)
    np.testing.assert_array_equal(read_heightmap(path, scale_m=0.5, offset_m=-1).heights, 0.5 * heights - 1)
    # A JSON beside it belongs to an image of the same name: it must not scale metres.
    (tmp_path / "hill.json").write_text(json.dumps({"scale_m": 0.001, "size_m": [8, 8]}))
    np.testing.assert_array_equal(read_heightmap(path).heights, heights)
    assert read_heightmap(path).size_m == (16.0, 8.0)


GOOD = {"heights": np.zeros((5, 9)), "size_m": np.array([16.0, 8.0])}
GRAY = np.zeros((5, 9), np.uint16)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"heights": None}, "heights"),
        ({"size_m": None}, "size_m"),
        ({"heights": np.zeros((5, 9), complex)}, "heights"),
        ({"heights": np.array([[{}]], dtype=object)}, "npz"),
        ({"heights": np.zeros((1, 5, 9))}, "heights"),
        ({"heights": np.zeros((1, 9))}, "nodes"),
        ({"heights": np.array([[0.0, np.nan], [0.0, np.inf]])}, "2 of 4 heights"),
        ({"heights": np.full((5, 9), -10.5)}, "-10.5"),
        ({"size_m": np.array([16.0, 0.5])}, "size_m"),
        ({"heights": np.zeros((9, 5))}, "swapped"),
        ({"friction": np.ones((4, 8)), "size_m": np.array([8.0, 8.0])}, "friction"),
        ({"gray": GRAY}, "scale_m"),
        ({"gray": GRAY, "scale_m": "1 cm"}, "scale_m"),
        ({"gray": np.zeros((5, 9, 3), np.uint8), "scale_m": 0.1}, "RGB"),
    ],
)
def test_a_mistake_in_a_map_is_named(tmp_path, changes, text):
    path = tmp_path / ("hill.png" if "gray" in changes else "hill.npz")
    if "gray" in changes:
        write_png(path, **{"size_m": [16, 8]} | changes)
    else:
        np.savez(path, **{name: value for name, value in (GOOD | changes).items() if value is not None})
    with pytest.raises(ValueError, match=rf"hill.*{text}"):
        read_heightmap(path)


def test_damaged_and_foreign_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.npz"):
        read_heightmap(tmp_path / "none.npz")
    (tmp_path / "a.tif").write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"a\.tif"):
        read_heightmap(tmp_path / "a.tif")
    np.savez(tmp_path / "a.npz", **GOOD)
    gray = np.random.default_rng(0).integers(0, 9000, (50, 90), np.uint16)
    write_png(tmp_path / "a.png", gray, size_m=[16, 8], scale_m=1e-3)
    for name in ("a.npz", "a.png"):
        read_heightmap(tmp_path / name)
        whole = (tmp_path / name).read_bytes()
        flipped = bytearray(whole)
        flipped[len(whole) // 3] ^= 8
        for content in (whole[: len(whole) // 2], b"hello", b"", bytes(flipped)):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(ValueError, match=name):
                read_heightmap(tmp_path / name)


FLAT = np.full((NUM_ROWS, NUM_COLS), 0.2, np.float32)


@pytest.fixture(scope="module")
def rough():
    """Heights that are different at every node: any turn, mirror image or other cut of the cells is another ground."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (NUM_ROWS, NUM_COLS)).astype(np.float32)


def ray_heights(heights, tmp_path, points):
    """Where rays from above meet the exported scene."""
    path = tmp_path / "terrain.xml"
    path.write_bytes(encode_terrain(ExportedTerrain(heights=heights), "xml"))
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
    scene = mujoco.MjSpec.from_string(encode_terrain(ExportedTerrain(heights=rough, timestep=0.002), "xml").decode())
    model = scene.compile()
    assert model.opt.timestep == 0.002 and model.opt.gravity.tolist() == [0, 0, -9.81] and model.nlight == 1
    assert model.site("start").pos.tolist() == pytest.approx([2, 4, rough[80, 40]])
    assert model.site("goal").pos.tolist() == pytest.approx([14, 4, rough[80, 280]])
    scene = mujoco.MjSpec.from_string(encode_terrain(ExportedTerrain(heights=FLAT), "xml").decode())
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
    whole = np.load(io.BytesIO(encode_terrain(ExportedTerrain(heights=rough), "npy")))
    assert whole.dtype == np.int16 and whole.shape == (NUM_COLS, NUM_ROWS)  # x along the rows
    np.testing.assert_allclose(0.001 * whole[30, 7], rough[7, 30], atol=0.00051)
    with pytest.raises(ValueError, match="npy"):
        encode_terrain(ExportedTerrain(heights=FLAT + 40.0), "npy")


def test_a_mesh_is_a_closed_block_with_the_simulations_surface_on_top(rough):
    small = rough[:9, :13]
    stl = io.BytesIO(encode_terrain(ExportedTerrain(heights=small), "stl"))
    mesh = trimesh.load(stl, file_type="stl", force="mesh")
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
    scene = trimesh.load(io.BytesIO(encode_terrain(ExportedTerrain(heights=heights), "glb")), file_type="glb")
    (mesh,) = scene.geometry.values()
    # 0.6 m along x, -0.5 to 1 m along y, which is up in glTF, and 0.4 m along -z.
    np.testing.assert_allclose(scene.bounds, [[0.0, -0.5, -0.4], [0.6, 1.0, 0.0]], atol=1e-6)
    colors = mesh.visual.vertex_colors[: 9 * 13].reshape(9, 13, 4)
    assert len(np.unique(colors.reshape(-1, 4), axis=0)) == 2 and (colors[:, 5] != colors[:, 6]).any(axis=1).all()


@pytest.mark.parametrize("formats", [[], ["npz", "gif"], ["sdf"]])  # an SDF needs its mesh
def test_unknown_formats_are_refused(formats):
    with pytest.raises(ValueError, match="formats"):
        check_formats(formats)
