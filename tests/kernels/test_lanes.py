"""The GPU's code of dynamics and solver on a CPU: a thread for each lane of a warp, and a barrier where lanes wait.

Shared memory begins as NaN, so that what nobody wrote is seen, and it is that of the second world of a block, so that
what lies askew ends the test. Threads are not in step as lanes mostly are: a barrier that is missing changes numbers,
unless a shuffle is there, which waits here.
"""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from kernels import dynamics, solver
from sim.simulation import Simulation
from sim.solver import _CODES, _JOINT_CODES, Dynamics
from sim.terrains.bank import TerrainBank
from tests.sim.scenes import put, standing

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("g++") is None, reason="needs a compiler of C++20"),
    pytest.mark.skipif(wp.is_cuda_available(), reason="a GPU runs the code itself"),
]
HEADERS = "".join(f"#include <{name}>\n" for name in ("barrier", "cmath", "cstring", "thread", "vector"))
LANES = """
constexpr int LANES = {lanes};
alignas(16) static float pool[2 * {floats}];
float* const memory = pool + {floats};
for (int k = 0; k < {floats}; ++k) memory[k] = NAN;
std::barrier<> together(LANES);
double bus[LANES];
auto run_lane = [&](const int lane) {{
const int world = thread;
auto sync = [&] {{ together.arrive_and_wait(); }};
auto shuffle = [&](auto x, int k) {{
    memcpy(&bus[lane], &x, sizeof(x));
    sync();
    memcpy(&x, &bus[k], sizeof(x));
    sync();
    return x;
}};
auto add_lanes = [&](auto&... x) {{
    for (int k = LANES / 2; k > 0; k /= 2) ((x += shuffle(x, lane ^ k)), ...);
}};
auto find_sine = [](float x, float& sine, float& cosine) {{
    sine = sinf(x);
    cosine = cosf(x);
}};
"""
START = """
};
std::vector<std::thread> threads;
for (int lane = 0; lane < LANES; ++lane) threads.emplace_back(run_lane, lane);
for (auto& each : threads) each.join();
"""


def run_by_lanes(kernel, body: Path, lanes: int, floats: int, folder: Path) -> None:
    """From now on ``kernel`` is run on the CPU by that many threads a world, which share ``floats`` floats."""
    name = kernel.get_mangled_name()
    (loaded,) = kernel.module.execs.values()  # of one block size
    sources = Path(wp.config.kernel_cache_dir).glob(f"wp_{kernel.module.name}*/*.cpp")
    source = next(text for text in map(Path.read_text, sources) if f"{name}_cpu_forward" in text)
    begin = source.index("#if defined(__CUDA_ARCH__)\nconstexpr int LANES")
    end = source.index("const int world = thread / LANES;\n", begin)
    last = "\n".join(body.read_text().rstrip().splitlines()[-4:])
    source = source[:begin] + LANES.format(lanes=lanes, floats=floats) + source[source.index("\n", end) :]
    source = source.replace(last, last + START).replace("#define WP_NO_CRT", "")
    file = folder / f"{name}.cpp"
    file.write_text(HEADERS + source)
    native = Path(wp.__file__).with_name("native")
    options = ["-std=c++20", "-O1", "-shared", "-fPIC", "-pthread", "-w", "-fpermissive", "-I", native]
    options += ["-fsanitize=alignment", "-fno-sanitize-recover"]
    subprocess.run(["g++", *options, file, "-o", file.with_suffix(".so")], check=True)
    library = ctypes.CDLL(str(file.with_suffix(".so")), mode=ctypes.RTLD_GLOBAL)
    loaded.get_kernel_hooks(kernel).forward = getattr(library, f"{name}_cpu_forward")


def read_step(sim: Simulation, q: np.ndarray, qd: np.ndarray) -> dict[str, np.ndarray]:
    """All that a step from a state finds."""
    put(sim, q, qd)
    sim.physics_step()
    d, found = sim.solver.mjw_data, sim.dynamics._robots
    arrays = {name: getattr(found, name) for name in ("xpos", "xquat", "subtree_com", "cdof", "M", "slope")}
    arrays |= {name: getattr(found, name) for name in ("qfrc_actuator", "qfrc_smooth", "qpos", "qvel")}
    arrays |= {"qacc": d.qacc_warmstart, "force": sim.contacts.force, "iterations": d.solver_niter}
    return {name: array.numpy().copy() for name, array in arrays.items()}


def test_lanes_find_what_one_thread_finds(robot, tmp_path, monkeypatch):
    sim = Simulation(robot, TerrainBank(1, device="cpu"), np.zeros(8, int))
    rng = np.random.default_rng(0)
    q, qd = standing(robot, 8, z=robot.default_base_height), rng.normal(size=(8, 18))
    q[:, 7:] += 0.4 * rng.normal(size=(8, 12))
    q[:, 2] -= np.linspace(0.0, 0.3, 8)  # from one foot on the ground to all of the robot
    one = read_step(sim, q, qd)
    ours = sim.dynamics
    assert isinstance(ours, Dynamics) and sim.contacts.count.numpy().max() > 1 and one["iterations"].max() > 2
    kinds = (dynamics, ours._tree_sizes, _JOINT_CODES), (solver, ours._sizes, _CODES)
    for module, room, codes in kinds:
        kernel = module._kernel(room, tuple(codes.items()))
        hooks = next(iter(kernel.module.execs.values())).get_kernel_hooks(kernel)
        monkeypatch.setattr(hooks, "forward", hooks.forward)  # which is put back after the test
        run_by_lanes(kernel, module._BODY, module.LANES, room.shared_floats, tmp_path)
        lanes = read_step(sim, q, qd)
        for name, values in one.items():
            size = np.abs(values).max()
            np.testing.assert_allclose(lanes[name], values, atol=1e-5 * size, err_msg=f"{kernel.key}: {name}")
