"""The benchmark: kernels and torch counterparts against the oracle on walking robots, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from sim.bench.cases import make_cases
from sim.bench.checks import OutputError, Truth, require_close
from sim.bench.report import measure_case
from sim.bench.scene import build_scene
from sim.bench.timing import TimingCfg
from sim.commands import Bench
from sim.files.command import run_command
from tests.sim.bench.test_report import make_ceiling

CASES = ("rasterise", "contact", "scan", "observation", "penalties", "contact_forces")
QUICK = TimingCfg(rounds=1, replay_s=1e-6)


@pytest.fixture(scope="module")
def scene(anymal, device):
    """Fourteen robots on five terrains, which do not divide them, in the middle of the bumps."""
    return build_scene(anymal, device, num_envs=14, num_terrains=5, walk_s=6.0)


@pytest.fixture(scope="module")
def cases(scene):
    return {case.name: case for case in make_cases(scene, Truth(scene))}


def outputs_of(case):
    with torch.no_grad():
        return case.counterpart(*case.arguments)


def test_the_robots_walk_where_the_bumps_are(scene):
    position = scene.rollout.sim.joint_q.numpy()[:, :3]
    assert ((position[:, 0] > 3.5) & (position[:, 0] < 9)).sum() > 7
    terrain = scene.rollout.sim.terrain_of_env.numpy()
    assert np.bincount(terrain).tolist() == [3, 3, 3, 3, 2]
    # Robots of one terrain are replicas of their own: no two stand in the same place.
    assert len(np.unique(position, axis=0)) == 14


def test_every_kernel_has_its_case(cases):
    assert tuple(cases) == CASES


@pytest.mark.parametrize("name", CASES)
def test_kernel_and_counterpart_agree_with_the_oracle(cases, name):
    # Both checks raise where a number is off.
    cases[name].check_ours()
    cases[name].check_torch("torch", outputs_of(cases[name]))


def test_contact_of_robots_thrown_on_the_ground(scene):
    # Rolled over and pushed into the ground: base, thighs and shanks touch, many with all their length.
    sim, rng = scene.rollout.sim, np.random.default_rng(3)
    walking = wp.clone(sim.joint_q)
    joint_q = walking.numpy().copy()
    turned = rng.normal(size=(len(joint_q), 4))
    joint_q[:, 3:7] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    joint_q[:, 0] = rng.uniform(6, 10, len(joint_q))
    joint_q[:, 2] -= rng.uniform(0.3, 0.5, len(joint_q))
    sim.joint_q.assign(joint_q)
    sim.refresh()
    try:
        [case] = [case for case in make_cases(scene, Truth(scene)) if case.name == "contact"]
        case.check_ours()
        outputs = outputs_of(case)
        case.check_torch("torch", outputs)
        slots = (outputs[0] >= 0).sum(dim=(0, 1)).tolist()  # deepest, first, last
        assert slots[0] > 30 and slots[1] > 5 and slots[2] > 5
        assert int(sim.contact_count.numpy()[0]) == sum(slots)
    finally:
        wp.copy(sim.joint_q, walking)
        sim.refresh()


def spoil(name, outputs):
    """The outputs with one fault each that a wrong kernel could have."""
    if name != "contact":
        one_value = outputs.clone()
        one_value.view(-1)[one_value.view(-1).abs().argmax()] *= 1.01
        return [one_value, outputs.roll(1, 0)]
    probe, point, centre, normal, offset = outputs
    nothing = torch.full_like(probe, -1)
    lowest = torch.arange(probe.shape[1], device=probe.device)[:, None]
    invented = torch.where((probe < 0).all(2, keepdim=True) & (lowest == 0), 0, probe)  # a base that does not touch
    faults = [
        (nothing, point, centre, normal, offset),
        (invented, point, centre, normal, offset),
        (probe[..., :1].expand_as(probe), point, centre, normal, offset),
        (probe, point + 0.001, centre, normal, offset),
        (probe, point, centre.flip(-1), normal, offset),
        (probe, point, centre, normal * 1.001, offset),
        (probe, point, centre, normal, -offset),
    ]
    return faults


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_output_is_refused(cases, name):
    faults = spoil(name, outputs_of(cases[name]))
    assert len(faults) >= 2
    for fault in faults:
        with pytest.raises(OutputError, match="torch"):
            cases[name].check_torch("torch", fault)


def test_an_output_that_is_not_finite_or_of_another_shape_is_refused():
    with pytest.raises(OutputError, match=r"1 of 2 values.*expected 1, got nan"):
        require_close("x", np.array([0.0, np.nan]), np.array([0.0, 1.0]), atol=1.0)
    with pytest.raises(OutputError, match=r"shape \(2,\), but the oracle's is \(3,\)"):
        require_close("x", np.zeros(2), np.zeros(3), atol=1.0)


@pytest.mark.slow
def test_a_row_is_whole(cases, device):
    row = measure_case(cases["penalties"], make_ceiling(), device, QUICK, compiled=True)
    assert min(row["ours_ms"], row["torch_ms"]) > 0
    assert row["speedup"] == pytest.approx(row["torch_ms"] / row["ours_ms"])
    # Without a working compiler the column is empty and says why.
    assert (row["torch_compile_ms"] is None) == (row["torch_compile_failure"] is not None)
    assert row["ceiling_share"] == max(row["bandwidth_share"], row["arithmetic_share"], row["special_share"])
    assert (row["ours_cold_ms"] is None) == (device == "cpu")


def test_a_compiler_that_fails_leaves_a_reason(cases, device, monkeypatch):
    def fail(*_args, **_options):
        raise RuntimeError("no C++ compiler\nand more")

    monkeypatch.setattr(torch, "compile", fail)
    row = measure_case(cases["scan"], make_ceiling(), device, QUICK, compiled=True)
    assert row["torch_compile_ms"] is None and row["speedup_compile"] is None
    assert "no C++ compiler" in row["torch_compile_failure"]


def test_a_wrong_kernel_stops_the_measurement(cases, device):
    # A kernel that writes nothing leaves what was cleared, not what an earlier launch wrote.
    with pytest.raises(OutputError, match="kernel scan"):
        measure_case(replace(cases["scan"], launch=lambda: None), make_ceiling(), device, QUICK, compiled=False)
    wrong = replace(cases["scan"], counterpart=lambda *arguments: cases["scan"].counterpart(*arguments) + 0.01)
    with pytest.raises(OutputError, match="torch scan"):
        measure_case(wrong, make_ceiling(), device, QUICK, compiled=False)


TINY = ["--num-envs", "3", "--num-terrains", "2", "--walk-s", "1", "--duration-s", "1", "--rounds", "1", "--no-compile"]


def main(argv):
    return run_command(Bench, argv, name="bench")


def test_command_line(tmp_path, device, capsys):
    out = tmp_path / "new" / "bench.json"
    assert main([*TINY, "--device", device, "--out", str(out)]) == 0
    report = json.loads(out.read_text())
    assert [row["kernel"] for row in report["rows"]] == [*CASES, "whole_step"]
    wanted = {"kernel", "ours_ms", "torch_ms", "torch_compile_ms", "speedup", "ceiling_share", "bound_by"}
    assert all(wanted <= row.keys() for row in report["rows"])
    assert {"command", "commit", "device", "versions", "seed", "date"} <= report.keys()
    assert report["share_of_step"] == pytest.approx(
        sum(row["share_of_step"] for row in report["rows"][:-1] if row["kernel"] != "scan")
    )
    collision = report["collision"]
    assert collision["solver_failure"] is None
    assert min(collision["physics_steps_per_s"], collision["physics_steps_per_s_solver_collision"]) > 100
    # After 0.2 s of the same motion on the two grounds the bases are where they would be on one.
    assert collision["height_difference_m"] < 0.015
    assert (collision["solver_invalid_envs"], collision["solver_overflows"]) == (0, 0)
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*CASES, "whole_step", "bare physics", str(out)))


def test_nothing_is_written_where_an_output_is_wrong(tmp_path, device, capsys, monkeypatch):
    monkeypatch.setattr("sim.bench.cases.write_scan", lambda *_arguments: None)
    assert main([*TINY, "--device", device, "--out", str(tmp_path / "bench.json")]) == 2
    assert "error: kernel scan" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--device", "abacus"], "abacus"),
        (["--num-envs", "2", "--num-terrains", "3"], "3 terrains for 2 envs"),
        (["--walk-s", "30"], "walk_s"),
        (["--rounds", "0", "--seed", "-1"], "rounds must be at least 1, got 0; seed must"),
        (["--robot", "horse"], "horse"),
    ],
)
def test_what_cannot_be_had_is_one_line(tmp_path, capsys, arguments, reason):
    device = [] if "--device" in arguments else ["--device", "cpu"]
    assert main([*arguments, *device, "--out", str(tmp_path / "x.json")]) == 2
    error = capsys.readouterr().err
    assert reason in error and error.count("\n") == 1


def test_an_output_that_cannot_be_written_is_known_at_once(tmp_path, capsys):
    assert main(["--device", "cpu", "--out", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
