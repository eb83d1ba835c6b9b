"""Judging a run of the stand-in: fresh episodes, contact resolved, other controllers, and what a stop leaves."""

import dataclasses
import json
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from kernels.episode import Outcome
from qd import judge as judging
from qd.archive import read_archive, write_archive
from qd.fitness import FitnessCfg
from qd.judge import drawn_elites, elite_seeds, find_search, fresh_values, judge, outcome_counts, seen_by
from qd.show import figures
from qd.workers.cross import Crossings
from qd.workers.evaluator import Compute
from sim.mujoco_c.crossing import PlainCrossings
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.builders import small_archive
from tests.qd import stand_in
from tests.qd.stand_in import Stub, make_result

RESULTS = Path(__file__).parents[2] / "results"
OTHER = {"C-G": f"{RESULTS}/anymal/C-G.pt"}
HERE = Compute(workers="1")


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    monkeypatch.setattr(figures, "write_figures", lambda folder, archive, metrics: [])


def archive_of(ratios, *, collided=None):
    """An archive whose elites have given first ratios of two, found with or without a collision."""
    archive = small_archive(len(ratios))
    columns = np.stack([np.asarray(ratios), 1.0 - np.asarray(ratios)], axis=1)
    archive = dataclasses.replace(archive, ratios=columns, scales=(1.0, 1.0), collision_bit=collided is not None)
    return dataclasses.replace(archive, cell=archive.cells.cell_of(columns, collided))


def evaluator(ratios, **kwargs):
    columns = np.stack([np.asarray(ratios), 1.0 - np.asarray(ratios)], axis=1)
    penalties = np.repeat(columns[:, None], 40, axis=1)
    return lambda genes, seeds, progress=None: make_result(penalties, **kwargs)


def fresh_of(archive, evaluate, num_replicas=40):
    fitness = FitnessCfg(penalties=archive.penalties, scales=archive.scales)
    return fresh_values(archive, evaluate, fitness, num_replicas=num_replicas, seed=0)


def test_an_elite_is_reproduced_in_its_cell_and_in_neighbours():
    # cells of two ratios: [.3, .4) x [.6, .7) has index 3; .45 is one interval further, .55 two
    fresh = fresh_of(archive_of([0.35] * 4), evaluator([0.38, 0.45, 0.55, 0.25]))
    assert fresh.reproduced.tolist() == [True, True, False, True]


def test_an_invalid_terrain_is_not_reproduced():
    invalid = np.zeros((2, 40), bool)
    invalid[1, :11] = True  # 11 of 40 is more than a quarter
    fresh = fresh_of(archive_of([0.45, 0.45]), evaluator([0.45, 0.45], invalid=invalid))
    assert fresh.reproduced.tolist() == [True, False]
    assert fresh.corrected_elites().tolist() == [0]


def test_collision_intervals_by_hand():
    collides, invalid = np.zeros((4, 40), bool), np.zeros((4, 40), bool)
    collides[0, :10] = True
    collides[1] = invalid[1, :30] = True
    collides[3, :5], invalid[3, 5:10] = True, True
    fresh = fresh_of(archive_of([0.45] * 4), evaluator([0.45] * 4, base_collision=collides, invalid=invalid))
    # Wilson with z = 1.96, z^2 = 3.842: of 10 of 40 the centre is (.25 + 3.842/80) / (1 + 3.842/40) = .2719, half the
    # width 1.96 sqrt(.25 .75 / 40 + 3.842 / 6400) / 1.0960 = .1300; nothing is known of the second; none of 40 give
    # 3.842 / (40 + 3.842) = .0876; of 5 of 35, (.1429 + .0549) / 1.1098 = .1782 and 1.96 sqrt(.004283) / 1.1098 = .1156
    assert fresh.collision_low == pytest.approx([0.1419, 0.0, 0.0, 0.0626], abs=1e-4)
    assert fresh.collision_high == pytest.approx([0.4019, 1.0, 0.0876, 0.2938], abs=1e-4)
    assert fresh.collision_rate.tolist() == [0.25, 0.0, 0.0, 5 / 35]


def test_the_collision_bit_is_taken_over_the_first_twenty():
    collides = np.zeros((3, 40), bool)
    collides[1, 19] = True
    collides[2, 20] = True
    again = evaluator([0.35] * 3, base_collision=collides)
    assert fresh_of(archive_of([0.35] * 3, collided=[False] * 3), again).reproduced.tolist() == [True, False, True]
    assert fresh_of(archive_of([0.35] * 3, collided=[True] * 3), again).reproduced.tolist() == [False, True, False]


def test_few_replicas_several_times_make_forty_episodes():
    crossed = []

    def evaluate(genes, seeds, progress=None):
        crossed.append((genes, seeds))
        marks = np.arange(len(genes) * 12, dtype=float).reshape(len(genes), 12)
        return make_result(np.stack([marks, marks + 1.0], axis=2))

    archive = archive_of([0.25, 0.35])
    fresh = fresh_of(archive, evaluate, num_replicas=12)
    genes, seeds = crossed[0]
    # 4 times 12 episodes, of which 40 count
    assert np.array_equal(genes, archive.genes.repeat(4, axis=0)) and len(set(seeds.tolist())) == 8
    assert fresh.episodes.tolist() == [40, 40] and fresh.penalty_mean[:, 0].tolist() == [19.5, 48 + 19.5]
    with pytest.raises(ValueError, match="12 episodes"):
        fresh_of(archive, evaluator([0.5, 0.5]), num_replicas=12)


def test_an_empty_archive_has_no_fresh_values():
    fresh = fresh_of(small_archive(0), lambda *_: pytest.fail("there is nothing to cross"))
    assert len(fresh.reproduced) == len(fresh.collision_low) == 0


def test_seeds_follow_from_what_names_an_elite():
    archive = small_archive(4)
    seeds = elite_seeds(archive, 3, stream=5)
    assert np.array_equal(elite_seeds(archive.rows(np.array([2, 0])), 3, stream=5), seeds[[2, 0]])
    others = [elite_seeds(archive, 4, stream=5), elite_seeds(archive, 3, stream=6)]
    assert len({*seeds.tolist(), *np.concatenate(others).tolist()}) == 12
    # Stored crossings and published numbers are of these.
    assert elite_seeds(archive, 3, stream=1)[0] == np.random.SeedSequence([3, 1, 0], spawn_key=(1,)).generate_state(1)


def test_drawn_elites_are_some_of_them_each_once():
    archive = small_archive(3)
    assert drawn_elites(archive, 3, seed=0) is archive
    assert set(drawn_elites(archive, 2, seed=0).cell.tolist()) < set(archive.cell.tolist())


def test_outcomes_are_counted_by_hand():
    collided = np.array([[True, False, False, False], [False] * 4])
    invalid = np.array([[False, True, False, False], [False] * 4])
    late = np.array([[False, False, False, True], [False] * 4])
    result = make_result(np.ones((2, 4, 6)), base_collision=collided, invalid=invalid, late=late)
    assert outcome_counts(result).tolist() == [[1, 1, 1, 1], [4, 0, 0, 0]]


def crosses(policy, resolved, genes):
    """Whether all robots arrive: a gene decides, another one for each controller and setting."""
    gene, above = {
        ("searched", False): (9, 2.0),
        ("searched", True): (9, 0.3),
        ("C-G", False): (10, -0.2),
        ("C-G", True): (11, -0.4),
    }[("C-G" if "C-G" in policy else "searched", resolved)]
    return genes[:, gene] > above


class Judges:
    """Crosses terrains so, noting controller, physics and seeds; fresh episodes are the stand-in's; then Ctrl-C."""

    def __init__(self, stop_after=None):
        self.crossed, self.stop_after = [], stop_after

    @contextmanager
    def __call__(self, cfg):
        def evaluate(genes, seeds, progress=None):
            if self.stop_after is not None and len(self.crossed) >= self.stop_after:
                raise KeyboardInterrupt
            self.crossed += [("C-G" in cfg.policy, cfg.resolved, seed) for seed in seeds.tolist()]
            if cfg.num_replicas == 40:
                return stand_in.evaluate(genes, seeds, 40)
            arrived = np.repeat(crosses(cfg.policy, cfg.resolved, genes)[:, None], cfg.num_replicas, axis=1)
            return make_result(np.ones((*arrived.shape, 6)), base_collision=~arrived)

        yield Stub(evaluate)


def judged(path, opened=None, stages=("resolved", "others"), certifiers=OTHER, **changes):
    return judge(path, compute=HERE, stages=stages, certifiers=certifiers, open_evaluator=opened or Judges(), **changes)


def numbers_in(path):
    return json.loads((path / "archive.json").read_text())


def test_fresh_episodes_are_forty_of_each_elite_and_order_the_archive(made, tmp_path):
    path, judges = Path(shutil.copytree(made / "found", tmp_path / "run")), Judges()
    found = read_archive(path)
    archive = judged(path, judges, stages=("fresh",))
    assert archive.fresh.episodes.tolist() == [40] * len(found) == [40] * len(judges.crossed)
    assert sorted(archive.cell.tolist()) == sorted(found.cell.tolist())
    assert (np.diff(archive.fresh.fitness) <= 0).all() and (np.diff(archive.fitness) > 0).any()
    assert np.array_equal(read_archive(path).fresh.fitness, archive.fresh.fitness)
    numbers = numbers_in(path)
    # The stand-in's noise of 10 % moves a mean of 40 episodes by under 2 %: all land in their cell or beside it.
    assert numbers["elites_reproduced"] == numbers["reevaluated"] == len(archive)
    assert numbers["elites_same_cell"] == (archive.fresh.cell == archive.cell).sum() <= len(archive)
    assert numbers["mean_fitness_corrected"] == pytest.approx(archive.fresh.fitness.mean())
    assert numbers["qd_score"] == pytest.approx(found.qd_score) and numbers["judged_by"]["fresh"]["seed"] == 3
    assert 1 <= numbers["families"] <= len(archive) and numbers["faults"] is None
    before = (path / "archive.npz").read_bytes()
    again = Judges(stop_after=0)
    judged(path, again, stages=("fresh",))  # nothing is crossed twice, and fresh values never add up
    assert (path / "archive.npz").read_bytes() == before
    other = judged(path, stages=("fresh",), seed=7)
    assert set(other.fresh.fitness.tolist()).isdisjoint(archive.fresh.fitness.tolist())
    assert numbers_in(path)["judged_by"]["fresh"]["seed"] == 7


def test_a_run_is_confirmed_and_certified_from_end_to_end(path, capsys):
    before, judges = read_archive(path), Judges()
    archive = judged(path, judges)
    failing, again = before.failing, ~crosses("searched", True, before.genes)
    once = crosses("C-G", False, before.genes)
    other = once & crosses("C-G", True, before.genes)
    assert archive.confirmed.tolist() == (failing & again).tolist()
    assert archive.certified.tolist() == (failing & other).tolist()
    faults = int((failing & again & other).sum())
    assert 0 < faults < (failing & again).sum() < failing.sum() < len(archive)
    # A controller that does not cross at the search's settings is not asked with contact resolved.
    asked = [[resolved for by_other, resolved, _ in judges.crossed if by_other is who] for who in (False, True)]
    assert asked[0] == [True] * failing.sum()
    assert (asked[1].count(False), asked[1].count(True)) == (failing.sum(), (failing & once).sum())
    assert len({seed for _, _, seed in judges.crossed}) == len(judges.crossed)
    numbers, stored = numbers_in(path), read_archive(path)
    assert (numbers["failing"], numbers["confirmed"]) == (failing.sum(), (failing & again).sum())
    assert (numbers["certified"], numbers["faults_panel"]) == ((failing & other).sum(), faults)
    assert numbers["faults"] is None  # nobody trained a specialist of this search
    assert 1 <= numbers["fault_families"] <= faults and numbers["certifiers"] == ["C-G"]
    assert numbers["certificates"][0]["policy_sha256"] == controller_hash(OTHER["C-G"])
    assert numbers["elites"] == len(before) and set(numbers["judged_by"]) == {"fresh", "resolved", "others"}
    assert stored.confirmed.tolist() == archive.confirmed.tolist()
    assert stored.certified.tolist() == archive.certified.tolist()
    assert f"{faults} faults: terrains that C-G crosses" in capsys.readouterr().out


@pytest.mark.parametrize("stop_after", [0, 3, 15])
def test_stopped_it_goes_on_with_what_was_crossed(path, tmp_path, stop_after):
    whole, every = Path(shutil.copytree(path, tmp_path / "whole")), Judges()
    judged(whole, every)
    begun, rest = Judges(stop_after), Judges()
    with pytest.raises(KeyboardInterrupt):
        judged(path, begun)
    judged(path, rest)
    assert sorted(begun.crossed + rest.crossed) == sorted(every.crossed) and rest.crossed
    assert (path / "archive.npz").read_bytes() == (whole / "archive.npz").read_bytes()
    judged(path, Judges(stop_after=0))


def test_certificates_of_several_controllers_add_up_and_a_new_one_of_the_name_replaces_them(path, tmp_path):
    first = judged(path)
    copy = shutil.copy(OTHER["C-G"], tmp_path / "C-G-2.pt")
    both = judged(path, stages=("others",), certifiers={"specialist": str(copy)})
    assert both.faults.certifiers == ("C-G", "specialist")
    assert np.array_equal(both.faults.certifier_outcomes[:, 0], first.faults.certifier_outcomes[:, 0])
    assert np.array_equal(both.faults.certifier_outcomes[:, 1], first.faults.certifier_outcomes[:, 0])
    numbers = numbers_in(path)
    assert numbers["faults"] == numbers["faults_panel"] > 0
    # Another controller of that name, which crosses nothing
    nobody = shutil.copy(f"{RESULTS}/anymal/S.pt", tmp_path / "nobody.pt")
    last = judged(path, stages=("others",), certifiers={"specialist": str(nobody)})
    assert last.faults.certifiers == ("C-G", "specialist")
    assert not last.faults.certificates()[:, 1].any() and last.faults.certificates()[:, 0].any()
    assert last.faults.certifier_sha256[1] == controller_hash(str(nobody))
    # Where the new one was not asked, nothing is known of it.
    with Crossings("anymal", HERE, open_evaluator=Judges()) as crossings:
        row = np.flatnonzero(both.failing)[:1]
        one = judging.certify(both, row, {"specialist": str(nobody)}, find_search(path), crossings)
    assert np.flatnonzero(one.faults.certifier_outcomes[:, 1].any(axis=1)).tolist() == row.tolist()


def test_the_panel_and_the_runs_own_certifiers_judge_without_the_searched_controller(path, tmp_path, monkeypatch):
    monkeypatch.setattr(judging, "RESULTS", tmp_path)
    for folder in (tmp_path / "anymal/panel", path / "certifiers"):
        folder.mkdir(parents=True)
        shutil.copy(get_robot("anymal").policy_file, folder / f"base-{folder.name}.pt")
    shutil.copy(OTHER["C-G"], path / "certifiers/specialist.pt")
    shutil.copy(f"{RESULTS}/anymal/S.pt", tmp_path / "anymal/panel/S.pt")
    archive = judged(path, certifiers=None)
    assert archive.faults.certifiers == ("S", "specialist")


def test_kin_of_what_a_certifier_trained_on_is_seen(tmp_path, monkeypatch):
    archive = small_archive(4)
    counts = np.zeros((4, 2, 4), np.int64)
    faults = judging.FaultCounts.none_of(4)
    faults = dataclasses.replace(
        faults, certifiers=("A", "B"), certifier_sha256=("a", "b"), certifier_outcomes=counts,
        certifier_resolved_outcomes=counts,
    )  # fmt: skip
    archive, marks = dataclasses.replace(archive, faults=faults), judging.marks_of(archive.genes)
    trained = {"a.pt": {marks[1], "of another archive"}, "b.pt": set()}
    monkeypatch.setattr(judging, "recorded_marks", lambda policy: trained[Path(policy).name])
    certifiers = {"A": str(tmp_path / "a.pt"), "B": str(tmp_path / "b.pt")}
    families = np.array([0, 1, 1, 2])
    assert seen_by(archive, families, certifiers) is None  # nobody knows what B was trained on
    (tmp_path / "b.train.json").write_text("{}")
    assert seen_by(archive, families, certifiers)[:, 0].tolist() == [False, True, True, False]
    assert not seen_by(archive, families, certifiers)[:, 1].any()
    assert seen_by(archive, families, {"A": certifiers["A"]}) is None


def test_some_of_the_failing_cross_in_mujoco_c(path, monkeypatch):
    archive, asked = read_archive(path), []
    outcome = np.array([Outcome.GOAL] * 3 + [Outcome.TIME_OUT] * 15 + [Outcome.INVALID] + [Outcome.BASE_COLLISION])

    def cross_terrains(robot, policy, terrains, seeds, **how):
        asked.append((how["resolved"], how["num_episodes"], seeds.tolist()))
        penalties = np.zeros((20, 7))
        crossed = PlainCrossings(outcome=outcome.astype(np.uint8), penalties=penalties, duration_s=penalties[:, 0])
        return enumerate([crossed] * len(terrains))

    monkeypatch.setattr("qd.workers.cross.cross_terrains", cross_terrains)
    monkeypatch.setattr(judging, "_MOST_IN_MUJOCO_C", 2)
    counts = judged(path, stages=("mujoco_c",)).faults.mujoco_c_outcomes
    rows = np.flatnonzero(counts.any(axis=1))
    assert len(rows) == 2 and archive.failing[rows].all() and counts[rows[0]].tolist() == [3, 1, 15, 1]
    # The episodes begin as those with contact resolved do.
    assert asked == [(True, 20, elite_seeds(archive, 3, stream=5)[rows].tolist())]
    assert numbers_in(path)["mujoco_c"] == {"crossed": 2, "failing": 2}


def test_what_cannot_be_judged_is_refused_before_anything_is_crossed(path, made, tmp_path, monkeypatch):
    archive, nobody = read_archive(path), Judges(stop_after=0)
    with pytest.raises(ValueError, match="fresh episodes"):
        judged(made / "found", nobody)
    with pytest.raises(ValueError, match="policy"):
        judged(path, nobody, policy=OTHER["C-G"])
    with pytest.raises(ValueError, match="certifier me "):
        judged(path, nobody, certifiers={"me": str(get_robot("anymal").policy_file)})
    with pytest.raises(ValueError, match="certifier C-G does not fit anymal"):
        judged(path, nobody, certifiers={"C-G": f"{RESULTS}/cassie/C-G.pt"})
    with pytest.raises(ValueError, match="certifier S must have a file"):
        judged(path, nobody, certifiers={"S": "sys:exit"})
    with pytest.raises(ValueError, match="robot"):
        judged(path, nobody, robot="cassie")
    with pytest.raises(ValueError, match="seed"):
        judged(path, nobody, seed=-1)
    with pytest.raises(FileNotFoundError):
        judged(tmp_path / "gone", nobody)
    assert not (tmp_path / "gone").exists()
    write_archive(path / "archive.npz", dataclasses.replace(archive, scales=(1.0,) * 6))
    with pytest.raises(ValueError, match="scales"):
        judged(path, nobody)
    config = json.loads((path / "config.json").read_text())
    config["settings"]["robot_sha256"] = "0" * 64
    (path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="changed"):
        judged(path, nobody)


@pytest.mark.parametrize("damaged", [b"{", b"[]"])
def test_damaged_numbers_are_refused_and_stay(path, damaged):
    (path / "archive.json").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"archive\.json"):
        judged(path)
    assert (path / "archive.json").read_bytes() == damaged


def test_where_nothing_fails_nothing_is_crossed(path):
    archive = read_archive(path)
    fine = dataclasses.replace(archive, fresh=dataclasses.replace(archive.fresh, goal_rate=np.ones(len(archive))))
    write_archive(path / "archive.npz", fine)
    judged(path, Judges(stop_after=0))
    numbers = numbers_in(path)
    names = ("failing", "confirmed", "certified", "faults", "faults_panel", "fault_families")
    assert [numbers[name] for name in names] == [0] * 6 and numbers["certifiers"] == ["C-G"]


def test_a_search_is_found_with_its_robot_controller_and_space(path):
    search = find_search(path)
    assert (search.robot.name, search.policy, search.space) == (
        "anymal", str(get_robot("anymal").policy_file), "super_gaussian",
    )  # fmt: skip
    assert len(search.read_archive()) == len(read_archive(path))
