"""Ray workers: how terrains are spread changes nothing, and no failure of a worker loses or alters a result."""

import dataclasses
import os
import time

import numpy as np
import pytest

from qd.run.directory import RunDirectory
from qd.workers.evaluator import EvaluatorCfg, EvaluatorError, open_evaluator, resolve_device
from qd.workers.shards import flaw_of
from tests.qd import crossers, stand_in
from tests.qd.searches import run, without_figures
from tests.qd.workers.test_evaluator import same

pytestmark = pytest.mark.ray

ray = pytest.importorskip("ray")

CFG = EvaluatorCfg(robot="anymal", policy="p", num_terrains=8, num_replicas=4, device="cpu", workers="ray:2")
GENES = np.random.default_rng(0).uniform(-1, 1, (21, 64)).astype(np.float32)
SEEDS = np.arange(100, 121, dtype=np.uint32)


@pytest.fixture(autouse=True, scope="module")
def cluster():
    """One Ray for all tests of the file, ended after them."""
    resolve_device("cpu", "ray:4")
    yield
    ray.shutdown()


def expected(count):
    return stand_in.evaluate(GENES[:count], SEEDS[:count], 4)


@pytest.mark.parametrize("name", ["{}/model.pt", "{}/mine.py:act", "{}/mine.py:adapt@{}/model.pt", "os.path:join"])
def test_the_files_of_a_controller_travel(tmp_path, name):
    from qd.workers.ray_workers import Controller

    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir(), there.mkdir()
    (here / "model.pt").write_bytes(b"weights")
    (here / "mine.py").write_bytes(b"x = 1")
    controller = Controller.of(name.format(here, here))
    unpacked = controller.unpacked(str(there))
    assert unpacked == name.format(there, there)
    content = {"model.pt": b"weights", "mine.py": b"x = 1"}
    assert {file.name: file.read_bytes() for file in there.iterdir()} == {
        file: text for file, text in content.items() if file in name
    }


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_how_terrains_are_spread_changes_nothing(workers):
    with open_evaluator(dataclasses.replace(CFG, workers=f"ray:{workers}"), build=crossers.Crosser) as evaluate:
        for count in (1, 8, 21):
            seen = []
            result = evaluate(GENES[:count], SEEDS[:count], seen.append)
            assert same(result, expected(count))
            assert seen == sorted(seen) and seen[-1] == 1.0
        status = evaluate.status()
    assert (status.workers, status.retries) == (workers, 0)
    assert len(status.episodes_per_s) == workers and min(status.episodes_per_s) > 0
    assert f"{workers} worker" in str(status) and "episodes/s" in str(status)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("die", "failed: "),
        ("hang", "made no progress for 3 s"),
        ("raise", "failed: RuntimeError: the solver is broken"),
        ("nan", "answered with nonsense: valid episodes with penalties"),
        ("short", "answered with nonsense: penalties of shape (3, 4, 6)"),
        ("nonsense", "answered with nonsense: no result"),
    ],
)
def test_a_failed_shard_is_crossed_again_by_another(tmp_path, capsys, monkeypatch, how, says):
    if how == "hang":
        monkeypatch.setattr("qd.workers.ray_workers._HANG_S", 3.0)
    cfg = dataclasses.replace(CFG, policy=f"{how}:{tmp_path}:1")
    with open_evaluator(cfg, build=crossers.Failing) as evaluate:
        first = evaluate(GENES[:8], SEEDS[:8])
        again = evaluate(GENES[:8], SEEDS[:8])
        status = evaluate.status()
    assert same(first, expected(8)) and same(again, expected(8))
    assert status.retries == 1
    assert f"worker {'1' if 'worker 1 ' in (said := capsys.readouterr().err) else '2'} (process" in said
    assert says in said and "are crossed again by another" in said


def test_a_worker_that_died_is_started_again(tmp_path):
    cfg = dataclasses.replace(CFG, policy=f"die:{tmp_path}:2")
    with open_evaluator(cfg, build=crossers.Failing) as evaluate:
        evaluate(GENES[:8], SEEDS[:8])
        end = time.monotonic() + 60
        while evaluate.status().workers < 2:
            assert time.monotonic() < end
            assert same(evaluate(GENES[:8], SEEDS[:8]), expected(8))
        assert evaluate.status().retries == 2


def test_three_deaths_in_a_search_change_nothing(tmp_path, monkeypatch):
    without_figures(monkeypatch)
    alone = run(tmp_path / "alone")

    def deadly(cfg):
        cfg = dataclasses.replace(cfg, workers="ray:2", policy=f"die:{tmp_path}:3")
        return open_evaluator(cfg, build=crossers.Failing)

    found = run(tmp_path / "on-ray", open_evaluator=deadly)
    assert RunDirectory(tmp_path / "on-ray").read_metrics()[-1]["retries"] == 3
    for name in ("genes", "cell", "iteration", "fitness", "ratios"):
        np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))


@pytest.mark.parametrize(("how", "error"), [("refuse", ValueError), ("raise", EvaluatorError), ("nan", EvaluatorError)])
def test_a_shard_that_fails_everywhere_ends_the_evaluation(tmp_path, how, error):
    cfg = dataclasses.replace(CFG, policy=f"{how}:{tmp_path}:99")
    with (
        open_evaluator(cfg, build=crossers.Failing) as evaluate,
        pytest.raises(error, match=r"terrains \d to \d failed 5 times; the last time worker \d"),
    ):
        evaluate(GENES[:8], SEEDS[:8])


def test_a_refusal_to_build_comes_before_any_work():
    with (
        pytest.raises(
            ValueError, match="cannot build its simulation: ValueError: policy 'x' does not fit: use another"
        ),
        open_evaluator(CFG, build=crossers.Refusing),
    ):
        pass


def test_what_an_interrupted_evaluation_had_under_way_is_of_no_later_one():
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    with open_evaluator(CFG, build=crossers.Crosser) as evaluate:
        with pytest.raises(KeyboardInterrupt):
            evaluate(GENES[:8], SEEDS[:8], interrupt)
        for first in (8, 13):
            part = slice(first, first + 8)
            assert same(evaluate(GENES[part], SEEDS[part]), stand_in.evaluate(GENES[part], SEEDS[part], 4))


def test_a_worker_of_other_code_is_refused_and_the_others_go_on(capsys):
    with open_evaluator(CFG, build=crossers.Crosser) as evaluate:
        evaluate._code = "another"
        evaluate._workers[0].restart()
        end = time.monotonic() + 60
        while len(evaluate._workers) == 2:
            assert time.monotonic() < end
            assert same(evaluate(GENES[:8], SEEDS[:8]), expected(8))
        assert same(evaluate(GENES[:8], SEEDS[:8]), expected(8))
        assert "has other code or packages" in capsys.readouterr().err
        evaluate._workers[0].restart()
        with pytest.raises(EvaluatorError, match=r"no worker can be used: worker 2 .* has other code"):
            evaluate(GENES[:8], SEEDS[:8])


def test_leaving_ends_the_workers():
    with open_evaluator(CFG, build=crossers.Crosser) as evaluate:
        evaluate(GENES[:2], SEEDS[:2])
        pids = [int(worker.where.split()[1]) for worker in evaluate._workers]
    end = time.monotonic() + 20
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        assert time.monotonic() < end, "a worker outlives its evaluator"
        time.sleep(0.1)


@pytest.mark.parametrize(
    ("device", "workers", "message"),
    [
        ("cuda:1", "ray:2", "device must be cpu or cuda, got cuda:1"),
        pytest.param(
            "cuda",
            "ray",
            "the cluster has no GPU",
            marks=pytest.mark.skipif(os.path.exists("/dev/nvidia0"), reason="has"),
        ),
    ],
)
def test_devices_that_cannot_be_had(device, workers, message):
    with pytest.raises(ValueError, match=message):
        resolve_device(device, workers)


def test_flaws_are_found():
    result = expected(3)
    assert flaw_of(result, 3, 4) is None
    for change, says in [
        ({"penalties": result.penalties[:2]}, "penalties of shape"),
        ({"penalties": result.penalties[..., :5]}, "penalties of shape"),
        ({"penalties": result.penalties - 100.0}, "negative"),
        ({"penalties": result.penalties * np.inf}, "not finite"),
        ({"base_collision": np.ones((3, 4), bool)}, "several outcomes"),
        ({"duration_s": np.zeros((3, 4), np.float32)}, "no time"),
        ({"physics_steps": 0}, "no time"),
        ({"reward": np.full((3, 4), np.nan)}, "rewards that are not finite"),
        ({"reward": np.zeros((3, 3))}, "reward of shape (3, 3)"),
    ]:
        assert says in flaw_of(dataclasses.replace(result, **change), 3, 4)


def test_for_debugging_an_error_of_a_worker_brings_its_traceback(monkeypatch):
    monkeypatch.setenv("FAULTLINE_DEBUG", "1")
    with (
        pytest.raises(ValueError, match=r"(?s)use another.*crossers\.py\", line \d+"),
        open_evaluator(CFG, build=crossers.Refusing),
    ):
        pass
