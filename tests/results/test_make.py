"""The scripts that make published numbers: each runs as a trial, and the pages say what the files say."""

import importlib
import json
import os
import re
import weakref
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.episode import PARKING_HEIGHT, Outcome
from qd.evaluate.tables import terrain_rates
from qd.search import loop
from qd.workers import crosser
from results.make import agreement, bare, common, docs, rounds, speed, tables
from sim.files.provenance import sources_sha256
from sim.rollout import Rollout
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import Terrains
from tests.qd.searches import without_figures
from tests.qd.stand_in import Stub, make_result, result_of

MAKE = Path(common.__file__).parent
SCRIPTS = (
    "agreement", "base", "conditions", "crossed", "dose", "map_training", "minimal", "pack", "penalty_ratios",
    "search", "search_noise", "spaces", "speed", "tables", "witness",
)  # fmt: skip
"""Those that call all that the others call."""
FILES = {name: f"{name}.json" for name in SCRIPTS} | {"minimal": "archive/minimal.json", "pack": "pack/pack.json"}

GOAL, HIT, LATE, INVALID = Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.INVALID

OURS = terrain_rates(result_of([[GOAL, GOAL, HIT, LATE], [HIT, HIT, HIT, INVALID], [INVALID] * 4, [GOAL] * 4]))
THEIRS = terrain_rates(result_of([[GOAL, LATE, LATE, LATE], [GOAL, HIT, HIT, HIT], [GOAL] * 4, [INVALID] * 4]))


@contextmanager
def open_made_up(cfg):
    """Half of the episodes are too late, wherever they are."""

    def cross(terrains, seeds):
        rng, shape = np.random.default_rng(int(seeds[0])), (len(seeds), cfg.replicas)
        result = make_result(rng.uniform(0.5, 2.0, (*shape, 6)), late=rng.uniform(size=shape) < 0.5)
        return replace(result, reward=np.ones(shape) if cfg.reward else None)

    yield Stub(cross)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_trial_writes_its_file(name, tmp_path, monkeypatch):
    script = importlib.import_module(f"results.make.{name}")
    monkeypatch.setattr(crosser, "open_pipeline", open_made_up)
    monkeypatch.setattr(loop, "open_pipeline", open_made_up)
    without_figures(monkeypatch)
    monkeypatch.setattr(speed, "open_pipeline", open_made_up)
    (tmp_path / "results").symlink_to(MAKE.parent)
    monkeypatch.chdir(tmp_path)  # made-up crossings are stored under runs/ here
    out = tmp_path / "anymal" / FILES[name]
    script.main(["--small", "--device", "cpu", "--out", str(out)])
    report = json.loads(out.read_text())
    assert {"command", "commit", "sources_sha256", "dirty", "device", "versions", "seed", "date"} <= report.keys()
    assert report["robot"] == "anymal" and report["sources_sha256"] == sources_sha256()


def test_doses_are_the_bases_by_todays_sources(tmp_path):
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "anymal/spaces.json")], "spaces.json")
    file, origin = tmp_path / "anymal/dose.json", {**script.origin, "sources_sha256": sources_sha256()}
    rows = [{"controller": one, "parameter": of} for one in ("base", "C-G") for of in ("push", "height")]
    file.write_text(json.dumps({**origin, "dose": rows}))
    assert [script.read_dose(conditions=one) for one in (True, False)] == [rows[:1], rows[1:2]]
    file.write_text(json.dumps({**origin, "seed": 1, "dose": rows}))
    with pytest.raises(ValueError, match="must be of today's sources"):
        script.read_dose(conditions=True)


def test_a_part_is_measured_once_by_the_same_sources(tmp_path):
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "anymal/some.json")], "some.json")
    numbers = iter(range(9))
    first, again, anew = *2 * [tmp_path / "parts/one.json"], tmp_path / "old.json"
    anew.write_text(json.dumps({**script.origin, "sources_sha256": "0" * 64, "numbers": {"count": 7}}))
    made = [common.measure_once(script, file, lambda: {"count": next(numbers)}) for file in (first, again, anew)]
    assert [part["count"] for part in made] == [0, 0, 1]
    assert {key: made[1][key] for key in ("commit", "device")} == {
        key: script.origin[key] for key in ("commit", "device")
    }


def test_what_is_published_goes_with_its_archive(tmp_path):
    """What lies beside another archive is taken away; beside the same one it stays."""
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "anymal/base.json")], "base.json")
    run, folder = tmp_path / "run", tmp_path / "published"
    for place in (run, folder):
        place.mkdir()
        (place / "archive.npz").write_text("one")
    (folder / "minimal.json").write_text("{}")
    script.publish(run, folder, ("archive.npz", "minimal.*"))
    assert (folder / "minimal.json").exists()
    (run / "archive.npz").write_text("another")
    script.publish(run, folder, ("archive.npz", "minimal.*"))
    assert not (folder / "minimal.json").exists() and (folder / "archive.npz").read_text() == "another"


def test_every_script_loads_and_is_listed():
    scripts = {file.stem for file in MAKE.glob("*.py")} - {"bare", "publishers"}
    text = (MAKE / "all.sh").read_text()
    assert all(hasattr(importlib.import_module(f"results.make.{name}"), "main") for name in scripts - {"common"})
    assert [name for name in scripts if f" {name} " not in text and f"make.{name}" not in text] == []


def test_a_file_of_other_sources_or_of_a_trial_is_not_current(tmp_path):
    file, ours = tmp_path / "base.json", {"sources_sha256": sources_sha256()}
    assert not common.is_current(file)
    for content in (ours, {"sources_sha256": "0" * 64}, {**ours, "small": True}, [], None):
        file.write_text(json.dumps(content) if content is not None else "{")
        assert common.is_current(file) == (content == ours)


def test_training_rates_are_of_the_same_device(tmp_path):
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "speed.json")], "speed.json")
    row = {"gpus": 1, "num_envs": 4096, "train_env_steps_per_s": 7.0, "device": "cuda:0"}
    peer = {**row, "peer": "mjlab 1", "train_env_steps_per_s": 2.0}
    rows = [row, {**row, "num_envs": 8192, "device": "cuda:1"}, peer]
    file = tmp_path / "train_speed.json"
    file.write_text(json.dumps({**script.origin, "rows": rows}))
    rates = speed.training_rates(script, "cuda:0")
    assert [rates[f"train_env_steps_per_s{key}"] for key in ("", "_8192", "_mjlab")] == [7.0, None, 2.0]
    file.write_text(json.dumps({**script.origin, "rows": rows, "sources_sha256": "0" * 64}))
    assert speed.training_rates(script, "cuda:0")["train_env_steps_per_s"] is None


def test_two_checkouts_are_timed_in_turns(tmp_path, monkeypatch):
    """Medians 11 and 10 of 10, 11, 11, 20 and 10, 10, 10, 40; the rounds' ratios are 1, 1.1, 1.1 and .5."""
    other = tmp_path / "other"
    rates = {Path.cwd(): iter((10, 11, 11, 20)), other: iter((10, 10, 10, 40))}

    def run(command, *, cwd, env, **how):
        assert env["PYTHONPATH"].partition(os.pathsep)[0] == str(cwd) and "--against" not in command
        return SimpleNamespace(stdout=f"compiling\n{json.dumps([cwd.name, next(rates[cwd])])}\n")

    monkeypatch.setattr(speed, "subprocess", SimpleNamespace(run=run, PIPE=None))
    flags = ["--device", "cpu", "--out", str(tmp_path / "speed.json"), "--against", str(other)]
    numbers = speed.time_against(common.parse(None, flags, "speed.json", against="help"))["against"]
    assert numbers["ratio"] == 1.1 and numbers["sources_sha256"] == [Path.cwd().name, "other"]
    assert numbers["rates"] == [[10, 10], [11, 10], [11, 10], [20, 40]]
    low, high = numbers["ratio_interval"]
    assert low + high == pytest.approx(2 * (1 + 1.1 + 1.1 + 0.5) / 4) and low < 0.5


def test_a_file_is_not_written_if_the_sources_changed_or_it_cannot_be(tmp_path, monkeypatch):
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "base.json")], "base.json")
    monkeypatch.setattr(common, "sources_sha256", lambda: "0" * 64)
    with pytest.raises(RuntimeError, match="sources"):
        script.write({})
    with pytest.raises(ValueError, match="directory"):
        common.parse(None, ["--device", "cpu", "--out", str(tmp_path)], "base.json")
    assert [*tmp_path.iterdir()] == []


def test_robots_that_have_ended_are_left_out_of_bare_physics(anymal, device):
    # Two robots for 60 control steps, of which the first 10 of every 20 are replayed. One ends behind the 15th: of
    # (2 + 1 + 1) * 10 control steps, 4 physics steps each, count.
    robot = replace(anymal, max_duration_s=1.2)
    rollout = Rollout(robot, anymal.policy_file, num_terrains=1, replicas=2, device=device)
    steps, step = [], rollout.control_step

    def end_one():
        step()
        steps.append(None)
        if len(steps) == 15:
            rollout.outcome.assign([rollout.outcome.numpy()[0], Outcome.TIME_OUT])

    rollout.control_step = end_one
    level = Terrains(heights=np.zeros((1, NUM_ROWS, NUM_COLS), np.float32), seeds=np.zeros(1, np.uint32))
    motion = bare.Motion(rollout.sim, bare.record_segments(rollout, level))
    assert motion.robot_steps == 160
    assert motion.replay() > 0.0 and rollout.sim.parked.numpy().tolist() == [0, 2]
    assert rollout.sim.joint_q.numpy()[1, 2] == PARKING_HEIGHT
    owner = Stub(None)  # of arrays, of which a graph has the addresses alone
    kept, beside = weakref.ref(owner), bare.Motion(rollout.sim, [], partial(bool, owner))
    del owner
    beside.stand(1)
    assert kept() is not None


def test_means_over_seeds():
    # Of 1, 2 and 6 the mean is 3 and the standard deviation sqrt(7); t at 97.5 % and 2 degrees of freedom is 4.303.
    half = 4.303 * np.sqrt(7) / np.sqrt(3)
    numbers = common.mean_over_seeds("elites", [1, 2, 6])
    assert numbers["elites"] == 3
    assert numbers["elites_interval"] == pytest.approx([3 - half, 3 + half], rel=1e-3)
    assert common.mean_over_seeds("faults", [1, None]) == {"faults": None, "faults_interval": None}
    assert common.t_interval(np.array([1.0])) is None


def test_rates_are_of_valid_episodes():
    np.testing.assert_array_equal(OURS["success"], [0.75, 0.0, np.nan, 1.0])
    np.testing.assert_array_equal(OURS["goal"], [0.5, 0.0, np.nan, 1.0])
    rates = terrain_rates(result_of([[INVALID, GOAL, GOAL, HIT], [INVALID, INVALID, GOAL, GOAL]]))
    np.testing.assert_array_equal(rates["goal"], [2 / 3, np.nan])  # more than a quarter of the second's are invalid


def compare(chosen, families=None):
    """How some terrains by other episodes compare with ours, crossed in all other ways alike."""
    ours, theirs = ({name: values[chosen] for name, values in rates.items()} for rates in (OURS, THEIRS))
    ways = {"search": ours, "resolved": ours, "again": theirs, "mujoco_c": theirs}
    return agreement.compare(ways, np.arange(4)[chosen] if families is None else families, 0)["again"]


def test_bias_and_distance_are_of_terrains_that_both_have():
    # Success .75 and 0 against 1 and .25: both .25 lower. Goal .5 and 0 against .25 and .25: once more, once less.
    numbers = compare(slice(None))
    assert numbers["terrains"] == 2
    assert numbers["success_bias"] == -0.25 and numbers["success_difference"] == 0.25
    low, high = numbers["success_bias_interval"]  # two terrains say little, though they agree
    assert -1.0 < low < -0.5 and 0.2 < high < 0.5
    assert numbers["goal_bias"] == 0.0 and numbers["goal_difference"] == 0.25
    low, high = numbers["goal_bias_interval"]
    assert -0.8 < low < -0.25 and high == pytest.approx(-low)
    assert compare(slice(None), families=np.zeros(4, np.int64))["goal_bias_interval"] is None
    numbers = compare(slice(2, None))
    assert numbers.pop("terrains") == 0 and set(numbers.values()) == {None}


def test_agreement_with_mujoco_c_has_the_difference_of_each_terrain_crossed_there():
    swapped = {name: values[[1, 0, 2, 3]] for name, values in OURS.items()}
    in_mujoco_c = {name: values[:3] for name, values in THEIRS.items()}
    ways = {"search": OURS, "again": OURS, "resolved": swapped, "mujoco_c": in_mujoco_c}
    numbers = agreement.compare(ways, np.arange(4), 0)
    # Goal .5, 0 and invalid, resolved 0, .5 and invalid, against .25, .25 and 1
    assert numbers["mujoco_c"]["goal_differences"] == [0.25, -0.25, None]
    assert numbers["both_resolved"]["goal_differences"] == [-0.25, 0.25, None]
    assert [numbers[name]["terrains"] for name in ("again", "mujoco_c")] == [3, 2]


def test_routes_and_pushes_are_hard_random_of_their_own_spaces(tmp_path):
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "agreement.json")], "agreement.json")
    sets = {name: agreement.draw_set(script, name) for name in agreement.IN_MUJOCO_C}
    assert [len(genes) for genes, _ in sets.values()] == [300, 150, 40, 40]
    assert [space for _, space in sets.values()][2:] == ["super_gaussian+command", "super_gaussian+pushes"]
    heights = [genes[:, :64] for genes, _ in sets.values()]
    assert not any((heights[0][0] == others[0]).all() for others in heights[1:]) and heights[2].std() > 0.5


def test_differences_are_of_the_later_kind_minus_the_earlier():
    rates = {"C-HR": np.full(24, 0.75), "C-G": np.full(24, 0.52), "C-G@1": np.full(24, 0.5)}
    [(pair, row)] = tables.differences_of(rates, np.arange(24), 0).items()
    assert pair == "C-G - C-HR" and row["goal"] == pytest.approx(0.51 - 0.75) and row["seeds"] == [2, 1]


def test_pages_say_what_the_files_say():
    assert docs.main(["--check"]) == 0


def test_a_picture_is_old_once_what_it_shows_is_another(tmp_path, monkeypatch):
    monkeypatch.setattr(docs, "ROOT", tmp_path)
    (tmp_path / "docs/pictures").mkdir(parents=True)
    assert docs.find_old_pictures() == {}
    numbers, archive = tmp_path / "numbers.json", tmp_path / "archive.npz"
    numbers.write_text('{"dogs": {"a": 1, "b": 2}}')
    archive.write_bytes(b"elites")
    for name in ("a.gif", "plain.png", "unknown.jpg"):
        (tmp_path / "docs/pictures" / name).touch()
    docs.note_picture("a.gif", "archive.npz", "numbers.json#dogs/a")
    docs.note_picture("plain.png")
    assert docs.find_old_pictures() == {"unknown.jpg": docs.MADE}
    numbers.write_text('{"dogs": {"a": 1, "b": 3}}')
    assert "a.gif" not in docs.find_old_pictures()
    numbers.write_text('{"dogs": {"a": 4, "b": 3}}')
    assert docs.find_old_pictures()["a.gif"] == "numbers.json#dogs/a"
    docs.note_picture("a.gif", "archive.npz")
    archive.unlink()
    assert docs.find_old_pictures()["a.gif"] == "archive.npz"
    for absent in ("archive.npz", "numbers.json#dogs/c"):
        with pytest.raises(FileNotFoundError, match=absent):
            docs.note_picture("a.gif", absent)


def test_a_table_is_written_between_its_marks(tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("Before.\n<!-- table: spaces -->\nold\n<!-- end -->\nBehind.\n")
    counts = {"space": "course", "elites": 1234, "faults": None}
    monkeypatch.setattr(docs, "ROOT", tmp_path)
    monkeypatch.setattr(docs, "read_robots", lambda file: {"Dog": {"spaces": {"course": counts}}})
    assert docs.main(["--check"]) == 1 and docs.main([]) == 0 and docs.main(["--check"]) == 0
    lines = ["Before.", "<!-- table: spaces -->", "|  | elites |", "|---|---|", "| Dog, course | 1,234 |"]
    assert (tmp_path / "README.md").read_text().splitlines() == [*lines, "<!-- end -->", "Behind."]
    with pytest.raises(ValueError, match="absent"):
        docs.with_tables("<!-- table: absent -->\n<!-- end -->")


def test_a_cell_is_a_number_with_its_interval():
    rows = {"a": {"share": 0.5, "share_interval": [0.2, 1.0]}, "b": {"share": 0.25}}
    columns = {"cm": docs.shown("share", form=".1f", factor=100), "rate": docs.shown("share", form=".2f")}
    made = docs.table(rows, columns, upright=True)
    assert made.splitlines()[2:] == ["| cm | 50.0 (20.0 to 100.0) | 25.0 |", "| rate | 0.50 (0.20 to 1.00) | 0.25 |"]


def test_a_hardening_that_kept_no_round_has_no_controller_to_search_or_compare(tmp_path, monkeypatch):
    script = common.parse(None, ["--small", "--out", f"{tmp_path}/rounds.json"], "rounds.json")
    kept = {
        "rounds": [{"tuned": None, "kept": None}, {"tuned": "tune-1", "kept": True}, {"tuned": "tune-2", "kept": False}]
    }
    monkeypatch.setattr(rounds, "harden_here", lambda script, seed: kept if seed else {"rounds": kept["rounds"][::2]})
    monkeypatch.setattr(rounds, "train", lambda *given: pytest.fail("it is trained for nothing"))
    monkeypatch.setattr(rounds, "write_tables", lambda *given: pytest.fail("it is compared"))
    assert [rounds.controller_of(script, name, 0) for name in ("base", "hardening")] == [None, None]
    assert rounds.controller_of(script, "hardening", 1) == script.runs / "hardening-1" / "tune-1" / "policy.pt"
    with pytest.raises(ValueError, match="hardening 0 must have kept a round"):
        rounds.search_again(script, "hardening", 0)
    rounds.compare(script)


def test_tables_of_witnesses_tell_certificates_by_controllers_from_others(monkeypatch):
    found = {"tried": 9, "line": 3, "own_line": 2, "beside": 2, "around": 1}
    judged = {"witnesses": found, "fault_families": 6, "fault_families_controllers": 5, "faults_controllers": 4}
    judged |= {"faults_witness": 3, "wall_s": 7.0, "judged_by": {"steered": {"wall_s": 90.0}}}
    point = {"episodes": 20, "line": 0.25, "beside": 0.5, "around": 0.75}
    curve = [point | {"limit_m": 0.5, "line": 0.375}, point | {"limit_m": None}]
    numbers = {"control": {"tried": 9, "line": 0, "beside": 0, "around": 1}, "curve": curve}
    files = {"results/dog/archive/archive.json": judged, "results/dog/witness.json": numbers}
    monkeypatch.setattr(docs, "ROBOTS", {"dog": "Dog", "cat": "Cat"})
    monkeypatch.setattr(docs, "read", lambda file: files.get(file, {}))
    assert docs.witnesses().splitlines()[2:] == [
        "| Dog | 9 | 3 | 2 | 2 | 1 | 4 | 3 | 5 | 6 | 1.5 |",
        "| Dog, plain crossings in their place | 9 | 0 | - | 0 | 1 | - | - | - | - | - |",
    ]
    assert docs.witness_curve().splitlines()[2:] == ["| 20 episodes | 0.38 | 0.75 |"]
    monkeypatch.setattr(docs, "ROBOTS", {"dog": "Dog"})
    held = {"hold": 5, "tried": 6, "strong": {"hold": 2, "tried": 3}}
    monkeypatch.setattr(docs, "ROBOTS", {"dog": "Dog"})
    files = {"results/dog/archive/archive.json": {"faults_mujoco_c": held, "elites": 9, "wall_s": 90.0, "robot": "dog"}}
    files |= {"results/dog/archive_cma_mae/archive.json": {"elites": 8, "wall_s": 1800.0, "episodes": 5}}
    monkeypatch.setattr(docs, "PAPER", "paper")
    monkeypatch.setattr(docs, "read", lambda file: files.get(file, {"dog": {"archive": {"elites": 7, "hours": 2}}}))
    assert docs.archives().splitlines()[-1] == "| ... that hold in MuJoCo C, of some | 5 of 6; strong: 2 of 3 | - |"
    assert docs.first().splitlines()[2:] == [
        "| elites as found, in the paper | 7 |",
        "| ... by the paper's method, here | 8 |",
        "| ... by the default method | 9 |",
        "| minutes that this search took | 2 |",
    ]
    assert docs.paper_archives().splitlines()[2:] == ["| elites | 8 | 7 |", "| hours | 0.5 | 2.0 |"]


def test_tables_of_searches_have_a_sign_where_they_are_differences(monkeypatch):
    counts = {"failing": 100.0, "failing_interval": [90.0, 1100.0], "uncrossed_share": 0.5}
    difference = {"failing": -5.0, "uncrossed_share": 0.125, "uncrossed_share_interval": [-0.25, 0.5]}
    searches = [{"weight": 0.0, "failing": 7}, {"weight": 0.8, "failing": 8}, {"weight": 0.8, "failing": 9}]
    weights = {"0": counts, "0.8": counts | {"failing": 1234.5}}
    numbers = {"chosen": 0.8, "weights": weights, "difference": difference, "searches": searches}
    monkeypatch.setattr(docs, "read_robots", lambda file: {"Dog": numbers})
    assert docs.crossed().splitlines()[2:] == [
        "| Dog, without | 100 (90 to 1,100) | 0.500 |",
        "| Dog, with it | 1,234 (90 to 1,100) | 0.500 |",
        "| Dog, difference | -5 | +0.125 (-0.250 to +0.500) |",
    ]
    assert docs.crossed_weights().splitlines()[2:] == ["| Dog, weight 0 | 7 |", "| Dog, weight 0.8 | 8 |"]


def test_tables_of_conditions_have_both_searches(monkeypatch):
    def search(kinds, **counts):
        return counts | {"needed": kinds, "nominal_passes": 5, "examples": [{"elite": 3, "needs": "push_1"}]}

    whole = search({"lag": 4}, failing_again=6)
    numbers = {"archive": {"episodes": 70, "failing": 9}, "conditions": whole, "searches": {"conditions": [whole]}}
    numbers["searches"]["route"] = [search({"segment_1": 1, "push_1": 2}, episodes=80, failing=8)]
    numbers["means"] = {"route": {"seeds": 3, "failing": 8.4, "failing_interval": [7.0, 9.0]}}
    minimum = {"elite": 3, "bumps": [2, 9], "words": ["bump", "pushed"], "goal_rate": 0.25, "verdict": "fault"}
    files = {"results/anymal/conditions.json": numbers, "results/anymal/route/minimal.json": {"elites": [minimum]}}
    monkeypatch.setattr(docs, "read", lambda file: files.get(file, {}))
    lines = docs.conditions().splitlines()
    assert lines[0] == "|  | ANYmal C | ANYmal C, routes |"
    wanted = ("| failing | 9 | 8 |", "| ... with nominal lag | 4 | - |", "| ... with nominal push_1 | - | 2 |")
    assert [line for line in wanted if line not in lines] == []
    assert docs.condition_searches().splitlines()[-1] == "| failing | 8 (7 to 9) |"
    assert docs.condition_examples("route").splitlines()[2:] == ["| push_1 | 1 bump | pushed | 0.25 | fault |"]
    assert len(docs.condition_examples().splitlines()) == 2


def test_the_table_of_trainings_with_errors_of_the_map_has_the_base_and_means(monkeypatch):
    base = {"failing": {"held_out": 9}, "goal": {"hard_random": 0.5}, "search": {"failing_distinct": 100}}
    interval = {"failing_distinct": 40.0, "failing_distinct_interval": [30.0, 50.0]}
    means = {"seeds": 3, "failing": {"held_out": 4.5}, "goal": {"hard_random": 0.75}, "search": interval}
    numbers = {"controllers": {"base": base}, "means": {"with": means}, "crossings": {"terrains": {"held_out": 12}}}
    monkeypatch.setattr(docs, "read_robots", lambda file: {"Dog": numbers})
    assert docs.map_training().splitlines() == [
        "|  | Dog: base | Dog: C-G with errors of the map (3) |",
        "|---|---|---|",
        "| failing elites held out | 12 | - |",
        "| ... failing again | 9.0 | 4.5 |",
        "| goal, hard-random | 0.500 | 0.750 |",
        "| searched anew: failing distinct | 100 | 40 (30 to 50) |",
    ]


def test_a_table_without_its_file_is_empty(monkeypatch):
    monkeypatch.setattr(docs, "read", lambda file: {})
    tables = (docs.witnesses, docs.witness_curve, docs.crossed, docs.crossed_weights, docs.league)
    tables += (docs.conditions, docs.condition_searches, docs.map_training, docs.league_routes)
    assert {make() for make in tables} == {docs.table({}, {})}


def test_a_rate_of_training_names_the_packages_of_another_learner():
    rows = [{"train_env_steps_per_s": 2000.4}, {"train_env_steps_per_s": 7.0, "versions": {"a": "1.2"}}]
    row = {"ours": 2000.4, "theirs": 7.0, "lost": 3.0, "training": rows}
    cells = [docs.trained(key)(row) for key in ("ours", "theirs", "lost", "absent")]
    assert cells == ["2,000", "7 (a 1.2)", "-", "-"]


def test_results_name_no_path_of_the_machine_that_made_them():
    files = [file for kind in ("*.json", "*.jsonl") for file in MAKE.parent.rglob(kind)]
    place = re.compile(r"(?<![\w.])/(tmp|home|root|work|opt|mnt|usr)/")
    assert files and [str(file) for file in files if place.search(file.read_text())] == []
