"""The commands about robots, controllers and the simulation: their options, and what each calls.

Modules with Warp, torch or Newton are imported inside ``execute``, so that ``--help`` answers at once.
"""

from dataclasses import dataclass
from pathlib import Path

from sim.files.command import OfRobot, OnDevice, Who, command_line, publish
from sim.files.settings import setting


@dataclass(frozen=True, kw_only=True)
class Stand(OfRobot, OnDevice):
    """Look at a robot before anything is searched or trained.

    It prints its joints and geoms as they were read, whether it stands in its default pose, and how many contacts and
    constraint rows it needs when it lies on rough ground. The exit status is 1 if something must be mended.
    """

    seconds: float = setting(3.0, above=0, most=60)
    """How long it stands, and lies [s]."""
    drops: int = setting(32, least=1)
    """Robots dropped in random poses on hard-random terrain."""
    seed: int = setting(0, least=0)
    """Draws poses and terrains."""

    def execute(self) -> int:
        """Prints what was found; returns 1 if something has to be mended."""
        from sim.robots.robot import get_robot
        from sim.robots.stand import describe_model, describe_standing, stand
        from sim.simulation import resolve_device

        robot = get_robot(self.robot)
        print(describe_model(robot), flush=True)
        device = resolve_device(self.device)
        found = stand(robot, device=device, seconds=self.seconds, drops=self.drops, seed=self.seed)
        text, fine = describe_standing(robot, found)
        print(text)
        return 0 if fine else 1


@dataclass(frozen=True, kw_only=True)
class ExportPolicy(Who):
    """Write a controller as one ONNX file, weights inside, for any batch size.

    Input `observation` (batch, observation_size) and output `action` (batch, num_joints), float32. The controller must
    be an rsl_rl checkpoint, such as the policy.pt of a training run. The file is loaded back and compared with the
    original.
    """

    out: Path = Path("policy.onnx")
    """File to write; an older one is replaced once the new one is known to be right."""

    def execute(self) -> None:
        """Writes the file and says what it holds."""
        from sim.policy.export import INPUT, OUTPUT, export_onnx, read_checkpoint
        from sim.robots.robot import get_robot

        policy = read_checkpoint(self.policy, get_robot(self.robot))
        apart = export_onnx(policy, self.out)
        sizes = f"{INPUT} (batch, {policy.sizes[0]}) -> {OUTPUT} (batch, {policy.sizes[1]})"
        print(f"Written to {self.out}: {sizes}, {self.out.stat().st_size / 1e6:.2f} MB.")
        print(f"Loaded back, its actions are within {apart:.1g} of the original's. Next:")
        print(f"  {command_line('evaluate', robot=self.robot, policy=self.out)}")


@dataclass(frozen=True, kw_only=True)
class Bench(OfRobot, OnDevice):
    """Time every kernel against torch, torch.compile and the device's ceilings, and the step against bare physics.

    First the shipped controller walks robots into terrains. Every output is compared with a float64 oracle before it is
    timed.
    """

    out: Path | None = None
    """File to write; runs/bench/<device>.json if left out."""
    num_envs: int | None = setting(None, least=1)
    """Robots: 4,096 on CUDA, 16 on the CPU."""
    num_terrains: int | None = setting(None, least=1)
    """Terrains they stand on: 200 on CUDA, 8 on the CPU."""
    rounds: int | None = setting(None, least=1)
    """Replays of each variant, of which the median counts: 20 on CUDA, 10 on the CPU."""
    duration_s: float = setting(20.0, above=0)
    """Simulated length of the crossings that time the whole step."""
    walk_s: float = setting(8.0, above=0)
    """Simulated time the robots walk before the kernels are timed: at 0.75 m/s, 6 m, where the bumps are."""
    compile: bool = True
    """Measure torch.compile too: a minute or two of compiling."""
    heightfield: bool = True
    """Measure the solver's own heightfield collision too."""
    seed: int = setting(0, least=0)
    """Seed of terrains and starts."""

    def execute(self) -> None:
        """Measures, prints the table, writes the file."""
        from sim.bench.report import file_of, measure, table
        from sim.files.records import provenance
        from sim.robots.robot import get_robot
        from sim.simulation import resolve_device

        robot, device = get_robot(self.robot), resolve_device(self.device)
        origin = provenance(device, self.seed)
        out = self.out or file_of(origin["device"])
        publish(out, lambda: {**origin, **measure(robot, self, device)}, lambda report: print(table(report)))


@dataclass(frozen=True, kw_only=True)
class SolverOptions(Who, OnDevice):
    """Cross the same hard-random terrains under several caps and capacities of the solver.

    It prints wall time, rates and mean penalties of each choice.
    """

    terrains: int = setting(200, least=1)
    """Hard-random terrains."""
    episodes: int = setting(20, least=1)
    """Episodes a terrain."""
    iterations: tuple[int, ...] = setting((3, 4, 5, 6, 8, 50), least=1)
    """Caps on the Newton iterations to try."""
    ls_iterations: tuple[int, ...] = setting((10,), least=1)
    """Caps on the line search to try with each."""
    njmax: tuple[int, ...] = setting((), least=1)
    """Constraint rows an environment to try with the shipped caps, beside the robot's own."""
    nconmax: tuple[int, ...] = setting((), least=1)
    """Contacts an environment to try with each of them, as many as --njmax."""
    resolved: bool = False
    """Cross with contact resolved too (steps of 1 ms), and say how far each choice's rates of terrains lie from it."""
    rounds: int = setting(3, least=1)
    """Rollouts of each choice; the median counts."""
    seed: int = setting(0, least=0)
    """Draws terrains and starts."""
    out: Path | None = None
    """File to write; the numbers are only printed if left out."""

    def execute(self) -> None:
        """Measures, prints the table, writes the file."""
        from sim.bench.options import measure, print_rows

        publish(self.out, lambda: measure(self), print_rows)
