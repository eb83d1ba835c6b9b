"""Gates: how often their tests are wrong and how soon they stop, and verdicts over made-up crossings."""

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from scipy.stats import norm

from qd.evaluate.gate import GateProcess, publish_gate, read_gate
from qd.evaluate.sequential import PairedTest, RateTest, rate_interval
from sim.files.command import run_command
from tests.docs import ROOT
from tests.qd.robots import Robots
from tests.qd.stand_in import compute_by

TERRAINS, ROUNDS = 100, 60
STAND, STRETCH = "tests.sim.policies:stand", "tests.sim.policies:stretch"
CHECK = '[[check]]\nset = "hard_random"\nterrains = 20\n'


def rates_of(rng, mean, count):
    """Rates of packs' terrains, (count, TERRAINS): from Beta(.5, .5), bent so that each pack has the mean asked for."""
    rates = rng.beta(0.5, 0.5, (count, TERRAINS)).clip(1e-9, 1.0)
    low, high = np.full((count, 1), 1e-3), np.full((count, 1), 1e3)
    for _ in range(80):
        power = np.sqrt(low * high)
        larger = (rates**power).mean(axis=1, keepdims=True) > mean
        low, high = np.where(larger, power, low), np.where(larger, high, power)
    return rates ** np.sqrt(low * high)


def run_rate_tests(mean, count=1000, limit=0.5, margin=0.02, error=0.05):
    """Which of so many packs pass, and after how many episodes each stopped."""
    rng = np.random.default_rng(8)
    passes, episodes = [], []
    for rates in rates_of(rng, mean, count):
        goals = rng.random((ROUNDS, TERRAINS)) < rates
        test = RateTest(limit, margin, error)
        for row in goals:
            test.add(int(row.sum()), TERRAINS)
            if test.passes is not None:
                break
        passes.append(test.decide()[0] if test.passes is None else test.passes)
        episodes.append(test.episodes)
    return np.array(passes), np.array(episodes)


@pytest.mark.parametrize("side", [-1, 1])
def test_rates_at_the_margin_are_judged_wrongly_no_more_often_than_stated_and_far_from_it_soon(side):
    """Of 1,000 packs whose terrains differ as much as can be; three standard errors of .05 are .02."""
    passes, _ = run_rate_tests(0.5 + 0.02 * side)
    assert (passes != (side > 0)).mean() <= 0.05 + 0.02
    passes, episodes = run_rate_tests(0.5 + 2 * 0.02 * side)
    fixed = (2 * norm.ppf(0.95) / (2 * 0.02)) ** 2 * 0.25  # episodes of a test of as large errors that does not stop
    assert (passes != (side > 0)).mean() <= 0.01 and np.median(episodes) <= 0.5 * fixed


def run_paired_tests(loss, count=1000, margin=0.05):
    """Which of so many new controllers pass, that lose so many more of the episodes than they win."""
    rng = np.random.default_rng(9)
    passes = []
    for lost in rng.beta(0.5, 0.5, (count, TERRAINS)) * 0.2:  # chance of each terrain that new alone fails
        won = (lost.mean() - loss) * lost / lost.mean()
        test = PairedTest(margin, 0.05)
        for _ in range(ROUNDS):
            draws = rng.random(TERRAINS)
            test.add(int((draws < lost).sum()), int((draws > 1.0 - won).sum()), TERRAINS)
            if test.passes is not None:
                break
        passes.append(test.decide()[0] if test.passes is None else test.passes)
    return np.array(passes)


def test_a_new_controller_as_good_as_the_old_passes_and_one_that_is_worse_by_the_margin_fails():
    assert run_paired_tests(0.0).mean() >= 1.0 - 0.05 - 0.02
    assert run_paired_tests(0.05).mean() <= 0.05 + 0.02


def test_an_interval_holds_whenever_it_is_looked_at():
    """In at most 5 % of 300 packs it ever leaves the mean out, three standard errors allowed for."""
    rng, missed = np.random.default_rng(3), 0
    for rates in rates_of(rng, 0.8, 300):
        goals, outside = 0, False
        for number in range(1, 21):
            goals += int((rng.random(TERRAINS) < rates).sum())
            low, high = rate_interval(goals, number * TERRAINS)
            outside |= not low <= 0.8 <= high
        missed += outside
    assert missed <= 300 * 0.05 + 3 * np.sqrt(300 * 0.05 * 0.95)


@pytest.mark.parametrize(("goals", "count"), [(0, 20), (20, 20), (3999, 4000), (1, 100_000)])
def test_an_interval_has_the_rate_in_it(goals, count):
    low, high = rate_interval(goals, count)
    assert 0.0 <= low <= goals / count <= high <= 1.0 and low < high


def test_a_rate_is_measured_against_the_limit_itself():
    """Between limit and limit + margin a rate passes, however far the likelihoods of both ends are apart."""
    test = RateTest(0.94, 0.05, 0.05)
    test.add(3800, 4000)
    assert test.passes is True
    test = RateTest(0.1, 0.09, 0.05)
    test.add(280, 4000)
    assert test.passes is False and test.decide()[0] is False


@pytest.fixture
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def pass_gate(anymal, text, collide, *, policies=None, junit=None):
    Path("gate.toml").write_text(text)
    robots = Robots(collide)
    policies = policies or {"new": STAND}
    return publish_gate(Path("gate.toml"), anymal, policies, compute_by(robots), Path("out/g.json"), junit)


def share_arrives(share, old=0.9):
    """Robots of the new controller arrive with a chance of ``share``, those of the old one with ``old``; all do so on
    level ground."""

    def collide(cfg, terrains, seeds):
        draws = np.random.default_rng([len(seeds), *seeds[:4].tolist()]).random(len(seeds))
        return (draws >= (share if cfg.policy == STAND else old)) & (terrains.ndim == 2)

    return collide


def test_a_good_controller_passes_and_a_bad_one_fails(anymal, work, monkeypatch):
    summary = work / "step.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    report = pass_gate(anymal, f"{CHECK}limit = 0.6\n", share_arrives(0.9), junit=Path("junit.xml"))
    (check,) = report["checks"]
    assert report["passes"] and check["tests"]["rate"]["stopped"] == "clear" and check["rounds"] < 40
    assert check["goal_interval"][0] < check["goal_rate"]["new"] < check["goal_interval"][1]
    suite = ElementTree.parse("junit.xml").getroot()[0]
    assert [case.get("name") for case in suite.iter("testcase")] == ["level ground", "hard_random"]
    assert (suite.get("tests"), suite.get("failures")) == ("2", "0") and "passes" in summary.read_text()
    report = pass_gate(anymal, f"{CHECK}limit = 0.9\n", share_arrives(0.3), junit=Path("junit.xml"))
    assert not report["passes"] and json.loads(Path("out/g.json").read_text())["passes"] is False
    suite = ElementTree.parse("junit.xml").getroot()[0]
    (failure,) = suite.iter("failure")
    assert suite.get("failures") == "1" and "asked for 0.9" in failure.get("message")
    saved = sorted(Path("out/g").iterdir())
    assert 1 <= len(saved) <= 3 and np.load(saved[0])["heights"].shape == (161, 321)


@pytest.mark.parametrize(("share", "passes"), [(0.6, False), (0.9, True)])
def test_old_and_new_are_paired(anymal, work, share, passes):
    report = pass_gate(anymal, CHECK, share_arrives(share), policies={"old": STRETCH, "new": STAND})
    (check,) = report["checks"]
    test = check["tests"]["paired"]
    assert report["passes"] is passes and check["goal_rate"]["old"] > 0.8 and test["pairs"] == check["episodes"]
    assert passes or (test["lost"] > test["won"] and test["stopped"] == "clear")


def test_a_check_without_a_limit_needs_an_old_controller(anymal, work):
    with pytest.raises(ValueError, match="old controller"):
        pass_gate(anymal, CHECK, share_arrives(0.9))


def test_a_controller_that_does_not_walk_fails_and_is_asked_no_further(anymal, work):
    def never(cfg, terrains, seeds):
        return np.ones(len(seeds), bool)

    report = pass_gate(anymal, f"{CHECK}limit = 0.6\n", never, junit=Path("junit.xml"))
    assert not report["passes"] and report["skipped"] == ["hard_random"] and not report["checks"]
    suite = ElementTree.parse("junit.xml").getroot()[0]
    assert (suite.get("failures"), suite.get("skipped")) == ("1", "1")


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "check"),
        ("[[check]]\n", "pack"),
        ('[[check]]\nset = "elites"\n', "hand_crafted"),
        ('[[check]]\npack = "anymal"\nspace = "course"\n', "space"),
        (f"{CHECK}limit = 0.97\n", "margin"),
        (f"{CHECK}limit = 0.95\n", "margin"),
        ('[[check]]\nset = "hand_crafted"\nspace = "super_gaussian+noise"\n', "space"),
        (2 * f"{CHECK}limit = 0.5\n", "twice"),
        (f'{CHECK}limit = 0.5\nname = "a\\u0001"\n', "name"),
        (f"{CHECK}limits = 0.9\n", "limits"),
        (f"error = 0.7\n{CHECK}limit = 0.5\n", "error"),
        ("check = 3\n", "check"),
    ],
)
def test_a_wrong_gate_is_refused_by_the_name_of_what_is_wrong(work, text, field):
    Path("gate.toml").write_text(text)
    with pytest.raises(ValueError, match=field):
        read_gate(Path("gate.toml"))


@pytest.mark.parametrize(
    "flags",
    [["--junit", "j.xml"], ["--gate", "none.toml"], ["--gate", "g.toml", "--terrains", "3"],
     ["--gate", "g.toml", "--policies", "a=shipped"]],
)  # fmt: skip
def test_errors_are_no_verdicts(work, capsys, flags):
    from qd.commands import EvaluateCommand

    Path("g.toml").write_text(f"{CHECK}limit = 0.6\n")
    assert run_command(EvaluateCommand, [*flags, "--device", "cpu"], name="evaluate") == 2
    assert capsys.readouterr().err.startswith("error:")


def test_a_gate_runs_beside_a_training_and_its_error_is_heard_of(work):
    report = {"checks": [{"name": "kerbs", "goal_rate": {"new": 0.5}, "by_cause": {"drop": 0.25}}]}
    code = f"import json; open('a.json', 'w').write({json.dumps(json.dumps(report))!s})"
    process = GateProcess([sys.executable, "-c", code], Path("a.json"))
    assert process.scalars() == {"gate/kerbs/goal_rate": 0.5, "gate/kerbs/drop": 0.25} and process.ended
    broken = GateProcess([sys.executable, "-c", "import sys; print('no robot'); sys.exit(2)"], Path("b.json"))
    with pytest.raises(RuntimeError, match="no robot"):
        broken.result()
    waiting = GateProcess([sys.executable, "-c", "import time; time.sleep(60)"], Path("c.json"))
    with pytest.raises(TimeoutError):
        waiting.result(0.2)
    assert not waiting.ended
    waiting._process.kill()


STUB = """#!/bin/sh
echo "$*" >> calls
case $1 in evaluate) mkdir -p faultline-gate/gate; touch faultline-gate/gate/kerbs-3.npz; exit $STATUS;; esac
"""


@pytest.mark.parametrize("status", [0, 1, 2])
def test_the_action_runs_the_gate_films_what_fails_and_keeps_its_status(work, status):
    action = yaml.safe_load((ROOT / "action.yml").read_text())
    step = next(step for step in action["runs"]["steps"] if ".ci/gate" in step.get("run", ""))
    asked = {value.removeprefix("${{ inputs.").removesuffix(" }}") for value in step["env"].values()}
    assert asked | {"python"} == set(action["inputs"]) and action["runs"]["using"] == "composite"
    stub = work / "stub"
    stub.write_text(STUB)
    stub.chmod(0o755)
    env = os.environ | {"FAULTLINE": str(stub), "STATUS": str(status), "GATE": "g.toml", "POLICY": "new model.pt"}
    assert subprocess.run([ROOT / ".ci/gate"], env=env | {"OLD": "old.pt"}, check=False).returncode == status
    evaluate, film = Path("calls").read_text().splitlines()
    assert "--gate g.toml --robot anymal --policies old=old.pt new=new model.pt --out" in evaluate
    assert "--policy new model.pt --terrain faultline-gate/gate/kerbs-3.npz --gif --out faultline-gate/kerbs-3" in film
