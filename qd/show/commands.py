"""The commands that show a run or a terrain: their flags, and nothing else."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from sim.controllers.spec import parse_controllers
from sim.files.command import ControllerFlags, DeviceFlag, EliteFlags, RobotFlag, SpaceFlag, WorkerFlags, split_values
from sim.files.settings import NonNegativeInt, PositiveInt
from sim.robots.find import get_robot


@dataclass(frozen=True, kw_only=True)
class ReplayCommand(ControllerFlags, DeviceFlag, EliteFlags):
    """Cross terrains again: how often robots pass, what it costs them, and a figure with their paths.

    Terrains are elites of a run, numbered by falling (corrected) fitness, or minimal terrains, or a height map of your
    own. `faultline view` and `faultline report` list faults first.
    """

    terrain: Path | None = None
    """Instead of elites a height map of your own, an .npz or a .png."""
    size: tuple[float, float] | None = None
    """Size of the map along x and y [m], such as 16 8; its file's if left out."""
    scale: float | None = None
    """Metres a gray level of the map; its file's if left out."""
    offset: float | None = None
    """Height of its gray level 0 [m]; its file's, or 0."""
    replicas: PositiveInt = 20
    """Episodes to run."""
    seed: NonNegativeInt = 0
    """Draws their starts."""
    out: Path | None = None
    """File to write, *.png of a figure (its numbers beside as *.json), *.mp4 or *.gif of a film; with several elites a
    folder. If left out elite-<number> or minimal-<number> in the run, of a published one in a folder of its own in
    runs/, of a map runs/terrains/<map>-<robot>; with another controller -<its name> is added."""

    def execute(self) -> None:
        """Prints the numbers, writes them and the figures."""
        from qd.show.replay import replay
        from qd.workers.compute import choose_device

        replay(self._source(), device=choose_device(self.device), out=self.out)

    def _source(self) -> Any:
        from qd.show.elites import open_run
        from qd.show.replay import source_from_map, source_from_run

        crossing: Any = {"policy": self.policy, "replicas": self.replicas, "seed": self.seed}
        if self.terrain is None:
            opened_run = open_run(self.robot, self.run, space=self.space)
            return source_from_run(opened_run, self.elite, self.minimal, **crossing)
        if self.run is not None:
            raise ValueError("--run is about elites: leave it out, or --terrain")
        crossing |= {"size_m": self.size, "scale_m": self.scale, "offset_m": self.offset}
        return source_from_map(self.terrain, get_robot(self.robot or "anymal"), **crossing)


@dataclass(frozen=True, kw_only=True)
class FilmCommand(ReplayCommand):
    """Film how a robot fails, on elites of a run or on a terrain of your own.

    The terrains and the episodes are those that `faultline replay` shows. The film begins 3 s before the robot fails,
    shows the last second before that four times slower, and ends 1 s after it. Touching feet are yellow, base and legs
    magenta. Arrows are contact forces of the feet, red beyond the robot's limit.
    """

    episode: NonNegativeInt | None = None
    """Which episode to film. If left out, of the episodes that end as most do, the one with the median penalties."""
    whole: bool = False
    """Film the whole episode."""
    gif: bool = False
    """Write a GIF 480 pixels wide, of at most 2 MB."""
    beside: str | None = None
    """Another controller to show as a ghost from the same start: C-G or another name of the robot's panel, or a file,
    as --policy takes it; or witness, the one that crosses the elite where it is steered (`faultline judge`)."""
    shadows: bool = True
    """Whether the sun casts shadows; without a GPU they take half of the time."""

    def execute(self) -> None:
        """Makes the films."""
        from qd.show.film import film_source
        from qd.workers.compute import choose_device

        look: Any = {name: getattr(self, name) for name in ("out", "episode", "gif", "beside", "whole", "shadows")}
        film_source(self._source(), device=choose_device(self.device), **look)


@dataclass(frozen=True, kw_only=True)
class PackFlags(WorkerFlags):
    """How a pack is made."""

    size: PositiveInt = 100
    """How many terrains. There are fewer if the runs have fewer faults and near-faults."""
    runs: tuple[Path, ...] = ()
    """Further judged runs against the same controller, whose faults the pack takes, too."""
    apart_from: tuple[Path, ...] = ()
    """Runs on which controllers were trained: the pack takes no kin of their elites."""
    licence: str = ""
    """Licence of the pack, which it names: CC-BY-4.0."""
    controllers: tuple[str, ...] = ()
    """Controllers that cross them, each NAME=FILE, as --policy takes it. If left out, the shipped one as base and
    the run's certifiers. The searched controller is always among them."""
    episodes: PositiveInt = 20
    """Episodes on each terrain."""
    seed: NonNegativeInt = 0
    """Draws other episodes."""


@dataclass(frozen=True, kw_only=True)
class ExportCommand(ControllerFlags, EliteFlags):
    """Write terrains as files that other programs read, a pack of terrains, or a controller as ONNX.

    For each elite it writes `elite-N` in some formats (docs/reference.md), `elite-N.json` with scales, start, goal,
    verdict, cause and ending, and a README.md that says how MuJoCo, mjlab, Isaac Lab and Gazebo take them. `faultline
    replay --terrain elite-N.npz`, or with the .png, crosses it again.

    With --pack it makes a pack from judged runs: faults and near-faults, spread over the ways in which the searched
    controller fails and over families of kin, to test any controller on with `faultline evaluate --pack`. One that is
    made in place of another has the next version.
    """

    from_pack: str | None = None
    """Take the terrains of a pack instead of elites: its folder, or anymal, cassie or anymal@1 for a published one.
    --elite counts its terrains, from 0; their files are called as the pack calls them."""
    formats: tuple[str, ...] = ("npz", "png", "npy", "xml", "stl", "glb", "sdf")
    """Which to write; several may stand in one, apart by spaces."""
    overwrite: bool = False
    """Replace files of an earlier export, the ONNX file, or a pack by its next version; without it the command refuses
    to."""
    pack: bool = False
    """Make a pack from the run."""
    onnx: Path | None = None
    """Write the controller (--policy, else the robot's own) as one ONNX file, weights inside, for any batch size. It
    must be an rsl_rl checkpoint, such as the policy.pt of a training run."""
    out: Path | None = None
    """Folder to write to; terrains/ in the run directory, or of a published one in runs/<robot>-published; of minimal
    terrains minimal-terrains/, of a pack's runs/<robot>-pack-terrains; of a new pack runs/<robot>-pack."""
    making: PackFlags = field(default_factory=PackFlags)

    def execute(self) -> None:
        """Writes the files."""
        from qd.show.elites import open_run
        from qd.show.export import export_controller, export_elites, export_pack

        if sum([self.pack, self.from_pack is not None, self.onnx is not None]) > 1:
            raise ValueError("give one of --pack, --from-pack and --onnx")
        options: Any = {"formats": split_values(self.formats), "out": self.out, "overwrite": self.overwrite}
        if self.onnx is not None:
            export_controller(self.policy, get_robot(self.robot or "anymal"), self.onnx, overwrite=self.overwrite)
        elif self.pack:
            self._make_pack()
        elif self.from_pack is None:
            export_elites(open_run(self.robot, self.run, space=self.space), self.elite, self.minimal, **options)
        elif (self.run, self.space, self.minimal) != (None, None, None):
            raise ValueError("a pack has its own terrains: leave --run, --space and --minimal out")
        else:
            export_pack(self.from_pack, self.elite or "0", self.robot, **options)

    def _make_pack(self) -> None:
        from qd.evaluate.pack import make_pack
        from qd.faults.searches import find_search
        from qd.search.archive import read_archive
        from qd.search.directory import find_run
        from qd.workers.compute import Compute

        making = self.making
        robot = get_robot(self.robot or "anymal")
        run = find_run(robot, self.run, published="never")
        named: Any = {"robot": self.robot, "policy": self.policy, "space": self.space}
        searches = [find_search(one, **named) for one in (run, *making.runs)]
        controllers = parse_controllers(making.controllers, robot) if making.controllers else {}
        how: Any = {name: getattr(making, name) for name in ("size", "episodes", "seed", "licence")}
        how |= {"compute": Compute.resolve(making.device, making.workers, making.num_envs), "out": self.out}
        how |= {"apart_from": [read_archive(one) for one in making.apart_from], "overwrite": self.overwrite}
        make_pack(searches, controllers, **how)


@dataclass(frozen=True, kw_only=True)
class ReportCommand(ControllerFlags, DeviceFlag, SpaceFlag):
    """Write one HTML page about a run; it opens from disk, without a network, and prints well.

    It begins with what the robot fails, and shows the worst terrains close up at the moment of failure, with another
    controller beside that passes them. For this robots try these terrains again, 20 times each, which is stored: the
    same command goes on after a stop. With --evidence the page is about what was tested of a controller.
    """

    run: Path | None = None
    """Run directory; the newest of this robot under runs/, else its published archive. Of a `faultline harden` the page
    is about its rounds, and nothing is crossed."""
    out: Path | None = None
    """Page to write, *.html; report.html in the run, or of published results in a folder of their own under runs/;
    with another controller report-<its name>.html."""
    elites: Annotated[int, Meta(ge=1, le=10)] = 3
    """How many of the worst terrains to show close up, one a cause first."""
    tables: Path | None = None
    """Tables of an evaluation to show, such as results/anymal/tables.json; none if left out."""
    evidence: tuple[Path, ...] | None = None
    """In place of a run, files that gates, doses, rates, tests on packs and searches (archive.json) wrote about one
    controller: a page of what was tested, by which command, and what was not; evidence.html beside the first file."""
    controller: str | None = None
    """With --evidence: the controller's name in files of doses; their first if left out."""
    verify: Path | None = None
    """Only check that a page of evidence and its files are as its list of hashes says, evidence.sha256."""

    def execute(self) -> None:
        """Writes the page."""
        from qd.show.report.evidence import verify_evidence, write_evidence
        from qd.show.report.report import write_report

        if self.evidence == () or None not in (self.evidence, self.verify):
            raise ValueError("report takes files behind --evidence, or a list behind --verify, got none or both")
        if self.verify is not None:
            count = verify_evidence(self.verify)
            print(f"{count} files are as {self.verify} says. That does not say who wrote them.")
        elif self.evidence is not None:
            write_evidence(self.evidence, robot=self.robot, controller=self.controller, out=self.out)
        else:
            named: Any = {"robot": self.robot, "policy": self.policy, "space": self.space, "device": self.device}
            write_report(self.run, out=self.out, num_elites=self.elites, tables=self.tables, **named)


@dataclass(frozen=True, kw_only=True)
class ViewCommand(RobotFlag, EliteFlags):
    """Look at an archive in the browser: its elites, their terrains in 3-D, and the robot that crosses them.

    It opens on the worst terrain of the commonest cause one second before the robot fails, and plays, with the
    controller that passes it as a ghost beside; docs/reference.md has the page and its keys. Crossings that are not
    recorded yet run on the CPU, which takes seconds, and are stored under --cache.

    Ctrl-C ends it. No GPU and no screen are needed: over ssh, forward the port (ssh -L 8080:localhost:8080 HOST) and
    open the page at home.
    """

    policies: tuple[str, ...] = ()
    """Controllers to choose from, each NAME=FILE, NAME=module:callable or NAME=shipped, such as base=shipped
    C-G=runs/tuned/policy.pt; if none is given, the one the archive was made with, and those of the robot's panel that
    certify its faults."""
    likely: Path | None = None
    """File that says how conditions are distributed, in place of what the run remembers (`faultline archive`)."""
    port: int = 8080
    """Where the page is served."""
    host: str = "127.0.0.1"
    """Address to serve it at. 127.0.0.1 is reached from this machine alone, 0.0.0.0 from the network: there is no
    password."""
    cache: Path = Path("runs") / "recordings"
    """Where recordings are stored."""

    def execute(self) -> None:
        """Serves the page until Ctrl-C."""
        import gc

        from qd.show.view.recorder import Recorder

        recorder = Recorder()  # its process loads the simulation while this one loads the page
        try:
            gc.disable()  # else it takes a third of the time
            from qd.show.view.app import serve
            from qd.show.view.viewed import open_viewed_run

            elite: Any = {"elite": self.elite, "minimal": self.minimal, "likely": self.likely}
            show = open_viewed_run(self.run, robot=self.robot, policies=self.policies, space=self.space, **elite)
            gc.enable()
            serve(show, recorder, host=self.host, port=self.port, cache=self.cache)
        finally:
            recorder.stop()
