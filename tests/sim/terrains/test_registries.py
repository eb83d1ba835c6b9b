"""Every condition and every element appears wherever they do: the shipped ones, and a toy of each."""

import dataclasses

import numpy as np
import pytest
import torch

from qd.commands import ArchiveCommand, DoseCommand
from qd.evaluate.dose import all_doses, parse_doses
from qd.faults.causes import find_effects
from sim.rollout import Rollout
from sim.terrains.bank import make_heights, make_terrains
from sim.terrains.conditions.kinds import CONDITIONS, condition_column, condition_texts, nominal_row
from sim.terrains.corridor import corridor_maps, num_maps
from sim.terrains.elements.kinds import ELEMENTS
from sim.terrains.spaces.registry import SPACES, get_space, load_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.wider import varied_space
from sim.terrains.terrains import Terrains
from tests.sim.terrains.spaces.spaces import write_ridges


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_condition_appears_wherever_conditions_do(name):
    condition, space = CONDITIONS[name], load_space(f"super_gaussian+{name}")
    genes, part = space.hard_random(1, 0), len(SUPER_GAUSSIAN.parts(np.zeros(64)))
    assert space.num_genes == 64 + len(condition.genes) and space.conditions == (name,)
    (row,) = space.condition_rows(genes)
    (text,) = condition_texts(row, [name])
    assert space.parts(genes[0])[part] == text == space.condition_text(genes[0]) != ""
    without = space.without(genes, [part])
    np.testing.assert_array_equal(space.condition_rows(without), nominal_row()[None])
    assert space.parts(without[0])[part] == f"no {name}"
    effects = find_effects(genes[0], [part], space)
    assert effects.shape(0, 0.3).kind == condition.cause
    assert num_maps(space) == len(condition.genes) == corridor_maps(torch.as_tensor(genes), space).shape[1]
    assert f"+{name}" in ArchiveCommand.help_values()["conditions"]
    assert (name in varied_space(SUPER_GAUSSIAN).conditions) == (condition.varied is not None)
    if condition.dose:
        assert name in DoseCommand.help_values()["conditions"]
        dose = parse_doses([name], [])[name]
        rows = get_space(dose.space).condition_rows(dose.terrains(1, np.random.default_rng(0)))
        column = condition_column(condition.dose.parameter)
        np.testing.assert_allclose(rows[:, column], dose.values, atol=1e-6)


@pytest.mark.parametrize("name", ELEMENTS)
def test_an_element_appears_wherever_elements_do(name):
    element = ELEMENTS[name]
    space = next(space for space in SPACES.values() if name in getattr(space, "kinds", ()))
    assert all(dose in DoseCommand.help_values()["obstacles"] for dose in element.doses)
    for dose in element.doses:
        grids = all_doses()[dose].terrains(1, np.random.default_rng(0))
        assert np.ptp(grids, axis=(1, 2)).min() > 0.0 and (grids[1:] != grids[:-1]).any(axis=(1, 2)).all()
    kind = space.kinds.index(name)
    genes = np.full((1, space.num_genes), 0.9, np.float32)
    genes[:, ::6] = (2 * kind + 1) / len(space.kinds) - 1
    records = space.elements(genes)[0]
    assert {list(ELEMENTS)[number] for number in records["kind"][:1]} == {name}
    assert space.parts(genes[0])[0] == element.text(records[0])
    assert make_heights(genes, space).any() == (name != "flat")


def test_a_toy_condition_blows_the_robot_forward(anymal):
    space, robot = get_space("super_gaussian+wind"), dataclasses.replace(anymal, max_duration_s=0.4)
    genes = np.zeros((2, 65), np.float32)
    genes[1, 64] = 1.0
    rollout = Rollout(robot, anymal.policy_file, num_terrains=2, replicas=2, device="cpu", space=space)
    result = rollout.evaluate(Terrains(genes=genes, seeds=np.array([1, 1], np.uint32), space=space))
    # 5 m/s^2 for 0.4 s without friction would be 0.4 m.
    gain = result.final_position[1, :, 0] - result.final_position[0, :, 0]
    assert (gain > 0.05).all() and (gain < 0.5).all()


@pytest.mark.parametrize(
    "name", [*SPACES, "super_gaussian@0.1", "course+friction+softness+grip+push", "ridges", "ridges+wind"]
)
def test_a_terrain_without_all_of_its_parts_is_flat_and_nominal(name, tmp_path):
    space = load_space(name.replace("ridges", write_ridges(tmp_path)))
    genes = space.uniform_random(20, 1) * 1.5
    parts = space.parts(genes[0])
    heights, ground = make_terrains(space.without(genes, range(len(parts))), space)
    assert not heights.any() and make_heights(genes, space).any()
    if ground is not None:
        assert (ground.friction == 1.0).all() and not ground.time_constant_s.any()
        np.testing.assert_array_equal(ground.rows, np.tile(nominal_row(), (20, 1)))
