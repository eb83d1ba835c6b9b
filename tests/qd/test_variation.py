import numpy as np
import pytest

from qd.run.settings import SchedulerCfg
from qd.variation import check_variation, iso_line, recombined
from sim import space
from sim.space import SUPER_GAUSSIAN, load_space
from sim.spaces.course import COURSE
from tests.sim.spaces.spaces import write_ridges

CHILDREN, OTHERS = (SUPER_GAUSSIAN.uniform_random(400, seed) for seed in (0, 1))


def changed(crossover: float = 0.0, mirror: float = 0.0):
    return recombined(CHILDREN, OTHERS, crossover, mirror, SUPER_GAUSSIAN, np.random.default_rng(2))


def test_without_shares_children_stay_as_they_are():
    assert np.array_equal(changed(), CHILDREN)


def test_a_child_takes_whole_bumps_half_of_them():
    found, own, other = (genes.reshape(400, 8, 8) for genes in (changed(crossover=0.3), CHILDREN, OTHERS))
    taken, kept = (found == other).all(axis=2), (found == own).all(axis=2)
    assert (taken ^ kept).all()
    crossed = taken.any(axis=1)
    assert 0.25 < crossed.mean() < 0.35  # 0.3, of 400: a standard deviation of .023
    assert 0.45 < taken[crossed].mean() < 0.55


def test_a_share_is_mirrored():
    found = changed(mirror=0.5)
    turned = (found == SUPER_GAUSSIAN.mirrored(CHILDREN)).all(axis=1)
    assert 0.4 < turned.mean() < 0.6
    assert np.array_equal(found[~turned], CHILDREN[~turned])


def test_iso_line_without_steps_repeats_and_along_lines_stays_on_them():
    def varied(**sigmas):
        return iso_line(CHILDREN, OTHERS, SchedulerCfg(**sigmas), np.random.default_rng(3))

    assert np.array_equal(varied(iso_sigma=0.0, line_sigma=0.0), CHILDREN)
    step, line = varied(iso_sigma=0.0, line_sigma=0.1) - CHILDREN, OTHERS - CHILDREN
    inside = np.abs(CHILDREN + step) < 1.0
    shares = np.where(inside, step / line, np.nan)
    median = np.nanmedian(shares, axis=1)
    assert 0.08 < median.std() < 0.12
    assert np.nanmax(np.abs(step - median[:, None] * line)[inside]) < 1e-5


def test_what_a_space_cannot_vary_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(space, "_named", [])
    ridges = load_space(write_ridges(tmp_path))
    with pytest.raises(ValueError, match=r"crossover_share must be 0, got 0.5: .*genes_per_part"):
        check_variation(SchedulerCfg(crossover_share=0.5), ridges)
    with pytest.raises(ValueError, match=r"mirror_share must be 0, got 0.5: the space course cannot mirror"):
        check_variation(SchedulerCfg(mirror_share=0.5), COURSE)
    check_variation(SchedulerCfg(crossover_share=0.5), COURSE)
    check_variation(SchedulerCfg(crossover_share=0.5, mirror_share=0.5), SUPER_GAUSSIAN)
