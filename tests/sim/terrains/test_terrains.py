"""Terrains and ground as values, in a bank, as networks see them, and against MuJoCo C and formulas."""

import dataclasses
import pickle

import mujoco
import numpy as np
import pytest
import torch

from kernels.episode import Outcome
from kernels.penalties import penalty_columns
from sim.controllers.loaders import load_policy
from sim.mujoco_c.crossing import cross_in_mujoco_c, draw_starts
from sim.mujoco_c.model import GROUND, crossing_model
from sim.rollout import Rollout
from sim.terrains.bank import TerrainBank, make_heights, make_terrains
from sim.terrains.corridor import SHAPE, corridor_heights, corridor_maps, num_maps
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.registry import get_space, load_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import GroundMaps, Terrains
from tests.kernels import oracle
from tests.sim.plain_mujoco import rays_from_above
from tests.sim.scenes import FLAT, NODE_X, NODE_Y, Stepper, free_body, lying, positions, put, simulate, slope
from tests.sim.terrains.spaces.spaces import write_ridges

GRIDS = np.arange(3, dtype=np.float32)[:, None, None] + np.zeros((3, NUM_ROWS, NUM_COLS), np.float32)


TERRAINS = {"heights": GRIDS, "seeds": np.arange(3)}
MAPS = {"friction": np.ones((1, 4, 8)), "time_constant_s": np.zeros((1, 4, 8))}


@pytest.mark.parametrize(
    ("kind", "changes", "field"),
    [
        (Terrains, {"heights": None}, "genes or heights"),
        (Terrains, {"genes": np.zeros((3, 64), np.float32)}, "genes or heights"),
        (Terrains, {"seeds": np.arange(2)}, "seeds"),
        (Terrains, {"ground": GroundMaps.plain(2)}, "ground"),
        (GroundMaps, {"friction": np.full((1, 4, 8), 0.1)}, "friction"),
        (GroundMaps, {"friction": np.full((1, 4, 8), np.nan)}, "friction"),
        (GroundMaps, {"friction": np.ones((1, 8, 4))}, "friction"),
        (GroundMaps, {"time_constant_s": np.full((1, 4, 8), 0.2)}, "softness"),
        (GroundMaps, {"time_constant_s": np.zeros((2, 4, 8))}, "softness"),
    ],
)
def test_what_does_not_fit_together_is_refused(kind, changes, field):
    with pytest.raises(ValueError, match=field):
        kind(**(TERRAINS if kind is Terrains else MAPS) | changes)


@pytest.mark.parametrize("ground", [None, GroundMaps.plain(3)])
def test_slices_joined_are_the_whole_and_each_terrain_has_a_digest_of_its_own(ground):
    whole = Terrains(heights=GRIDS, seeds=np.arange(3), ground=ground)
    again = Terrains.join([whole[:1], whole[np.array([1, 2])]])
    assert again.digests() == whole.digests() and len(set(whole.digests())) == 3
    assert (again.ground is None) == (ground is None) and again.has_ground == whole.has_ground
    assert whole.digests() != dataclasses.replace(whole, seeds=np.arange(1, 4)).digests()
    assert whole[np.array([2, 0])].heights[:, 0, 0].tolist() == [2.0, 0.0]


@pytest.mark.parametrize("name", ["super_gaussian@0.06", "course+friction+payload"])
def test_they_travel_with_their_space(name):
    space = get_space(name)
    back = pickle.loads(pickle.dumps(Terrains(genes=space.hard_random(2, 0), seeds=np.arange(2), space=space)))
    assert back.space.name == name and back.has_ground == bool(space.ground)


def test_a_simulation_takes_genes_of_its_own_space_alone_wherever_its_code_lies(anymal, tmp_path):
    first, moved = (load_space(f"{write_ridges(tmp_path / name)}+friction") for name in ("first", "moved"))
    short = dataclasses.replace(anymal, max_duration_s=0.1)
    sizes = {"num_terrains": 1, "replicas": 1, "device": "cpu"}
    rollout = Rollout(short, anymal.policy_file, **sizes, space=first)
    genes = first.hard_random(1, 0)
    outcomes = [rollout.evaluate(Terrains(genes=genes, seeds=np.arange(1), space=space)) for space in (first, moved)]
    np.testing.assert_array_equal(outcomes[0].penalties, outcomes[1].penalties)
    with pytest.raises(ValueError, match="space"):
        rollout.evaluate(Terrains(genes=np.zeros((1, 64), np.float32), seeds=np.arange(1)))


def block_maxima(heights):
    """Highest node of each 4 x 4 cells, from its 5 x 5 nodes."""
    nrow, ncol = heights.shape[1:]
    rows, cols = range(0, nrow - 1, 4), range(0, ncol - 1, 4)
    return np.array([[[grid[r : r + 5, c : c + 5].max() for c in cols] for r in rows] for grid in heights])


def test_terrains_are_replaced_in_place(device):
    bank = TerrainBank(3, device=device)
    addresses = bank.heights.ptr, bank.terrain.ceilings.ptr  # captured graphs keep them
    genes = SUPER_GAUSSIAN.uniform_random(3, 0)
    bank.set(Terrains(genes=genes, seeds=np.arange(3)))
    expected = np.stack([oracle.mixture_height(row, NODE_X[None, :], NODE_Y[:, None]) for row in genes])
    np.testing.assert_allclose(bank.heights.numpy(), expected, atol=1e-5)
    heights = np.array(bank.heights.numpy())
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(heights))
    heights[1:] -= 5.0  # lower ground lowers the ceilings too
    bank.set_heights(heights[1:], slice(1, 3))
    np.testing.assert_array_equal(bank.heights.numpy(), heights)
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(heights))
    assert (bank.heights.ptr, bank.terrain.ceilings.ptr) == addresses


@pytest.mark.parametrize("space", [SUPER_GAUSSIAN, COURSE], ids=lambda space: space.name)
def test_every_second_node_is_that_of_the_whole_grid(space):
    genes = space.hard_random(3, 0)
    np.testing.assert_allclose(make_heights(genes, space, every=2), make_heights(genes, space)[:, ::2, ::2], atol=1e-5)


def test_wrong_genes_heights_and_maps_are_named(device):
    bank = TerrainBank(2, device=device)
    with pytest.raises(ValueError, match="genes"):
        bank.set(Terrains(genes=np.zeros((2, 63)), seeds=np.arange(2)))
    for heights in (np.zeros((2, 321, 161)), np.full((2, 161, 321), np.nan)):
        with pytest.raises(ValueError, match="heights"):
            bank.set_heights(heights)
    with pytest.raises(ValueError, match="with_ground"):
        bank.set_heights(np.stack([FLAT] * 2), ground=uniform(friction=[0.5, 0.25]))
    assert not bank.heights.numpy().any()


PLACES = ((0, 0), (20, 57), (40, 120), (7, 70), (19, 71))


@pytest.mark.parametrize(
    ("name", "around"),
    # A space of one spacing gives means of 3 x 3 nodes, 0.05 m apart.
    [("super_gaussian", 0), ("course", 1), ("super_gaussian+friction+softness", 0), ("course+softness", 1)],
)
def test_heights_and_ground_around_the_way(name, around):
    space = get_space(name)
    genes = space.uniform_random(3, 2)
    nodes, ground = make_heights(genes, space), make_terrains(genes, space)[1]
    heights = corridor_heights(torch.from_numpy(genes), space).numpy()
    maps = corridor_maps(torch.from_numpy(genes), space).numpy()
    assert heights.shape == (3, *SHAPE) == (3, 41, 121) and maps.shape == (3, len(space.ground), *SHAPE)
    for row, col in PLACES:  # from x = y = 2 m on, 0.1 m apart
        y, x = 40 + 2 * row, 40 + 2 * col
        expected = nodes[:, y - around : y + around + 1, x - around : x + around + 1].mean(axis=(1, 2))
        np.testing.assert_allclose(heights[:, row, col], expected, atol=1e-6)
        for place, kind in enumerate(space.ground):
            values = 1.0 - ground.friction if kind == "friction" else ground.time_constant_s / 0.06
            np.testing.assert_allclose(maps[:, place, row, col], values[:, y // 40, x // 40], atol=1e-6)


def test_conditions_are_maps_whose_mirror_images_are_those_of_mirrored_conditions():
    space = get_space("super_gaussian+friction+payload+delay+push")
    genes = torch.from_numpy(space.uniform_random(2, 0))
    mirrored = genes.clone()
    mirrored[:, [64 + 32 + 2, 64 + 32 + 5]] *= -1.0  # payload and push to the side
    maps, others = corridor_maps(genes, space), corridor_maps(mirrored, space)
    assert maps.shape == (2, 1 + 7, *SHAPE) and num_maps(space) == 8
    torch.testing.assert_close(maps[:, 1:].flip(2), others[:, 1:])
    assert not torch.equal(maps[:, 1:], others[:, 1:])
    assert torch.equal(maps[:, 1], genes[:, 96, None, None].expand(-1, *SHAPE))
    assert torch.equal(maps[:, 3, -1], genes[:, 98, None].expand(-1, SHAPE[1]))  # in full on the left
    assert torch.equal(maps[:, :1], corridor_maps(genes[:, :96], get_space("super_gaussian+friction")))


GRAVITY = 9.81


def uniform(friction=(1.0,), tau=(0.0,)):
    """Maps of one friction and time constant a terrain."""
    shape = np.ones((max(len(friction), len(tau)), 4, 8), np.float32)
    friction, tau = (shape * np.float32(values)[:, None, None] for values in (friction, tau))
    return GroundMaps(friction=friction, time_constant_s=tau)


def height_in_mujoco_c(robot, ground, z, duration_s):
    """Height of a free body after each step on flat ground in plain MuJoCo C."""
    model = crossing_model(robot, FLAT, ground=ground)
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    data, heights = mujoco.MjData(model), []
    data.qpos[:3] = 7.0, 5.0, z
    for _ in range(round(duration_s / model.opt.timestep)):
        mujoco.mj_step(model, data)
        heights.append(data.qpos[2])
    return np.array(heights)


@pytest.mark.slow
def test_a_box_slides_on_an_incline_as_its_friction_says(tmp_path, device):
    # At 20 degrees a = g (sin - mu cos), or rest where mu exceeds the tangent, 0.36; the box's own friction is 1.
    # Downhill is half way between x and y, where a pyramid of friction would hold by mu / sqrt(2) alone.
    robot, angle = free_body(tmp_path, 'type="box" size="0.15 0.15 0.03"', mass=4.0, friction=1.0), np.radians(20.0)
    frictions, duration_s, half = (0.15, 0.3, 0.45, 1.0), 0.8, np.sqrt(0.5)
    along = np.arctan(half * np.tan(angle))
    sim = simulate(robot, [slope(-along, -along)] * 4, device, uniform(friction=frictions))
    start = lying(4, 8.0, 4.0, 0.0, (-half, half, 0), angle)
    start[:, :3] += 0.03 * np.array([half * np.sin(angle), half * np.sin(angle), np.cos(angle)])
    stepper = Stepper(sim)
    put(sim, start)
    stepper.run(duration_s)
    moved = np.linalg.norm(positions(sim)[:, :3] - start[:, :3], axis=1)
    pull = GRAVITY * np.maximum(np.sin(angle) - np.array(frictions) * np.cos(angle), 0.0)
    np.testing.assert_allclose(moved, 0.5 * pull * duration_s**2, atol=0.01)


def test_a_ball_sinks_into_soft_ground_as_in_mujoco_c(tmp_path, device):
    # At rest by (1 - d) d^-2 dmax^2 tau^2 g with the impedance d = dmax = 0.95: 0.05 tau^2 g. Landing from 2 cm it
    # goes deeper; both simulators say how deep, step by step. Its own contacts have 0.02 s: no firmer ground is felt.
    robot, taus = free_body(tmp_path, 'type="sphere" size="0.1"', mass=3.0), (0.03, 0.045, 0.06)
    sim = simulate(robot, [FLAT] * 3, device, uniform(tau=taus))
    start = lying(3, 7.0, 5.0, 0.12)
    stepper, seen = Stepper(sim, steps=1), []
    put(sim, start)
    stepper.run(1.0, lambda: seen.append(positions(sim)[:, 2]))
    depths = 0.1 - np.array(seen)
    np.testing.assert_allclose(depths[-1], 0.05 * np.square(taus) * GRAVITY, rtol=0.02)
    for k, tau in enumerate(taus):
        plain = height_in_mujoco_c(robot, uniform(tau=[tau]), 0.12, 1.0)
        np.testing.assert_allclose(depths[:, k], 0.1 - plain, atol=2e-5)
    assert (np.diff(depths.max(axis=0)) > 0).all() and depths.max() > 0.01


def patchwork(seed):
    """Patches of everything, as no two neighbours have it."""
    rng = np.random.default_rng(seed)
    tau = np.where(rng.random((1, 4, 8)) < 0.5, 0.0, rng.uniform(0.01, 0.05, (1, 4, 8)))
    return GroundMaps(friction=np.float32(rng.uniform(0.45, 1.0, (1, 4, 8))), time_constant_s=np.float32(tau))


def test_walking_over_patches_costs_the_same_in_both(anymal):
    ground, episodes, robot = patchwork(2), 4, dataclasses.replace(anymal, max_duration_s=5.0)
    sizes = {"num_terrains": 1, "replicas": episodes, "device": "cpu"}
    rollout = Rollout(robot, anymal.policy_file, **sizes, with_ground=True)
    flat = [Terrains(heights=FLAT[None], seeds=np.array([5]), ground=maps) for maps in (ground, None)]
    ours, on_plain = map(rollout.evaluate, flat)
    starts = draw_starts(anymal, FLAT, 5, episodes)
    plain = cross_in_mujoco_c(robot, load_policy(anymal.policy_file, anymal, "cpu"), FLAT, starts, ground=ground)
    assert (ours.outcome == plain.outcome).all() and (plain.outcome == Outcome.TIME_OUT).all()
    assert ours.final_position[0, :, 0].min() > 4.5  # over two boundaries
    columns = penalty_columns(("yaw_rate", "vel_x", "vel_y"))
    cost = ours.penalties[0][:, columns].mean(axis=0)
    np.testing.assert_allclose(cost, plain.penalties[0][:, columns].mean(axis=0), rtol=0.1)
    assert (np.abs(cost / on_plain.penalties[0][:, columns].mean(axis=0) - 1) > 0.1).any()  # or nothing was tested


def test_other_heights_without_ground_leave_no_maps():
    bank = TerrainBank(2, device="cpu", with_ground=True)
    bank.set_heights(np.stack([FLAT] * 2), ground=uniform(friction=[0.5, 0.25], tau=[0.02, 0.03]))
    bank.set_heights(FLAT[None], slice(1, 2))
    maps = bank.ground_maps()
    assert (maps.friction[:, 0, 0].tolist(), maps.time_constant_s[1].max()) == ([0.5, 1.0], 0.0)


def test_mujoco_c_has_no_soft_slopes_and_one_friction(anymal):
    with pytest.raises(ValueError, match="soft"):
        crossing_model(anymal, slope(0.1), ground=uniform(tau=[0.02]))
    model = crossing_model(anymal, slope(0.1), ground=uniform(friction=[0.5]))
    assert model.nhfield == 4 and (model.geom_friction[model.geom_priority == 1, 0] == 0.5).all()


def test_mujoco_c_has_a_geom_where_the_ground_is_alike(anymal):
    # Wet from x = 4 m to 6 m, where a kerb of 0.1 m stands at 4.25 m; all else is level and as always.
    ground, heights = GroundMaps.plain(1), FLAT.copy()
    ground.friction[0, :, 2], heights[:, 86:] = 0.25, 0.1
    model = crossing_model(anymal, heights, ground=ground)
    geoms = [model.geom(GROUND + end) for end in ("", "-1", "-2")]
    assert model.ngeom - crossing_model(anymal, heights).ngeom == 4 * 3 - 1
    box, field = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_HFIELD
    assert [geom.type[0] for geom in geoms] == [box, field, box]
    np.testing.assert_allclose([geom.friction[0] for geom in geoms], [1.0, 0.25, 1.0])
    along = np.array([-3.0, 3.95, 4.05, 4.22, 4.33, 5.95, 6.05, 19.0])
    met, hit = rays_from_above(model, [(x, 5.03) for x in along])
    np.testing.assert_allclose(met, np.where(along > 4.3, 0.1, 0.0), atol=1e-6)
    np.testing.assert_array_equal(model.geom_friction[hit, 0], np.where((along > 4) & (along < 6), 0.25, 1.0))
