"""Times every kernel against torch and against what the device can do at best, and writes results/bench/<device>.json.

Each result in torch is compared with the kernel's before anything is timed.
"""

import argparse
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch

from qd.evaluate.tables import show_table
from sim.controllers.loaders import prepare_torch
from sim.device import resolve_device
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.intervals import format_value
from sim.files.provenance import provenance
from sim.robots.find import get_robot
from tests.bench.cases import Case, build_scene, make_cases
from tests.bench.ceiling import Ceiling, Timing, fit_launches, measure_ceiling, repeat_torch, repeat_warp, time_in_turns


def measure_kernel(case: Case, ceiling: Ceiling, device: str, timing: Timing, *, compiled: bool) -> dict[str, Any]:
    """One row of the results; what was not measured, since ``torch.compile`` failed, is None."""
    functions = {"torch": case.counterpart}
    if compiled:
        functions["torch_compile"] = torch.compile(case.counterpart, dynamic=False, fullgraph=True)
    variants = {}
    for name, function in functions.items():
        call = partial(function, *case.arguments)
        try:
            variants[name] = variant = fit_launches(partial(repeat_torch, call, device=device), device, timing)
        except Exception as error:  # the compiler may fail with anything: it may lack a C++ compiler
            if name == "torch":
                raise
            print(f"no torch.compile of {case.name}: {type(error).__name__}: {error}"[:300], file=sys.stderr)
            continue
        variant.replay()
        case.compare(variant.outputs[0])
    variants["ours"] = fit_launches(partial(repeat_warp, case.launch, device=device), device, timing)
    ms = {name: 1e3 * seconds for name, seconds in time_in_turns(variants, device, timing).items()}
    ceiling_share, bound_by = ceiling.judge(case.work, 1e-3 * ms["ours"])
    times = {f"{name}_ms": ms.get(name) for name in ("ours", "torch", "torch_compile")}
    speedup = ms["torch"] / ms["ours"]
    return {"kernel": case.name, **times, "speedup": speedup, "ceiling_share": ceiling_share, "bound_by": bound_by}


def file_name(device_name: str) -> str:
    """``nvidia-h200.json`` for an NVIDIA H200, ``cpu.json`` for any CPU."""
    name = "cpu" if device_name.startswith("CPU") else re.sub(r"[^a-z0-9]+", "-", device_name.lower()).strip("-")
    return f"{name}.json"


def main(argv: list[str]) -> None:
    """Measures, prints the table, writes the file."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("--robot", default="anymal")
    parser.add_argument("--device", help="a CUDA device if there is one")
    parser.add_argument("--num-envs", type=int, help="robots: 4,096 on CUDA, 16 on the CPU")
    where = "results/bench, of another robot or number in runs/make/bench"
    parser.add_argument("--out", type=Path, help=f"file to write; <device>.json in {where}, if left out")
    parser.add_argument("--small", action="store_true", help="a trial without torch.compile; it publishes nothing")
    args = parser.parse_args(argv)

    robot, device = get_robot(args.robot), resolve_device(args.device)
    on_gpu = device.startswith("cuda")
    usual = 4096 if on_gpu else 16
    num_envs = args.num_envs or usual
    published = "results" if (robot.name, num_envs) == (parser.get_default("robot"), usual) else "runs/make"
    origin, folder = provenance(device, 0), Path("runs/make/small" if args.small else published) / "bench"
    out = args.out or folder / file_name(origin["device"])
    prepare_output(out)
    num_terrains = min(num_envs, 200 if on_gpu else 8)
    timing = Timing(rounds=20, replay_s=2e-3) if on_gpu else Timing(rounds=10, replay_s=10e-3)
    if args.small:
        timing = Timing(rounds=1, replay_s=1e-6)
    prepare_torch(device)
    sizes = {"num_envs": num_envs, "num_terrains": num_terrains, "walk_s": 1.0 if args.small else 8.0}
    scene = build_scene(robot, device, **sizes, seed=0)
    ceiling = measure_ceiling(device, timing)
    cases = make_cases(scene).values()
    rows = [measure_kernel(case, ceiling, device, timing, compiled=not args.small) for case in cases]
    sizes = {"num_envs": num_envs, "num_terrains": num_terrains}
    report = {**origin, "small": args.small, "robot": robot.name, **sizes, "rows": rows}
    lines = []
    for row in rows:
        times = [format_value(row[name], None, ".4g") for name in ("ours_ms", "torch_ms", "torch_compile_ms")]
        lines.append((row["kernel"], *times, f"{row['speedup']:.1f}x", f"{row['ceiling_share']:.1%}", row["bound_by"]))
    title = f"{origin['device']}: {num_envs} robots on {num_terrains} terrains"
    show_table(title, ("kernel", "ours ms", "torch", "compiled", "speed-up", "of ceiling", "bound by"), lines)
    write_atomically(out, to_json(report))
    print(f"Written to {out}.")


if __name__ == "__main__":
    main(sys.argv[1:])
