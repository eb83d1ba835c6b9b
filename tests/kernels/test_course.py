"""Courses against a NumPy builder, and every element by numbers worked out by hand."""

import numpy as np
import pytest
import warp as wp

from kernels.course import (
    MAX_ELEMENTS,
    PARAMETERS,
    Element,
    Kind,
    lay_out,
    place,
    rasterise,
    rasterise_elements,
)
from tests.kernels import course_oracle as oracle
from tests.kernels.course_oracle import course, element


def heights_of(genes, device):
    out = wp.zeros((len(genes), 161, 321), dtype=float, device=device)
    rasterise(wp.array(np.float32(genes), device=device), 0.05, out)
    return out.numpy()


@pytest.fixture
def way(device):
    """Heights along y = 4 m of a course of some elements, by the node from x = 4 m on."""
    return lambda *elements: heights_of(course(*elements), device)[0, 80, 80:]


def test_the_ranges_are_those_of_the_oracle():
    assert [kind.name.lower() for kind in Kind] == list(oracle.KINDS) == list(oracle.RANGES)
    for kind, ranges in PARAMETERS.items():
        for own, span in zip(ranges, oracle.RANGES[kind.name.lower()], strict=True):
            assert (own.low, own.high) == (span["whole"] if own.whole else span)
            assert own.whole == isinstance(span, dict)


@pytest.mark.parametrize("seed", range(3))
def test_courses_equal_the_builders(device, seed):
    genes = np.random.default_rng(seed).uniform(-1.2, 1.2, (40, 36)).astype(np.float32)
    genes[:4] = np.sign(genes[:4])
    found = heights_of(genes, device)
    for row, grid in zip(genes, found, strict=True):
        np.testing.assert_allclose(grid, oracle.heights(row), atol=5e-6)
    laid = lay_out(wp.array(genes, device=device)).numpy()["kind"]
    assert seed or len(np.unique(laid)) == len(Kind)  # every kind is among them


@pytest.mark.parametrize("kind", oracle.KINDS)
def test_start_and_goal_lie_on_flat_ground(device, kind):
    genes = np.tile(np.ones(36, np.float32), (1, 1)).reshape(6, 6)
    genes[:, 0] = element(kind)[0]
    grid = heights_of(genes.reshape(1, 36), device)[0]
    assert not grid[:, :81].any()  # x <= 4 m
    assert np.ptp(grid[:, 240:]) == 0.0  # x >= 12 m


def test_a_kerb_is_a_face_between_two_nodes(way):
    # Flat ground of 5 cells, 0.25 m: the face stands between x = 4.25 m and x = 4.30 m.
    up = way(element("kerb", lead=5, size=0.15, turn=1))
    assert up[:6].tolist() == [0] * 6 and up[6:] == pytest.approx(0.15)
    down = way(element("kerb", lead=5, size=0.15, turn=-1))
    assert down[6:] == pytest.approx(-0.15)


def test_stairs_have_their_risers_at_the_nearest_nodes(way):
    # Treads of 0.28 m are 5.6 cells: risers 0, 6 (5.6), 11 (11.2) cells behind the first, which stands at 0.2 m.
    ground = way(element("stairs", size=0.18, length=0.28, detail=3, turn=1))
    assert ground[:5] == pytest.approx(0.0)
    assert ground[5:11] == pytest.approx(0.18) and ground[11:16] == pytest.approx(0.36)
    assert ground[16:] == pytest.approx(0.54)
    down = way(element("stairs", size=0.18, length=0.28, detail=3, turn=-1))
    assert down == pytest.approx(-ground)


def test_a_ramp_rises_evenly(way):
    # 1:4 over 24 cells, 1.2 m: 0.3 m; half of it after 12 cells.
    ground = way(element("ramp", size=0.25, length=24, turn=1))
    assert (ground[4], ground[16], ground[28], ground[240]) == pytest.approx((0.0, 0.15, 0.3, 0.3), abs=1e-6)


def test_a_cross_slope_tilts_the_way_and_goes_back(device):
    # 1:4 over 36 cells: grows over 12, stays for 12. Left of the way is up; 2 m beside it and farther 0.5 m.
    grid = heights_of(course(element("cross_slope", size=0.25, length=36, turn=1)), device)[0]
    assert grid[[80, 100, 120, 160, 40], 84 + 18] == pytest.approx((0.0, 0.25, 0.5, 0.5, -0.5))
    assert grid[100, [84, 84 + 6, 84 + 12, 84 + 24, 84 + 36]] == pytest.approx((0.0, 0.125, 0.25, 0.25, 0.0))


def test_what_stands_on_the_ground_has_a_top_of_its_length(way):
    sill = way(element("sill", size=0.1, length=2))  # faces of one cell, a top of 0.1 m between nodes 5 and 7
    assert sill[:10] == pytest.approx([0] * 5 + [0.1] * 3 + [0] * 2)
    rail = way(element("rail", size=0.1, length=0))  # a ridge
    assert rail[:8] == pytest.approx([0] * 5 + [0.1] + [0] * 2)
    pallets = way(element("pallet", size=0.144, length=24, detail=2))  # 1.2 m, two on each other
    assert (
        pallets[:5] == pytest.approx(0.0)
        and pallets[5:30] == pytest.approx(0.288)
        and pallets[30:] == pytest.approx(0.0)
    )


def test_a_ditch_is_as_wide_as_it_opens(way):
    ditch = way(element("ditch", size=0.4, length=6))  # 0.3 m: banks at nodes 4 and 10
    assert ditch[:12] == pytest.approx([0] * 5 + [-0.4] * 5 + [0] * 2)


def test_a_beam_lies_over_its_ditch(device):
    # 0.4 m wide, its middle 0.25 m left of the way: y = 4.05 m to 4.45 m, rows 81 to 89.
    grid = heights_of(course(element("bridge", size=0.5, length=20, detail=8, turn=5)), device)[0]
    across = grid[:, 84 + 10]
    assert np.flatnonzero(across == 0.0).tolist() == list(range(81, 90))
    assert across[[0, 80, 90, 160]] == pytest.approx(-0.5)


def test_stepping_stones(device):
    # Stones of 0.2 m, 0.1 m apart: after a gap of 2 cells one of 4, and so on; the first lies on rows 78 to 82.
    grid = heights_of(course(element("stones", size=0.3, length=20, detail=4, turn=2)), device)[0]
    along = grid[80, 84 : 84 + 21]
    assert along[:8] == pytest.approx([0, -0.3, 0, 0, 0, 0, 0, -0.3])
    assert np.flatnonzero(grid[76:85, 84 + 3] == 0.0).tolist() == [0, 2, 3, 4, 5, 6, 8]
    assert grid[80, 84 + 10] == pytest.approx(-0.3)  # the next ones are moved by half of 0.3 m: rows 81 to 85
    assert grid[83, 84 + 10] == 0.0


def test_rubble_is_of_blocks(device):
    grid = heights_of(course(element("rubble", size=0.2, length=40, detail=4, turn=0.1)), device)[0]
    field = grid[:160, 85:121]  # nine blocks of four nodes, which are of one height each
    blocks = field.reshape(40, 4, 9, 4)
    assert np.ptp(blocks, axis=(1, 3)).max() == 0.0
    assert blocks.min() >= 0.0 and 0.15 < blocks.max() <= 0.2
    assert 0.08 < blocks.mean() < 0.12


def test_ground_goes_on_where_an_element_ends(way):
    # Up 0.2 m, 2 stairs of 0.15 m down, a ditch in the ground that is 0.1 m below the start.
    ground = way(
        element("step", size=0.2, turn=1),
        element("stairs", size=0.15, length=0.25, detail=2, turn=-1),
        element("ditch", size=0.3, length=4),
    )
    assert ground[5] == pytest.approx(0.2) and ground[-1] == pytest.approx(-0.1)
    assert ground.min() == pytest.approx(-0.4)


def test_what_does_not_fit_is_cut_or_left_out(way, device):
    # 60 cells of flat ground twice and the least ground before each take 128 of 160 cells; 16 more: 16 are left.
    before = [element("flat", length=60)] * 2
    ramp = way(*before, element("ramp", lead=16, size=0.25, length=48, turn=1))
    assert ramp[160] == pytest.approx(0.25 * 16 * 0.05)  # cut to 16 cells
    nothing = way(*before, element("cross_slope", lead=16, size=0.25, length=48, turn=1))
    assert not nothing.any()
    # Stairs lose steps: of 8 with treads of 0.3 m, 6 cells, three have risers 0, 6 and 12 cells behind the first.
    stairs = course(*before, element("stairs", lead=16, size=0.2, length=0.3, detail=8, turn=1))
    assert lay_out(wp.array(stairs, device=device)).numpy()["detail"][0, 2] == 3


def test_a_small_change_of_a_gene_changes_little_but_for_the_kind(device):
    rng = np.random.default_rng(2)
    genes = rng.uniform(-1, 1, (40, 36)).astype(np.float32)
    changed = genes + rng.uniform(-0.01, 0.01, genes.shape).astype(np.float32)
    changed.reshape(-1, 6)[:, 0] = genes.reshape(-1, 6)[:, 0]
    before, after = heights_of(genes, device), heights_of(changed, device)
    apart = np.sqrt(((before - after) ** 2).mean(axis=(1, 2)))
    other = np.sqrt(((before - before[::-1]) ** 2).mean(axis=(1, 2)))
    assert np.median(apart) < 0.25 * np.median(other)


def test_elements_of_any_size_lie_where_they_say(device):
    # A step of 0.7 m behind column 100, which no gene has, and behind column 200 a ditch of 80 cells that is cut to 40.
    elements = np.zeros((2, 1), Element.numpy_dtype())
    elements[0, 0] = (Kind.STEP, 100, 0, 0.0, 0.0, 0.7, 0.0, 0.0, -1.0)
    elements[1, 0] = (Kind.DITCH, 200, 0, 0.0, 0.0, 0.3, 80.0, 0.0, 0.0)
    laid = wp.array(elements, dtype=Element, device=device)
    place(laid)
    out = wp.zeros((2, 161, 321), dtype=float, device=device)
    rasterise_elements(laid, out)
    step, ditch = out.numpy()[:, 80]
    assert not step[:101].any() and step[101:] == pytest.approx(-0.7)
    assert np.flatnonzero(ditch).tolist() == list(range(201, 240))
    assert laid.numpy()["rise"][:, 0] == pytest.approx([-0.7, 0.0])


def test_wrong_shapes_are_named(device):
    genes = wp.zeros((2, 36), dtype=float, device=device)
    out = wp.zeros((2, 161, 321), dtype=float, device=device)
    with pytest.raises(ValueError, match=r"\(num_terrains, 36\), got \(2, 64\)"):
        lay_out(wp.zeros((2, 64), dtype=float, device=device))
    with pytest.raises(ValueError, match=r"\(2, nrow, ncol\), got \(3, 5, 5\)"):
        rasterise(genes, 0.05, wp.zeros((3, 5, 5), dtype=float, device=device))
    with pytest.raises(ValueError, match=r"spacing must be 0.05 m, got 0.1"):
        rasterise(genes, 0.1, out)
    assert lay_out(genes).shape == (2, MAX_ELEMENTS)
