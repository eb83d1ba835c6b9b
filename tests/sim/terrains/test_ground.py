"""Friction and softness of patches: nothing without them, and with them what MuJoCo C and formulas say."""

import dataclasses

import mujoco
import numpy as np
import pytest

from kernels.episode import Outcome
from kernels.penalties import penalty_columns
from sim.controllers.loaders import load_policy
from sim.mujoco_c.crossing import cross_in_mujoco_c, draw_starts
from sim.mujoco_c.model import GROUND, crossing_model
from sim.rollout import Rollout
from sim.terrains.bank import TerrainBank
from sim.terrains.ground import GroundMaps
from sim.terrains.terrains import Terrains
from tests.sim.plain_mujoco import rays_from_above
from tests.sim.scenes import FLAT, Stepper, free_body, lying, positions, put, simulate, slope

GRAVITY = 9.81


def uniform(friction=(1.0,), tau=(0.0,)):
    """Maps of one friction and time constant a terrain."""
    shape = np.ones((max(len(friction), len(tau)), 4, 8), np.float32)
    return GroundMaps(
        friction=shape * np.float32(friction)[:, None, None], time_constant_s=shape * np.float32(tau)[:, None, None]
    )


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
    starts = draw_starts(anymal, FLAT, 5, episodes, "cpu")
    plain = cross_in_mujoco_c(robot, load_policy(anymal.policy_file, anymal, "cpu"), FLAT, starts, ground=ground)
    assert (ours.outcome == plain.outcome).all() and (plain.outcome == Outcome.TIME_OUT).all()
    assert ours.final_position[0, :, 0].min() > 4.5  # over two boundaries
    columns = penalty_columns(("yaw_rate", "vel_x", "vel_y"))
    cost = ours.penalties[0][:, columns].mean(axis=0)
    np.testing.assert_allclose(cost, plain.penalties[0][:, columns].mean(axis=0), rtol=0.1)
    assert (np.abs(cost / on_plain.penalties[0][:, columns].mean(axis=0) - 1) > 0.1).any()  # or nothing was tested


def test_a_bank_takes_maps_only_where_it_has_room_for_them():
    with pytest.raises(ValueError, match="with_ground"):
        TerrainBank(1, device="cpu").set_heights(FLAT[None], ground=uniform())
    bank = TerrainBank(2, device="cpu", with_ground=True)
    bank.set_heights(np.stack([FLAT] * 2), ground=uniform(friction=[0.5, 0.25], tau=[0.02, 0.03]))
    bank.set_heights(FLAT[None], slice(1, 2))  # other heights without ground: the old maps are gone
    maps = bank.ground_maps()
    assert (maps.friction[:, 0, 0].tolist(), maps.time_constant_s[1].max()) == ([0.5, 1.0], 0.0)
    with pytest.raises(ValueError, match="ground"):
        bank.set_heights(FLAT[None], slice(1, 2), ground=uniform(friction=[1, 1]))


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"friction": np.full((1, 4, 8), 0.1)}, "friction"),
        ({"friction": np.full((1, 4, 8), np.nan)}, "friction"),
        ({"friction": np.ones((1, 8, 4))}, "friction"),
        ({"time_constant_s": np.full((1, 4, 8), 0.2)}, "softness"),
        ({"time_constant_s": np.zeros((2, 4, 8))}, "softness"),
    ],
)
def test_maps_out_of_range_are_refused(changes, field):
    values = {"friction": np.ones((1, 4, 8)), "time_constant_s": np.zeros((1, 4, 8))}
    with pytest.raises(ValueError, match=field):
        GroundMaps(**values | changes)


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
