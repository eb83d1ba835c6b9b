"""Terrains as a value: what they refuse, how they slice, join and travel, and where they are crossed."""

import dataclasses
import pickle

import numpy as np
import pytest

from sim.rollout import Rollout
from sim.terrains.ground import GroundMaps
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.registry import get_space, load_space
from sim.terrains.terrains import Terrains
from tests.sim.terrains.spaces.spaces import write_ridges

GRIDS = np.arange(3, dtype=np.float32)[:, None, None] + np.zeros((3, NUM_ROWS, NUM_COLS), np.float32)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"heights": None}, "genes or heights"),
        ({"genes": np.zeros((3, 64), np.float32)}, "genes or heights"),
        ({"seeds": np.arange(2)}, "seeds"),
        ({"ground": GroundMaps.plain(2)}, "ground"),
    ],
)
def test_what_does_not_fit_together_is_refused(changes, field):
    with pytest.raises(ValueError, match=field):
        Terrains(**{"heights": GRIDS, "seeds": np.arange(3)} | changes)


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
