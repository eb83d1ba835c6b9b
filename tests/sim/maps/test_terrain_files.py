"""Terrains for other programs: what they read is the ground that the robots of the simulation stand on."""

import io
import json
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
from PIL import Image

from sim.bank import heights_of
from sim.maps.heightmap import as_terrain, read_heightmap
from sim.maps.terrain_files import FORMATS, as_hfield, gray_scale, mjcf_of, png_of, stl_of, triangles_of, write_terrain
from sim.mujoco_c.model import surface_heights
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING
from tests.kernels import oracle

FLAT = np.full((NUM_ROWS, NUM_COLS), 0.2, np.float32)


@pytest.fixture(scope="module")
def hill():
    return heights_of(SUPER_GAUSSIAN.hard_random(1, 4))[0]


@pytest.fixture(scope="module")
def rough():
    """Heights that are different at every node: any turn, mirror image or other cut of the cells is another ground."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (NUM_ROWS, NUM_COLS)).astype(np.float32)


def loaded(heights, tmp_path):
    path = tmp_path / "terrain.xml"
    path.write_bytes(mjcf_of(heights))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def ray_height(model, data, x, y):
    geom = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(model, data, np.array([x, y, 5.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
    assert geom[0] == model.geom("terrain").id
    return 5.0 - distance


def points(heights, count, seed):
    """Nodes, middles of cell edges, middles of cells, and anywhere else; not on the rim, which a ray may miss."""
    rng = np.random.default_rng(seed)
    limits = [heights.shape[1] - 1, heights.shape[0] - 1]
    nodes = rng.integers(1, limits, (count, 2)).astype(float)
    shifts = [(0, 0), (0.5, 0), (0, 0.5), (0.5, 0.5), (0.25, 0.25), (0.75, 0.75)]
    anywhere = rng.uniform(0.01, np.array(limits) - 0.01, (2 * count, 2))
    return SPACING * np.concatenate(
        [*(np.minimum(nodes + shift, np.array(limits) - 0.01) for shift in shifts), anywhere]
    )


@pytest.mark.parametrize("ground", ["hill", "rough"])
def test_rays_meet_the_exported_scene_where_the_simulations_surface_is(request, tmp_path, ground):
    heights = request.getfixturevalue(ground)
    model, data = loaded(heights, tmp_path)
    for x, y in points(heights, 100, 1):
        assert ray_height(model, data, x, y) == pytest.approx(oracle.surface_height(heights, SPACING, x, y), abs=1e-4)
    # The corners by name: x along the course, y across it.
    for x, y, row, col in [(1e-3, 1e-3, 0, 0), (15.999, 1e-3, 0, -1), (1e-3, 7.999, -1, 0), (15.999, 7.999, -1, -1)]:
        assert ray_height(model, data, x, y) == pytest.approx(heights[row, col], abs=0.05)
    assert model.nbody == 1 and model.nhfield == 1


def test_contacts_with_the_exported_scene_are_with_the_same_surface(rough, tmp_path):
    """A fine point over the middle of a cell: its distance to the ground tells along which diagonal the cell is cut."""
    rough = 0.1 * rough
    root = ET.fromstring(mjcf_of(rough))
    body = ET.SubElement(root.find("worldbody"), "body", name="probe")
    ET.SubElement(body, "freejoint")
    ET.SubElement(body, "geom", name="probe", type="sphere", size="1e-4", mass="1", margin="0.01")
    ET.SubElement(root, "size", memory="16M")
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    apart = []
    for _ in range(20):
        row, col = rng.integers(5, 150, 2)
        x, y = SPACING * (col + 0.5), SPACING * (row + 0.5)
        height = oracle.surface_height(rough, SPACING, x, y)
        data.qpos[:3] = x, y, height + 0.002
        mujoco.mj_forward(model, data)
        found = min(contact.dist for contact in data.contact) + 1e-4
        expected = oracle.nearest_on_surface(rough, SPACING, (x, y, height + 0.002), 0.1)[0]
        assert found == pytest.approx(expected, abs=2e-4)
        other_cut = rough[row : row + 2, col : col + 2]
        apart.append(abs(other_cut[0, 0] + other_cut[1, 1] - other_cut[0, 1] - other_cut[1, 0]) / 2)
    assert np.median(apart) > 0.01  # or the test could not tell


def test_flat_ground_is_exported_too(tmp_path):
    for heights in (FLAT, FLAT + np.eye(NUM_ROWS, NUM_COLS, dtype=np.float32) * 1e-4):
        model, data = loaded(heights, tmp_path)
        for x, y in [(0.5, 0.5), (8.0, 4.0), (3.025, 3.0)]:
            assert ray_height(model, data, x, y) == pytest.approx(float(surface_heights(heights, x, y)), abs=1e-5)


def test_a_margin_continues_the_edge(rough):
    plain, wide = as_hfield(rough), as_hfield(rough, margin=10)
    assert wide.data.shape == (NUM_COLS + 20, NUM_ROWS + 20)
    np.testing.assert_array_equal(wide.data[10:-10, 10:-10], plain.data)
    assert (wide.data[:10, 10:-10] == plain.data[0]).all()
    assert wide.position == plain.position
    assert wide.size[:2] == pytest.approx((4.5, 8.5))


@pytest.mark.parametrize("heights", ["hill", "rough", "flat"])
def test_an_image_reads_back_within_half_a_gray_level(request, tmp_path, heights):
    heights = FLAT if heights == "flat" else request.getfixturevalue(heights)
    (path, _) = write_terrain(tmp_path / "a", heights, formats=["png"], about={"robot": "anymal"})
    meaning = json.loads((tmp_path / "a.json").read_text())
    gray = np.asarray(Image.open(path))
    assert gray.dtype == np.uint16 and gray.shape == (NUM_ROWS, NUM_COLS)
    scale = meaning["scale_m"]
    assert scale == gray_scale(heights)[0] and scale <= max(np.ptp(heights), 1e-3) / 65535
    read = meaning["offset_m"] + scale * gray[::-1].astype(np.float64)  # the topmost row is the highest y
    np.testing.assert_allclose(read, heights, rtol=0, atol=0.5 * scale * (1 + 1e-6))
    assert meaning["size_m"] == pytest.approx([16, 8]) and meaning["nodes"] == [161, 321]
    assert meaning["robot"] == "anymal"
    # Our own reader says the same.
    np.testing.assert_allclose(as_terrain(read_heightmap(path)), heights, rtol=0, atol=0.51 * scale + 1e-7)


def test_an_image_shows_the_terrain_as_seen_from_above():
    heights = FLAT.copy()
    heights[-1, 0] = 1.0  # y = 8 m, x = 0: the upper left corner
    gray = np.asarray(Image.open(io.BytesIO(png_of(heights))))
    assert gray[0, 0] == 65535 and gray.sum() == 65535


def test_an_npz_is_the_grid_itself(hill, tmp_path):
    genes = SUPER_GAUSSIAN.hard_random(1, 4)[0]
    paths = write_terrain(tmp_path / "elite-0.1", hill, formats=list(FORMATS), about={}, genes=genes)
    assert [path.name for path in paths] == [f"elite-0.1.{ending}" for ending in ("npz", "png", "xml", "stl", "json")]
    with np.load(paths[0]) as content:
        np.testing.assert_array_equal(content["heights"], hill)
        np.testing.assert_array_equal(content["genes"], genes)
    np.testing.assert_array_equal(as_terrain(read_heightmap(paths[0])), hill)


def read_stl(data):
    count = int(np.frombuffer(data, "<u4", 1, 80)[0])
    assert len(data) == 84 + 50 * count
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(data, record, count, 84)


def test_an_stl_is_a_closed_block_with_the_terrain_on_top(rough):
    small = rough[:9, :13]
    records = read_stl(stl_of(small))
    corners = records["corners"].astype(np.float64)
    # Closed: every edge is walked once in each direction.
    walked = {}
    for triangle in np.round(corners, 6):
        ring = [tuple(corner) for corner in triangle]
        for k in range(3):
            edge = ring[k], ring[(k + 1) % 3]
            walked[edge] = walked.get(edge, 0) + 1
    assert set(walked.values()) == {1}
    assert all((end, start) in walked for start, end in walked)
    # Outside out: the volume is that between the terrain and the bottom, half a metre below its lowest point.
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    cells = [small[:-1, :-1], small[:-1, 1:], small[1:, :-1], small[1:, 1:]]
    ends, cut = (cells[0] + cells[3]).astype(float), (cells[1] + cells[2]).astype(float)
    above = SPACING**2 * ((ends + 2 * cut) / 6 - small.min() + 0.5).sum()
    assert volume == pytest.approx(above, rel=1e-4)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(records["normal"], normals, atol=2e-3)
    assert (records["normal"][: 2 * 8 * 12, 2] > 0).all()


def test_the_top_of_an_stl_is_the_simulations_surface(rough):
    top = triangles_of(rough)[: 2 * (NUM_ROWS - 1) * (NUM_COLS - 1)]
    middles = top.mean(axis=1)[::997]
    for x, y, z in middles:
        assert z == pytest.approx(oracle.surface_height(rough, SPACING, x, y), abs=1e-6)
    np.testing.assert_array_equal(
        np.unique(np.round(top[..., :2].reshape(-1, 2), 6), axis=0).shape, (NUM_ROWS * NUM_COLS, 2)
    )


@pytest.mark.parametrize("formats", [["obj"], [], ["npz", "gif"]])
def test_unknown_formats_are_refused(tmp_path, formats):
    with pytest.raises(ValueError, match="formats must be some of npz, png, xml, stl, got"):
        write_terrain(tmp_path / "a", FLAT, formats=formats, about={})
    assert list(tmp_path.iterdir()) == []
