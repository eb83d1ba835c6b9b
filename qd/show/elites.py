"""Where the archive that is shown lies, and who was searched."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from qd.archive import Archive, read_archive
from qd.fitness import FitnessCfg
from qd.run.directory import CONFIG_FILE, RunDirectory, check_space, directory_of, find_run
from qd.run.settings import SearchCfg, own_policy, suffix_of
from sim.files.command import chosen_elites, command_line
from sim.policy.spec import SHIPPED, ControllerSpec, controller_hash, is_same, label_suffix, spec_of

if TYPE_CHECKING:
    from qd.minimise import MinimalFound
    from sim.robots.robot import RobotCfg
    from sim.spaces.base import TerrainSpace

_USUAL_ROBOT = "anymal"


@dataclass(frozen=True, kw_only=True)
class Found:
    """An archive, its robot, and the search that made it."""

    run: Path
    """What was given: a run directory or an archive file."""
    archive: Archive
    robot: "RobotCfg"

    @property
    def folder(self) -> Path:
        """The directory."""
        return directory_of(self.run)

    @property
    def space(self) -> "TerrainSpace":
        """What the genes mean."""
        from sim.spaces.registry import get_space

        return get_space(self.archive.space, self.archive.space_sha256)

    @property
    def go_on(self) -> str:
        """How to let the search go on, for errors."""
        from sim.spaces.registry import is_own

        searched, _ = self.as_searched()
        code = searched if ControllerSpec.parse(searched).runs_code else None
        more = {"resume": self.folder, "policy": code, "space": self.space.name if is_own(self.space.name) else None}
        more["iterations"] = 2 * max(self.archive.iterations, 1)
        return f"let its search go on with `{command_line('archive', robot=self.robot.spec, **more)}`"

    def as_searched(self) -> tuple[str, FitnessCfg]:
        """Controller and fitness of the search; defaults where the archive lies without its config.

        Raises:
            ValueError: If the config is not that of the archive, or damaged.
        """
        archive, cfg = self.archive, self._search()
        if cfg is None:
            return SHIPPED, FitnessCfg(penalties=archive.penalties, scales=archive.scales)
        return cfg.policy, cfg.fitness

    def _search(self) -> SearchCfg | None:
        archive, file = self.archive, self.folder / CONFIG_FILE
        if not file.exists():
            return None
        cfg = RunDirectory(self.folder).read_cfg()
        there = (cfg.fitness.penalties, cfg.fitness.scales)
        if there != (archive.penalties, archive.scales):
            raise ValueError(
                f"{file} must have the penalties and scales of its archive, {', '.join(archive.penalties)}: "
                f"{archive.scales}, got {', '.join(there[0])}: {there[1]}: put back the one that is not this run's"
            )
        return cfg

    def policy(self, given: str | None) -> str:
        """The controller to cross with: the one given, or that of the search.

        Raises:
            ValueError: If that of the search is code, lost or another one now, or the config is not that of the
                archive.
        """
        cfg = self._search()
        if given is None and cfg is not None:
            return own_policy(self.run, cfg, self.robot)
        policy, searched = spec_of(given or SHIPPED, self.robot), self.archive.policy_sha256
        if given is None and searched not in (None, found := controller_hash(policy)):
            raise ValueError(
                f"{self.run} was searched with another controller than {policy} (expected SHA-256 {searched}, got "
                f"{found}): say with --policy which one to cross with"
            )
        return policy

    def suffix(self, policy: str) -> str:
        """The ending of the names of what is made with a controller: empty for the search's, else such as ``-C-G``.

        Raises:
            ValueError: If the config is not that of the archive.
        """
        cfg = self._search()
        if cfg is None:
            searched, own = self.archive.policy_sha256, str(self.robot.policy_file)
            same = is_same(policy, own) if searched is None else controller_hash(policy) == searched
            return "" if same else label_suffix(policy)
        return suffix_of(cfg, policy, self.robot)

    def minima(self) -> "MinimalFound":
        """The minimal terrains of its elites.

        Raises:
            FileNotFoundError: If there are none.
            ValueError: If their file is damaged.
        """
        from qd.minimise import read_minimal

        found = read_minimal(self.folder, self.archive)
        if found is None:
            word = "judge" if self.archive.fresh is None else "minimise"
            first = " first, then `faultline minimise`" if word == "judge" else ""
            again = command_line(word, robot=self.robot.spec, run=self.run)
            raise FileNotFoundError(f"{self.run} has no minimal terrains of its elites: `{again}`{first} makes them")
        return found

    def one(self, text: str) -> int:
        """The elite that a command line names, where only one makes sense.

        Raises:
            ValueError: If there is none of that number, or several are named.
        """
        numbers = chosen_elites(text, len(self.archive), self.run)
        if len(numbers) != 1:
            raise ValueError(
                f"--elite must name one elite here, got '{text}': give one of 0 to {len(self.archive) - 1}"
            )
        return numbers[0]


def robot_named(name: str | None) -> "RobotCfg":
    """The robot that a command line names; ANYmal if it names none.

    Raises:
        ValueError: If there is no such robot.
    """
    from sim.robots.find import get_robot

    return get_robot(name or _USUAL_ROBOT)


def find_archive(named: str | None, run: Path | None, policy: str | None = None, *, space: str | None = None) -> Found:
    """The archive of a run; without one the robot's newest under runs/, else its published one.

    Args:
        named: The robot, as the command line names it; left out, that of the run.
        run: Run directory or archive file.
        policy: Controller that the command line names, for the command that makes an archive.
        space: Terrain space that the command line names.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged, of another robot, of penalties that the robot does not have, or of a terrain space
            that is not at hand.
    """
    from sim.robots.find import robot_of

    if run is None or named is not None:
        robot_named(named)  # an unknown name is said first
    run = run or find_run(robot_named(named))
    archive = read_archive(run)
    robot = robot_of(archive.named(), named, run)
    check_space(archive, space)
    unknown = [name for name in archive.penalties if name not in robot.penalties]
    if unknown:
        raise ValueError(
            f"{run} was searched by penalties that robot {robot.name} does not have: {', '.join(unknown)}; expected "
            f"some of {', '.join(robot.penalties)}: give the settings that it was searched with, or another --run"
        )
    return Found(run=run, archive=archive, robot=robot)
