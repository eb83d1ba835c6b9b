import multiprocessing
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from qd.workers import pipeline as module
from qd.workers.compute import Compute, parse_workers
from qd.workers.crosser import open_pipeline
from qd.workers.pipeline import PipelineCfg
from qd.workers.process import EvaluatorError
from sim.robots.find import get_robot
from sim.terrains.terrains import Terrains
from tests.qd import stand_in
from tests.qd.stand_in import assert_same

CFG = PipelineCfg(robot="anymal", policy="p", num_terrains=6, replicas=4, compute=Compute(workers="1"))
GENES = np.random.default_rng(0).uniform(-1, 1, (15, 64)).astype(np.float32)
SEEDS = np.arange(100, 115, dtype=np.uint32)


class Crosser(stand_in.Crosser):
    """Crosses by the stand-in; time and steps say with which seed a shard begins."""

    def take(self, progress=None):
        steps = int(self.lots[0].seeds[0])
        if self.cfg.policy == f"refuse at {steps}":
            raise ValueError("terrains of another kind")
        return replace(super().take(progress), wall_s=float(steps), physics_steps=steps, robot_steps=steps)


class Echo(stand_in.Crosser):
    """Returns the terrains as penalties."""

    def take(self, progress=None):
        return replace(stand_in.evaluate(np.zeros((2, 64)), SEEDS[:2]), penalties=self.lots.pop(0).heights)


def drawn(rows):
    """Some of the terrains."""
    return Terrains(genes=GENES[rows], seeds=SEEDS[rows])


def test_workers_as_the_command_line_names_them():
    assert [parse_workers(text) for text in (None, "4", "ray", "ray:16")] == [
        (False, None), (False, 4), (True, None), (True, 16)
    ]  # fmt: skip
    for text in ("", "0", "1.5", "auto", "ray:0", "ray4", "9999999"):
        with pytest.raises(ValueError, match="workers"):
            parse_workers(text)


@pytest.mark.parametrize(
    ("num_terrains", "replicas", "workers", "processes", "terrains"),
    [
        (8, 4, "2", 2, 4),
        (6, 4, "4", 4, 2),
        (3, 4, "8", 3, 1),  # no more processes than terrains
        (8, 1, "8", 2, 4),  # no fewer than 4 robots each
        (1, 1, "8", 1, 4),
        (9, 4, None, 3, 3),  # one a core
    ],
)
def test_sizes(monkeypatch, num_terrains, replicas, workers, processes, terrains):
    monkeypatch.setattr(module, "available_cores", lambda: 3)
    cfg = replace(CFG, num_terrains=num_terrains, replicas=replicas, compute=Compute(workers=workers))
    assert (cfg.num_workers, cfg.terrains_of_worker) == (processes, terrains)


@pytest.fixture(scope="module", params=["2", "cuda:0"])
def evaluate(request):
    """Two processes that have six terrains under way, or a simulation in this process, as on a GPU."""
    compute = Compute(workers="2") if request.param == "2" else Compute(request.param)
    with open_pipeline(replace(CFG, compute=compute), build=Crosser) as pipeline:
        yield pipeline


@pytest.mark.parametrize("count", [1, 6, 15])
def test_how_terrains_are_spread_changes_nothing(evaluate, count):
    shares = []
    result = evaluate(drawn(slice(count)), shares.append)
    assert_same(result, stand_in.evaluate(GENES[:count], SEEDS[:count], 4))
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_what_a_stopped_evaluation_had_under_way_is_of_no_later_one(evaluate):
    def stop(share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(drawn(slice(None)), stop)  # of lots of three, two are in
    assert_same(evaluate(drawn(slice(9, 12))), stand_in.evaluate(GENES[9:12], SEEDS[9:12], 4))


@pytest.mark.parametrize("evaluate", ["2"], indirect=True)
def test_shards_run_at_the_same_time_and_turns_one_after_the_other(evaluate):
    result = evaluate(drawn(slice(6)))  # shards begin at seeds 100 and 103
    assert (result.wall_s, result.physics_steps, result.robot_steps) == (103.0, 103, 203)
    # Twelve, of which six fit, go in lots of three, as parts of two and one, one and two, ... in turn: the second parts
    # begin at 102, 104, 108 and 110, or where the other process has its turn at 101, 105, 107 and 111.
    assert evaluate(drawn(slice(12))).physics_steps in (102 + 104 + 108 + 110, 101 + 105 + 107 + 111)


def test_contact_is_resolved_at_the_same_control_rate():
    robot = get_robot("anymal")
    sizes = {"num_terrains": 1, "replicas": 4, "compute": Compute()}
    cfg = PipelineCfg(robot=robot, policy=str(robot.policy_file), engine="resolved", **sizes)
    rollout = module.build_simulator(cfg, 1)
    assert (rollout.robot.physics_dt, rollout.robot.control_dt) == (0.001, robot.control_dt)
    assert rollout.sim.solver.mjw_model.geom_solref.numpy()[..., 0] == pytest.approx(0.003)
    as_searched = module.build_simulator(replace(cfg, engine="search"), 1)
    assert as_searched.robot.physics_dt == robot.physics_dt == 0.005
    assert (as_searched.sim.solver.mjw_model.geom_solref.numpy()[..., 0] > 0.005).all()


@pytest.mark.parametrize(
    ("how", "error", "reason"),
    [("build", ValueError, "does not fit"), ("raise", EvaluatorError, "broken"), ("die", EvaluatorError, "SIGKILL")],
)
def test_why_a_worker_ended_is_known(tmp_path, how, error, reason):
    cfg = replace(CFG, policy=f"{how}:{tmp_path}:1")
    with pytest.raises(error, match=reason), open_pipeline(cfg, build=stand_in.Failing) as evaluate:
        evaluate(drawn(slice(None)))


def test_a_worker_that_ended_in_between_is_heard_when_it_gets_the_next_lot():
    """It refuses its second lot while nobody listens: the third cannot be sent, and the reason is no death."""
    with open_pipeline(replace(CFG, policy="refuse at 102"), build=Crosser) as evaluate:
        for lot in (slice(0, 2), slice(2, 4)):
            evaluate.put(drawn(lot))
        assert_same(evaluate.take(), stand_in.evaluate(GENES[:2], SEEDS[:2], 4))
        end = time.monotonic() + 20
        with pytest.raises(ValueError, match="terrains of another kind"):
            while time.monotonic() < end:
                evaluate.put(drawn(slice(4, 5)))
                time.sleep(0.02)


def test_large_height_maps_go_in_while_results_come_out():
    """8 lots of 3 MB each way through pipes of 64 KB: neither side waits for the other to read."""
    maps = np.zeros((8, 2, 161, 321, 7), np.float32)
    maps[..., 0] = GENES[:8, :1, None, None]
    with open_pipeline(replace(CFG, num_terrains=16), build=Echo) as evaluate:
        for lot in maps:
            evaluate.put(Terrains(heights=lot, seeds=SEEDS[:2]))
        for lot in maps:
            np.testing.assert_array_equal(evaluate.take().penalties, lot)


def test_the_first_worker_too_leaves_ctrl_c_to_its_parent():
    """In a new process, in which multiprocessing's resource tracker does not run yet."""
    script = (
        "import multiprocessing\n"
        "from qd.workers.process import WorkerProcess\n"
        "worker = WorkerProcess(1, dict, {})\n"
        "print(open(f'/proc/{multiprocessing.active_children()[0].pid}/status').read())\n"
        "worker.stop()\n"
    )
    status = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    blocked = int(status.partition("SigBlk:")[2].split()[0], 16)
    assert blocked & 1 << (signal.SIGINT - 1)


def test_leaving_ends_workers_in_the_midst_of_work(tmp_path):
    with open_pipeline(replace(CFG, policy=f"sleep:{tmp_path}:2"), build=stand_in.Failing) as evaluate:
        evaluate.put(drawn(slice(6)))
        began = time.monotonic()
    assert time.monotonic() - began < 15 and not multiprocessing.active_children()


@pytest.mark.parametrize("name", ["{}/model.pt", "{}/mine.py:act", "{}/mine.py:adapt@{}/model.pt", "os.path:join"])
def test_the_files_of_a_controller_travel(tmp_path, name):
    pytest.importorskip("ray")
    from qd.workers.ray_workers import PackedCode

    sent_from, sent_to = tmp_path / "sent_from", tmp_path / "sent_to"
    sent_from.mkdir()
    content = {"model.pt": b"weights", "mine.py": b"x = 1"}
    for file, text in content.items():
        (sent_from / file).write_bytes(text)
    assert PackedCode.of(name.format(sent_from, sent_from)).unpacked(sent_to) == name.format(sent_to, sent_to)
    sent = {file.name: file.read_bytes() for file in sent_to.iterdir()}
    assert sent == {file: text for file, text in content.items() if file in name}
