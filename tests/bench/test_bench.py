"""Every counterpart in torch computes what its kernel does; ceilings, timing and the file of `make bench`."""

import json

import numpy as np
import pytest
import torch
import warp as wp

from tests.bench.__main__ import file_name, main
from tests.bench.cases import build_scene, make_cases
from tests.bench.ceiling import CHAINS, UNROLLED, Ceiling, Work, chains_of, exponential, launch, multiply_add

KERNELS = ("rasterise", "contact", "observation", "penalties", "contact_forces")


def test_another_output_is_refused(anymal, device):
    for name, case in make_cases(build_scene(anymal, device, num_envs=6, num_terrains=3, walk_s=1.0, seed=0)).items():
        with torch.no_grad():
            outputs = case.counterpart(*case.arguments)
        if name == "contact":
            probe, point, *vectors = outputs
            faulty = [(torch.full_like(probe, -1), point, *vectors), (probe, point + 0.001, *vectors)]
        else:
            scaled = outputs.clone()
            scaled.view(-1)[scaled.view(-1).abs().argmax()] *= 1.5
            faulty = [scaled, outputs[:-1]]
        for other in faulty:
            with pytest.raises(ValueError, match=name):
                case.compare(other)


@pytest.mark.parametrize(
    ("link", "step"), [(multiply_add, lambda x: x * 0.999 + 0.001), (exponential, lambda x: np.exp(-x))]
)
def test_the_work_of_a_ceiling_is_done(device, link, step):
    out = wp.zeros(3, dtype=float, device=device)
    launch(chains_of(link), out, 2)
    chains = np.arange(3)[:, None] * 1e-6 + 0.1 * np.arange(8)
    for _ in range(2 * 16):
        chains = step(chains)
    np.testing.assert_allclose(out.numpy(), chains.sum(1), rtol=1e-5)
    assert chains.shape[1] * 16 == CHAINS * UNROLLED


# 1 TB/s from memory, 4 in a cache of 1 MB, 10 TFLOP/s, 1 T exponentials/s, 2 us a launch.
COPIES = {1 << 10: 1e9, 1 << 20: 4e12, 1 << 30: 1e12}
CEILING = Ceiling(copies=COPIES, flops_per_s=1e13, specials_per_s=1e12, launch_s=2e-6)


@pytest.mark.parametrize(
    ("work", "seconds", "share", "bound_by"),
    [
        (Work(bytes=10**9, flops=10**9), 2e-3, 0.5, "memory"),  # 1 GB at 1 TB/s is 1 ms: half of 2 ms
        (Work(bytes=10**5, flops=0), 1e-7, 0.25, "memory"),  # 0.1 MB: as the best copy of 1 MB or more, 25 ns
        (Work(bytes=10**6, flops=10**10), 4e-3, 0.25, "arithmetic"),  # 1e10 flops at 1e13/s: 1 ms of 4
        (Work(bytes=10**6, flops=10**9, specials=10**9), 2e-3, 0.5, "special functions"),
        (Work(bytes=4000, flops=1000), 4e-6, 2.5e-4, "launch"),  # of 4 us an empty launch takes half
        (Work(bytes=4000, flops=1000), 1e-5, 1e-4, "latency"),  # of 10 us a fifth
    ],
)
def test_what_bounds_a_kernel(work, seconds, share, bound_by):
    assert CEILING.judge(work, seconds) == (pytest.approx(share), bound_by)


def test_command(tmp_path, device, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["--small", "--num-envs", "3", "--device", device])
    [out] = tmp_path.rglob("*.json")
    report = json.loads(out.read_text())
    assert out.relative_to(tmp_path).parts[0] != "results" and report["small"]  # a trial publishes nothing
    assert [row["kernel"] for row in report["rows"]] == [*KERNELS]
    for row in report["rows"]:
        assert row["speedup"] == pytest.approx(row["torch_ms"] / row["ours_ms"])
        assert row["torch_compile_ms"] is None and row["ceiling_share"] > 0
    assert {"command", "commit", "device", "versions", "seed", "date"} <= report.keys()
    printed = capsys.readouterr().out
    assert all(kernel in printed for kernel in KERNELS)
    assert (file_name("NVIDIA H200"), file_name("CPU (x86_64, 2 cores)")) == ("nvidia-h200.json", "cpu.json")
