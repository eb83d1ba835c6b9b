"""Ceilings, shares, timing and the table of the benchmark, by hand."""

from pathlib import Path

import pytest

from sim.bench.cases import Work
from sim.bench.ceiling import Ceiling
from sim.bench.report import add_shares, file_of, sizes_of, table
from sim.bench.timing import MAX_LAUNCHES, TimingCfg, Variant, fit_launches, time_in_turns
from sim.commands import Bench


def make_ceiling():
    """1 TB/s from memory, 4 in a cache of 1 MB, 10 TFLOP/s, 1 T exponentials/s, 2 us a launch."""
    return Ceiling(
        copies={1 << 10: 1e9, 1 << 20: 4e12, 1 << 30: 1e12}, flops_per_s=1e13, specials_per_s=1e12, launch_s=2e-6
    )


def test_a_working_set_is_measured_against_copies_no_smaller():
    # 100 KB: the best copy of 1 MB or more; 10 MB: only that of 1 GB is as large; beyond the largest: that one.
    ceiling = make_ceiling()
    assert [ceiling.bytes_per_s(size) for size in (100 << 10, 10 << 20, 4 << 30)] == [4e12, 1e12, 1e12]


@pytest.mark.parametrize(
    ("work", "seconds", "shares", "bound_by"),
    [
        # 1 GB at 1 TB/s is 1 ms: half of 2 ms.
        (Work(bytes=10**9, flops=10**9), 2e-3, (0.5, 0.05, 0), "memory"),
        # 1e10 flops at 1e13/s: 1 ms of 4.
        (Work(bytes=10**6, flops=10**10), 4e-3, (1 / 16000, 0.25, 0), "arithmetic"),
        (Work(bytes=10**6, flops=10**9, specials=10**9), 2e-3, (1 / 8000, 0.05, 0.5), "special functions"),
        # Hardly any work: of 4 us an empty launch takes half, of 10 us a fifth.
        (Work(bytes=4000, flops=1000), 4e-6, (2.5e-4, 2.5e-5, 0), "launch"),
        (Work(bytes=4000, flops=1000), 1e-5, (1e-4, 1e-5, 0), "latency"),
    ],
)
def test_what_bounds_a_kernel(work, seconds, shares, bound_by):
    share = make_ceiling().judge(work, seconds)
    assert (share["bandwidth_share"], share["arithmetic_share"], share["special_share"]) == pytest.approx(shares)
    assert share["ceiling_share"] == max(share["bandwidth_share"], share["arithmetic_share"], share["special_share"])
    assert share["launch_share"] == pytest.approx(2e-6 / seconds)
    assert share["bound_by"] == bound_by


def rows():
    common = {"torch_ms": 2.0, "torch_compile_ms": None, "speedup": 4.0, "speedup_compile": None, "ceiling_share": 0.5}
    return [
        {"kernel": "a", "ours_ms": 0.5, "ours_cold_ms": None, "per_control_step": 4, "part_of": None, **common},
        {"kernel": "b", "ours_ms": 0.1, "ours_cold_ms": 0.2, "per_control_step": 1, "part_of": None, **common},
        {"kernel": "c", "ours_ms": 0.1, "ours_cold_ms": None, "per_control_step": 1, "part_of": "b", **common},
    ]


def test_shares_of_the_step():
    # Of 10 ms: 4 x 0.5 ms = 20 %; b with cold caches 0.2 ms = 2 %; c is part of b: shown, not added.
    filled = rows()
    assert add_shares(filled, 10.0) == pytest.approx(0.22)
    assert [row["share_of_step"] for row in filled] == pytest.approx([0.2, 0.02, 0.01])


def test_the_table_says_why_a_column_is_empty():
    filled = [row | {"bound_by": "memory", "torch_compile_failure": "no compiler"} for row in rows()]
    step = filled[0] | {"kernel": "whole_step", "torch_ms": None, "speedup": None, "torch_compile_failure": None}
    ceiling = {"copies": {1: 2e9, 2: 1e9}, "flops_per_s": 3e9, "specials_per_s": 4e9, "launch_s": 5e-6}
    collision = {"physics_steps_per_s": 6000.0, "physics_steps_per_s_solver_collision": None, "speedup": None}
    report = {"rows": [*filled, step], "share_of_step": 0.22, "num_envs": 7, "ceiling": ceiling, "collision": collision}
    text = table(report)
    assert "no torch.compile of a: no compiler" in text and "compile of whole_step" not in text
    assert "22.0 % of a control step, 7 environments" in text
    assert "copies 1 GB/s from memory, 2 cached; 3.0 GFLOP/s; 4.00 G exponentials/s; launch 5.00 us" in text
    assert "solver's own" not in text
    report["collision"] = collision | {"physics_steps_per_s_solver_collision": 3000.0, "speedup": 2.0}
    assert "heightfield collision 3,000 (2.00x)" in table(report)


def test_launches_fill_the_replay():
    made = []

    def make(launches):
        made.append(launches)
        return Variant(replay=lambda: sum(range(launches)), launches=launches, work=list)

    assert fit_launches(make, "cpu", TimingCfg(replay_s=1e-12)).launches == 1
    assert fit_launches(make, "cpu", TimingCfg(replay_s=1e3)).launches == MAX_LAUNCHES
    assert made == [1, 1, MAX_LAUNCHES]


def test_variants_take_turns_after_a_warm_up():
    played = []
    variants = {name: Variant(replay=lambda name=name: played.append(name), launches=2, work=list) for name in "ab"}
    seconds = time_in_turns(variants, "cpu", TimingCfg(rounds=3))
    assert played == ["a", "b"] * 4
    assert seconds.keys() == {"a", "b"} and min(seconds.values()) > 0


def test_sizes_are_those_of_the_paper_on_cuda():
    num_envs, num_terrains, timing = sizes_of(Bench(), "cuda:1")
    assert (num_envs, num_terrains, timing.rounds) == (4096, 200, 20)
    num_envs, num_terrains, timing = sizes_of(Bench(num_envs=9, rounds=1), "cpu")
    assert (num_envs, num_terrains, timing.rounds) == (9, 8, 1)


def test_numbers_are_named_after_the_device_and_leave_the_published_ones_alone():
    assert file_of("NVIDIA H200") == Path("runs/bench/nvidia-h200.json")
    assert file_of("CPU (x86_64, 2 cores)") == Path("runs/bench/cpu.json")
