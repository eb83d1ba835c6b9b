"""Where the archive that is shown lies, which of its terrains, and who was searched."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.faults.causes import UNCLEAR
from qd.faults.families import rank
from qd.faults.minimise.minimise import MinimalTerrains, read_minimal
from qd.faults.numbers import best_certifier
from qd.faults.searches import CERTIFIERS_FOLDER, controllers_in
from qd.search.archive import Archive, read_archive
from qd.search.directory import CONFIG_FILE, RunDirectory, check_config, check_space, find_directory, find_run
from qd.search.fitness import FitnessCfg
from qd.search.settings import SearchCfg, find_policy
from sim.controllers.spec import SHIPPED, controller_hash, is_same_controller, label_suffix, resolve_policy
from sim.files.command import choose_elites, command_line
from sim.robots.find import get_robot, resolve_robot
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import get_space


class EliteTerrain(NamedTuple):
    """The terrain of an elite, by its number, or its minimal terrain."""

    number: int
    genes: NDArray[np.float32]
    """Shape (num_genes,)."""
    stem: str
    """Name of files about it: ``elite-3`` or ``minimal-3``."""
    label: str
    """In words."""
    minimal: dict[str, Any] | None
    """What is known of a minimal terrain."""


@dataclass(frozen=True, kw_only=True)
class OpenedRun:
    """An archive, its robot, and the search that made it."""

    path: Path
    """What was given: a run directory or an archive file."""
    archive: Archive
    robot: RobotCfg

    @property
    def folder(self) -> Path:
        """The directory."""
        return find_directory(self.path)

    @property
    def space(self) -> TerrainSpace:
        """What the genes mean."""
        return get_space(self.archive.space, self.archive.space_sha256)

    def command(self, word: str, **flags: object) -> str:
        """A command about this run as a user types it."""
        space = self.space.name if self.space.sha256 else None  # code of a user's own runs only if named
        return command_line(word, robot=self.robot.spec, run=self.path, space=space, **flags)

    def as_searched(self) -> tuple[str, FitnessCfg]:
        """Controller and fitness of the search; defaults where the archive lies without its config."""
        archive, cfg = self.archive, self.search()
        if cfg is None:
            return SHIPPED, FitnessCfg(penalties=archive.penalties, scales=archive.scales)
        return cfg.policy, cfg.fitness

    def search(self) -> SearchCfg | None:
        """Settings of the search; None where the archive lies without them."""
        if not (self.folder / CONFIG_FILE).exists():
            return None
        cfg = RunDirectory(self.folder).read_cfg()
        check_config(self.archive, cfg, self.folder)
        return cfg

    def policy(self, given: str | None = None) -> str:
        """The controller to cross with: the one given, or that of the search."""
        cfg = self.search()
        if given is None and cfg is not None:
            return find_policy(self.path, cfg, self.robot)
        policy, searched = resolve_policy(given or SHIPPED, self.robot), self.archive.policy_sha256
        if given is None and searched not in (None, digest := controller_hash(policy)):
            raise ValueError(
                f"{self.path} was searched with another controller than {policy} (expected SHA-256 {searched}, got "
                f"{digest}): say with --policy which one to cross with"
            )
        return policy

    def suffix(self, policy: str) -> str:
        """The ending of the names of what is made with a controller: empty for the search's, else such as ``-C-G``."""
        searched, named = self.archive.policy_sha256, resolve_policy(self.as_searched()[0], self.robot)
        same = is_same_controller(policy, named) if searched is None else controller_hash(policy) == searched
        return "" if same else label_suffix(policy)

    def certifiers(self) -> dict[str, str]:
        """Files of the controllers that crossed its failing elites, as far as they are at hand, by their names.

        They are of the robot's panel, of the run, or beside a published run.
        """
        archive, folder = self.archive, self.folder
        names = dict(zip(archive.certifier_sha256, archive.certifiers, strict=True))
        own = [*controllers_in(folder / CERTIFIERS_FOLDER).values(), str(folder.parent / f"{folder.name}.pt")]
        files = [*controllers_in(self.robot.panel).values(), *own]
        return {names[digest]: file for file in files if (digest := str(controller_hash(file))) in names}

    def certifier(self, number: int) -> str | None:
        """Name of the one of :meth:`certifiers` that crosses an elite most often; None if none has a certificate."""
        return best_certifier(self.archive, number, self.certifiers())

    def minima(self) -> MinimalTerrains:
        """The minimal terrains of its elites."""
        minima = read_minimal(self.folder, self.archive)
        if minima is None:
            raise FileNotFoundError(f"{self.path} has no minimal terrains: make them with `faultline minimise`")
        return minima

    def terrains(self, elite: str = "", minimal: str | None = None) -> list[EliteTerrain]:
        """The terrains of elites, or if ``minimal`` is given the minimal terrains: numbers, or ``all``.

        Without a number it is the worst elite. Labels name what stops the robot, where that is known.
        """
        archive, minima = self.archive, read_minimal(self.folder, self.archive)
        half_width = self.robot.half_width
        if minimal is not None:
            minima = self.minima()
            numbers = minima.choose(minimal, self.path)
            known = [(minima.genes[n], f"minimal-{n}", f"minimal terrain {n}", minima.entry(n)) for n in numbers]
        else:
            if not elite and len(archive):
                elite = str(rank(archive, self.space, minima, half_width=half_width).worst(1)[0])
            numbers = choose_elites(elite or "0", range(len(archive)), f"{self.path} has no elite")
            known = [(archive.genes[n], f"elite-{n}", f"elite {n}", None) for n in numbers]
        causes = rank(archive, self.space, minima, half_width=half_width, numbers=numbers).causes
        return [
            EliteTerrain(n, genes, stem, label if cause in ("", UNCLEAR) else f"{label} ({cause})", entry)
            for n, (genes, stem, label, entry), cause in zip(numbers, known, causes, strict=True)
        ]


def open_run(named: str | None, run: Path | None = None, *, space: str | None = None) -> OpenedRun:
    """The archive of a run directory or file; without one the robot's newest under runs/, else its published one.

    Robot and terrain space are as the command line names them; without a robot it is that of the run.
    """
    run = find_run(get_robot(named or "anymal"), run)
    archive = read_archive(run)
    robot = resolve_robot(archive.named(), named, run)
    check_space(archive, space)
    return OpenedRun(path=run, archive=archive, robot=robot)
