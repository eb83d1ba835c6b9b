"""Judging a run of the stand-in: fresh episodes, contact resolved, other controllers, and what a stop leaves."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from qd.faults.judge import STAGES, count_outcomes, draw_faults, elite_seeds, fresh_values, is_decided, judge
from qd.search.archive import no_witnesses, read_archive, write_archive
from qd.search.fitness import FitnessCfg
from qd.search.progress import Bar
from qd.workers.seeds import Stream
from sim.controllers.spec import controller_hash
from sim.robots.find import get_robot
from sim.robots.robot import ROBOTS, RobotCfg
from sim.terrains.conditions.kinds import condition_column
from sim.terrains.spaces.registry import get_space
from tests.builders import judged_archive, small_archive
from tests.qd import stand_in
from tests.qd.robots import OTHER, Robots
from tests.qd.stand_in import compute_by, make_result

SHIPPED = str(get_robot("anymal").policy_file)


def reproduced(ratios, again, *, collided=None, **episodes):
    """Which elites found at first ratios of two, with or without a collision, 40 episodes at others reproduce."""
    columns, fresh = (np.stack([ratio, 1.0 - ratio], axis=1) for ratio in map(np.array, (ratios, again)))
    settings = {"scales": (1.0, 1.0), "collision_bit": collided is not None}
    archive = replace(small_archive(len(ratios)), ratios=columns, **settings)
    archive = replace(archive, cell=archive.cells.find_cells(columns, collided))
    result = make_result(np.repeat(fresh[:, None], 40, axis=1), **episodes)
    fitness = FitnessCfg(penalties=archive.penalties, scales=archive.scales)
    return fresh_values(archive, result, fitness).reproduced.tolist()


def test_an_elite_is_reproduced_in_its_cell_and_in_neighbours_if_it_is_valid():
    invalid = np.zeros((5, 40), bool)
    invalid[4, :11] = True  # 11 of 40 is more than a quarter
    # cells of two ratios: [.3, .4) x [.6, .7) has index 3; .45 is one interval further, .55 two
    again = [0.38, 0.45, 0.55, 0.25, 0.35]
    assert reproduced([0.35] * 5, again, invalid=invalid) == [True, True, False, True, False]


def test_the_collision_bit_is_taken_over_the_first_twenty():
    collides = np.zeros((3, 40), bool)
    collides[1, 19] = collides[2, 20] = True
    for collided, expected in ((False, [True, False, True]), (True, [False, True, False])):
        assert reproduced([0.35] * 3, [0.35] * 3, collided=[collided] * 3, base_collision=collides) == expected


def test_seeds_follow_from_what_names_an_elite():
    archive = small_archive(4)
    seeds = elite_seeds(archive, 3, stream=5)
    assert np.array_equal(elite_seeds(archive.rows(np.array([2, 0])), 3, stream=5), seeds[[2, 0]])
    different = [elite_seeds(archive, 4, stream=5), elite_seeds(archive, 3, 2, stream=6)]
    assert len({*seeds.tolist(), *np.concatenate(different).tolist()}) == 16
    # Stored crossings and published numbers are of these.
    first = np.random.SeedSequence([3, 1, 0], spawn_key=(1,))  # iteration 1, cell 0
    assert elite_seeds(archive, 3, stream=Stream.FRESH)[0] == first.generate_state(1)


def test_outcomes_are_counted_by_hand():
    collided, invalid, late = np.zeros((3, 1, 10), bool)
    collided[0, :2], invalid[0, 2:5], late[0, 5:9] = True, True, True
    result = make_result(np.ones((1, 10, 6)), base_collision=collided, invalid=invalid, late=late)
    assert count_outcomes(result).tolist() == [[1, 2, 4, 3]]


GENES = {"searched": ((9, 2.0), (9, 0.3)), "C-G": ((10, -0.2), (11, -0.4))}
"""The gene by which all robots arrive, and above which value, by controller, as searched and with contact resolved."""


def crosses(policy, resolved, genes):
    gene, above = GENES["C-G" if "C-G" in policy else "searched"][resolved]
    return genes[:, gene] > above


def cross_by_genes(cfg, genes, seeds):
    if cfg.replicas == 40:
        return stand_in.evaluate(genes, seeds, 40)
    return ~crosses(cfg.policy, cfg.engine == "resolved", genes)


def judged(path, robots=None, stages=("resolved", "others"), certifiers=OTHER, **changes):
    compute = compute_by(robots or Robots(cross_by_genes))
    return judge(path, compute=compute, stages=stages, certifiers=certifiers, **changes)


def with_goal_rates(path, goal_rate):
    """Gives the run's elites other goal rates of fresh episodes."""
    archive = read_archive(path)
    write_archive(path / "archive.npz", replace(archive, fresh=replace(archive.fresh, goal_rate=goal_rate)))


def numbers_in(path):
    return json.loads((path / "archive.json").read_text())


def test_fresh_episodes_are_forty_of_each_elite_and_order_the_archive(made, tmp_path):
    path, robots = Path(shutil.copytree(made / "found", tmp_path / "run")), Robots(cross_by_genes)
    searched = read_archive(path)
    archive = judged(path, robots, stages=("fresh",))
    assert archive.fresh.episodes.tolist() == [40] * len(searched) == [40] * len(robots.crossed)
    assert sorted(archive.cell.tolist()) == sorted(searched.cell.tolist())
    assert (np.diff(archive.fresh.fitness) <= 0).all() and (np.diff(archive.fitness) > 0).any()
    assert np.array_equal(read_archive(path).fresh.fitness, archive.fresh.fitness)
    numbers = numbers_in(path)
    # The stand-in's noise of 10 % moves a mean of 40 episodes by under 2 %: all land in their cell or beside it.
    assert numbers["elites_reproduced"] == numbers["reevaluated"] == len(archive)
    assert numbers["qd_score"] == pytest.approx(searched.qd_score) and numbers["judged_by"]["fresh"]["seed"] == 3
    assert 1 <= numbers["families"] <= len(archive) and numbers["faults"] is None


def test_a_run_is_confirmed_and_certified_from_end_to_end(path, monkeypatch):
    before, robots, bars = read_archive(path), Robots(cross_by_genes), []
    monkeypatch.setattr("qd.workers.crosser.Bar", lambda text: bars.append(text) or Bar(text))
    archive = judged(path, robots)
    assert bars == ["1 of 2: contact resolved", "2 of 2: C-G", "2 of 2: C-G, contact resolved"]
    failing, again = before.failing, ~crosses("searched", True, before.genes)
    once = crosses("C-G", False, before.genes)
    other = once & crosses("C-G", True, before.genes)
    assert archive.confirmed.tolist() == (failing & again).tolist()
    assert archive.certified.tolist() == (failing & other).tolist()
    faults = int((failing & again & other).sum())
    assert 0 < faults < (failing & again).sum() < failing.sum() < len(archive)
    # A controller that does not cross at the search's settings is not asked with contact resolved.
    crossed = Counter((cfg.policy, cfg.engine) for cfg, _ in robots.crossed)
    expected = {(SHIPPED, "resolved"): failing.sum(), (OTHER["C-G"], "search"): failing.sum()}
    assert crossed == expected | {(OTHER["C-G"], "resolved"): (failing & once).sum()}
    assert len(set(robots.seeds)) == len(robots.seeds)
    numbers, stored = numbers_in(path), read_archive(path)
    counts = [failing.sum(), (failing & again).sum(), (failing & other).sum(), faults]
    assert [numbers[name] for name in ("failing", "confirmed", "certified", "faults_panel")] == counts
    assert 1 <= numbers["fault_families"] <= numbers["faults_distinct"] <= faults and numbers["certifiers"] == ["C-G"]
    assert numbers["certificates"][0]["policy_sha256"] == controller_hash(OTHER["C-G"])
    assert numbers["elites"] == len(before) and set(numbers["judged_by"]) == {"fresh", "resolved", "others"}
    assert stored.confirmed.tolist() == archive.confirmed.tolist()
    assert stored.certified.tolist() == archive.certified.tolist()
    assert (stored.cause != "").tolist() == failing.tolist() and len(stored.family) == len(archive)
    content = (path / "archive.npz").read_bytes()
    judged(path, Robots(cross_by_genes, stop_after=0))  # nothing is crossed twice, and nothing adds up
    assert (path / "archive.npz").read_bytes() == content


VARIED_SPACE = get_space("super_gaussian+payload+motors+delay+noise+grip")
WEAK = str(ROBOTS["anymal"].panel / "S.pt")


def vary(path, before, crossed):
    """The archive after varied conditions, under which robots cross the first fault unless their motors are weak."""
    fragile = before.genes[np.flatnonzero(before.is_fault)[0]]

    def rule(cfg, genes, seeds):
        crossed.append((cfg, genes, seeds))
        weak = VARIED_SPACE.condition_rows(genes)[:, condition_column("strength")] < 0.92
        return (weak | (genes[:, :64] != fragile).any(axis=1)) & (cfg.policy == SHIPPED)

    return judged(path, Robots(rule), stages=("varied",))


def test_a_fault_is_robust_if_it_is_one_under_the_same_20_varied_conditions_too(path):
    before, crossed = judged(path), []
    rows = np.flatnonzero(before.is_fault)
    archive = vary(path, before, crossed)
    assert archive.varied.searched[rows].sum(axis=1).tolist() == [20] * len(rows)
    assert 0 < archive.varied.searched[rows[0], 1] < 10  # collisions where motors are weak
    assert archive.robust.tolist() == (before.is_fault & (np.arange(len(before)) != rows[0])).tolist()
    assert numbers_in(path)["robust"] == numbers_in(path)["crossed_varied"] - 1 == len(rows) - 1 > 0
    assert np.array_equal(read_archive(path).robust, archive.robust)
    archive.varied.searched[rows[-1]] = [10, 10, 0, 0]  # it crosses half of them: so it does not fail
    assert not archive.robust[rows[-1]]
    assert {cfg.space for cfg, *_ in crossed} == {VARIED_SPACE.name}
    by = (SHIPPED, *OTHER.values())
    by_policy = [[row for cfg, genes, _ in crossed if cfg.policy == name for row in genes] for name in by]
    assert np.array_equal(*map(np.array, by_policy))
    starts = np.concatenate([seeds for *_, seeds in crossed])
    assert len(np.unique(by_policy[0], axis=0)) == len({*starts.tolist()}) == 20 * len(rows)


def test_only_the_certifiers_of_faults_can_cross_them_under_varied_conditions(path):
    vary(path, judged(path), [])
    nobody = Robots(cross_by_genes, stop_after=0)
    for stages in (("varied",), ("others", "varied"), ("mujoco_c",)):
        with pytest.raises(ValueError, match=r"certifiers .*C-G"):
            judged(path, nobody, stages=stages, certifiers={})
    for stage in ("varied", "mujoco_c"):
        with pytest.raises(ValueError, match=r"certifiers .*C-G"):
            judged(path, nobody, stages=(stage,), certifiers={"C-G": WEAK})
    # Another controller of the name has other certificates, so nobody knows any more which faults are robust.
    assert not judged(path, stages=("others",), certifiers={"C-G": WEAK}).robust.any()
    assert not {"robust", "crossed_varied"} & numbers_in(path).keys()


def test_a_robot_without_conditions_is_refused_before_anything_is_crossed(path, monkeypatch):
    monkeypatch.setattr("sim.solver.is_supported", lambda *_: False)
    with pytest.raises(ValueError, match="robot 'anymal' cannot have conditions"):
        judged(path, Robots(cross_by_genes, stop_after=0), stages=("fresh", "resolved", "others", "varied"))


def test_half_of_ten_episodes_is_decided_by_five_that_arrive_or_six_that_do_not():
    decided = [[5, 0, 0, 0], [0, 4, 2, 0], [5, 4, 0, 0], [4, 6, 0, 0], [4, 0, 3, 2], [4, 5, 0, 1]]
    # Four of the nine that are valid are under half; 2 of 7 invalid are more than a quarter as yet.
    undecided = [[0, 0, 0, 0], [0, 5, 0, 0], [2, 1, 2, 0], [4, 5, 0, 0], [4, 4, 0, 1], [5, 0, 0, 2]]
    assert is_decided(np.array(decided + undecided), 10).tolist() == [True] * 6 + [False] * 6


def test_one_fault_a_family_is_drawn_first():
    archive = judged_archive().rows(np.array([0] * 6 + [1]))  # six times the fault, and one confirmed alone
    archive = replace(archive, family=np.array([5, 5, 5, 5, 2, 0, 7]))
    draws = [draw_faults(archive, seed, 5).tolist() for seed in range(20)]
    assert all({*draw[:3]} - {0, 1, 2, 3} == {4, 5} and len({*draw}) == 5 and 6 not in draw for draw in draws)
    assert draws[3] == draw_faults(archive, 3, 5).tolist() and {row for draw in draws for row in draw} == {*range(6)}
    # Families are drawn alike, however many members they have.
    alone = np.array([draw_faults(archive, seed, 1)[0] for seed in range(200)])
    assert 40 < (alone == 4).sum() < 95


def test_a_fault_holds_in_mujoco_c_if_the_controller_fails_and_its_best_certifier_crosses_until_decided(path):
    before = judged(path)
    rows = np.flatnonzero(before.is_fault)
    seeds = elite_seeds(before, 3, 2, stream=Stream.MUJOCO_C).tolist()
    arrives, narrow, lost = rows.tolist()

    def rule(cfg, genes, episodes):
        number, again = np.divmod([seeds.index(seed) for seed in episodes], 2)
        assert np.array_equal(genes, before.genes[number])
        assert cfg.engine == "mujoco_c" and {*again} == {int(cfg.replicas == 4)}
        fails = number == lost if "C-G" in cfg.policy else number != arrives
        collided = np.repeat(fails[:, None], cfg.replicas, axis=1)
        if "C-G" not in cfg.policy and cfg.replicas == 6:
            collided[number == narrow] = [0, 1, 0, 1, 0, 0]  # 4 of 6, and then 4 of 10
        return stand_in.make_result(np.ones((*collided.shape, 6)), base_collision=collided)

    stopped = Robots(rule, stop_after=3)
    with pytest.raises(KeyboardInterrupt):
        judged(path, stopped, stages=("mujoco_c",))
    rest = Robots(rule)
    archive = judged(path, rest, stages=("mujoco_c",))
    assert archive.mujoco_c.searched[rows].tolist() == [[6, 0, 0, 0], [4, 6, 0, 0], [0, 6, 0, 0]]
    assert archive.mujoco_c.certifiers[rows, 0].tolist() == [[0, 0, 0, 0], [6, 0, 0, 0], [0, 6, 0, 0]]
    # The controller on three faults, stopped; again on one, and its certifier where it fails.
    assert [len(robots.crossed) for robots in (stopped, rest)] == [3, 1 + 2]
    assert np.flatnonzero(archive.holds_in_mujoco_c).tolist() == [narrow]
    numbers = numbers_in(path)["faults_mujoco_c"]
    assert (numbers["tried"], numbers["hold"]) == (3, 1)
    assert np.array_equal(read_archive(path).holds_in_mujoco_c, archive.holds_in_mujoco_c)
    # Another controller of the certifier's name is another certifier.
    assert judged(path, stages=("others",), certifiers={"C-G": WEAK}).mujoco_c is None
    assert "faults_mujoco_c" not in numbers_in(path)


def test_mujoco_c_crosses_faults_alone_and_no_soft_ground(path):
    judged(path)
    archive = judged(path, Robots(lambda cfg, genes, seeds: np.zeros(len(genes), bool)), stages=("mujoco_c",))
    assert not archive.holds_in_mujoco_c.any() and not archive.mujoco_c.certifiers.any()
    write_archive(path / "archive.npz", replace(archive, certifier_outcomes=0 * archive.certifier_outcomes))
    with pytest.raises(ValueError, match=r"stages .* no faults"):
        judged(path, Robots(cross_by_genes, stop_after=0), stages=("mujoco_c",))
    soft = SimpleNamespace(search=SimpleNamespace(space=get_space("super_gaussian+softness")))
    with pytest.raises(ValueError, match="softness"):
        STAGES["mujoco_c"].check(read_archive(path), soft, ())


def witnessed(path, monkeypatch, kinds=(3,), speed=0.0, **changes):
    """The archive after the stage steered, whose search finds such ways, and what it was asked: walkers and seeds."""
    asked = []

    def seek(crosser, walkers, terrains, seeds, limit_m, *, rng, label, cfg):
        asked.append((walkers, terrains.genes, seeds))
        found = no_witnesses(len(terrains), limit_m)
        found.walker[:], found.kind[:] = [*walkers][-1], np.resize(kinds, len(terrains))
        found.way[..., 0] = speed
        return found

    monkeypatch.setattr("qd.faults.judge.seek_witnesses", seek)
    return judged(path, stages=("steered",), **changes), asked


def test_ways_are_sought_where_no_controller_certifies_and_are_kept(path, monkeypatch):
    before = judged(path)
    rows = np.flatnonzero(before.confirmed & ~before.certified)
    archive, [(walkers, genes, seeds)] = witnessed(path, monkeypatch, (3, 0, 2))
    assert walkers == {"searched": SHIPPED, **OTHER} and np.array_equal(genes, before.genes[rows])
    assert len({*seeds.ravel().tolist()}) == seeds.size == len(rows) * 2 * 26
    assert archive.witnesses.kind[rows].tolist() == np.resize([3, 0, 2], len(rows)).tolist()
    numbers, by_ways = numbers_in(path), int((archive.witnesses.kind == 3).sum())
    assert numbers["faults_witness"] == by_ways == numbers["faults"] - numbers["faults_controllers"] > 0
    assert numbers["witnesses"]["tried"] == len(rows) and read_archive(path).is_fault.sum() == numbers["faults"]
    # Of one terrain ways are sought again, by the searched controller alone: what is known of the others stays.
    again, [(walkers, genes, _)] = witnessed(path, monkeypatch, (1,), most_steered=1, certifiers={})
    assert [*walkers] == ["searched"] and len(genes) == 1
    assert again.witnesses.kind[rows].tolist() == [1, *archive.witnesses.kind[rows][1:].tolist()]
    # Another certifier takes nothing from it; another controller of the name has no ways yet.
    kept = judged(path, stages=("others",), certifiers={"S": WEAK})
    assert np.array_equal(kept.witnesses.kind, again.witnesses.kind)
    other = judged(path, stages=("others",), certifiers={"C-G": WEAK}).witnesses
    assert np.flatnonzero(other.walker != "").tolist() == rows[:1].tolist() and other.kind.sum() == 1


def test_of_few_terrains_to_steer_on_one_a_family_comes_first(path, monkeypatch):
    archive = judged(path)
    rows = np.flatnonzero(archive.confirmed & ~archive.certified)
    families = np.full(len(archive), 7)
    families[rows[[3, 4]]] = 2
    write_archive(path / "archive.npz", replace(archive, family=families))
    for most, chosen in ((1, rows[:1]), (2, rows[[0, 3]]), (3, rows[[0, 1, 3]]), (None, rows)):
        _, [(_, genes, _)] = witnessed(path, monkeypatch, most_steered=most)
        assert np.array_equal(genes, archive.genes[chosen])


def test_where_controllers_certify_all_nobody_is_steered(path, monkeypatch):
    archive = judged(path)
    with_goal_rates(path, np.where(archive.is_fault, 0.0, 1.0))
    steered, asked = witnessed(path, monkeypatch, robots=Robots(cross_by_genes, stop_after=0))
    assert not asked and not steered.witnesses.kind.any() and steered.is_fault.sum() == archive.is_fault.sum() > 0
    assert numbers_in(path)["witnesses"]["tried"] == 0 and numbers_in(path)["faults"] == archive.is_fault.sum()


def test_faults_by_ways_alone_are_not_crossed_by_certifiers_again(path, monkeypatch):
    archive, [(walkers, genes, _)] = witnessed(path, monkeypatch)  # before it was confirmed
    assert [*walkers] == ["searched"] and len(genes) == archive.failing.sum()
    assert numbers_in(path)["certified"] == len(genes) and np.array_equal(read_archive(path).certified, archive.failing)
    assert judged(path, stages=("resolved",), certifiers={}).is_fault.any()
    with pytest.raises(ValueError, match=r"stages .* no faults"):
        judged(path, Robots(cross_by_genes, stop_after=0), stages=("varied",), certifiers={})


def test_mujoco_c_steers_where_a_way_certifies(path, monkeypatch):
    before = judged(path)
    archive, _ = witnessed(path, monkeypatch, (3, 0))
    by_ways = archive.is_fault & ~before.is_fault
    robots = Robots(lambda cfg, genes, seeds: np.full(len(genes), not (cfg.with_steering or "C-G" in cfg.policy)))
    held = judged(path, robots, stages=("mujoco_c",))
    assert by_ways.any() and held.holds_in_mujoco_c.tolist() == held.is_fault.tolist()
    assert held.mujoco_c.steered.tolist() == np.where(by_ways[:, None], [6, 0, 0, 0], 0).tolist()
    assert np.array_equal(read_archive(path).mujoco_c.steered, held.mujoco_c.steered)
    # The ways were of C-G, whose file must be there. Where other ways are found, nobody has crossed them yet.
    write_archive(path / "archive.npz", replace(held, certifier_outcomes=0 * held.certifier_outcomes))
    with pytest.raises(ValueError, match=r"certifiers .*C-G"):
        judged(path, Robots(cross_by_genes, stop_after=0), stages=("mujoco_c",), certifiers={})
    nobody = np.where(held.witnesses.walker == "C-G", "nobody", held.witnesses.walker)  # a damaged archive
    write_archive(path / "archive.npz", replace(held, witnesses=replace(held.witnesses, walker=nobody)))
    with pytest.raises(ValueError, match=r"certifiers .*nobody"):
        judged(path, Robots(cross_by_genes, stop_after=0), stages=("mujoco_c",))
    again, _ = witnessed(path, monkeypatch, (3, 0), speed=0.5)
    assert again.mujoco_c is None and "faults_mujoco_c" not in numbers_in(path)


def test_certificates_of_several_controllers_add_up_and_a_new_one_of_the_name_replaces_them(path, tmp_path):
    first = judged(path)
    copy = shutil.copy(OTHER["C-G"], tmp_path / "C-G-2.pt")
    both = judged(path, stages=("others",), certifiers={"specialist": str(copy)})
    assert both.certifiers == ("C-G", "specialist")
    for column in (0, 1):
        assert np.array_equal(both.certifier_outcomes[:, column], first.certifier_outcomes[:, 0])
    assert numbers_in(path)["faults"] == numbers_in(path)["faults_panel"] > 0
    # Another controller of that name crosses nothing. What it was not asked, nobody knows: elites that fail no more
    archive = read_archive(path)
    goal_rate = archive.fresh.goal_rate.copy()
    goal_rate[np.flatnonzero(archive.failing)[1:]] = 1.0
    with_goal_rates(path, goal_rate)
    last = judged(path, stages=("others",), certifiers={"specialist": WEAK})
    assert last.certifiers == ("C-G", "specialist")
    assert last.certifier_sha256[1] == controller_hash(WEAK)
    assert not last.certificates[:, 1].any() and last.certificates[:, 0].any()
    rows = np.flatnonzero(last.certifier_outcomes[:, 1].any(axis=1))
    assert rows.tolist() == np.flatnonzero(archive.failing)[:1].tolist()


def test_the_panel_and_the_certifiers_of_the_run_judge_without_the_searched_controller(path, tmp_path, monkeypatch):
    panel, run_folder = tmp_path / "panel", path / "certifiers"
    for folder, file in ((panel, ROBOTS["anymal"].panel / "S.pt"), (run_folder, OTHER["C-G"])):
        folder.mkdir()
        shutil.copy(SHIPPED, folder / "base.pt")
        shutil.copy(file, folder)
    monkeypatch.setattr(RobotCfg, "panel", panel)
    assert judged(path, certifiers=None).certifiers == ("S", "C-G")


@pytest.mark.parametrize(
    ("named", "changes"),
    [
        ("policy", {"policy": OTHER["C-G"]}),
        ("certifier me", {"certifiers": {"me": SHIPPED}}),
        ("certifier searched", {"certifiers": {"searched": OTHER["C-G"]}}),
        ("certifier C-G", {"certifiers": {"C-G": str(ROBOTS["cassie"].panel / "C-G.pt")}}),
        ("certifier S", {"certifiers": {"S": "sys:exit"}}),
        ("robot", {"robot": "cassie"}),
        ("stages", {"stages": ("varied",)}),
        ("stages", {"stages": ("fresh", "varied")}),
        ("stages", {"stages": ("resolved", "soon")}),
    ],
)
def test_what_cannot_be_judged_is_refused_before_anything_is_crossed(path, named, changes):
    with pytest.raises(ValueError, match=named):
        judged(path, Robots(cross_by_genes, stop_after=0), **changes)


def test_a_run_that_is_not_whole_is_refused_and_stays(path, made, tmp_path):
    nobody = Robots(cross_by_genes, stop_after=0)
    with pytest.raises(FileNotFoundError):
        judged(tmp_path / "gone", nobody)
    with pytest.raises(ValueError, match="fresh"):
        judged(made / "found", nobody)
    (path / "archive.json").write_bytes(b"[]")
    with pytest.raises(ValueError, match=r"archive\.json"):
        judged(path)
    assert (path / "archive.json").read_bytes() == b"[]"
    write_archive(path / "archive.npz", replace(read_archive(path), scales=(1.0,) * 6))
    with pytest.raises(ValueError, match="scales"):
        judged(path, nobody)


def test_where_nothing_fails_nothing_is_crossed(path):
    with_goal_rates(path, np.ones(len(read_archive(path))))
    judged(path, Robots(cross_by_genes, stop_after=0))
    assert numbers_in(path)["faults"] == 0 and numbers_in(path)["certifiers"] == ["C-G"]
