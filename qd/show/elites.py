"""The archive of a run, its terrains, and the controller that was searched."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.faults.causes import UNCLEAR
from qd.faults.families import Ranking, rank
from qd.faults.numbers import MinimalTerrains, best_certifier, read_minimal
from qd.faults.searches import CERTIFIERS_FOLDER, controllers_in
from qd.search.archive import Archive, read_archive
from qd.search.directory import CONFIG_FILE, RunDirectory, check_config, check_space, find_directory, find_run
from qd.search.fitness import FitnessCfg
from qd.search.settings import SearchCfg, find_policy
from sim.controllers.spec import SHIPPED, controller_hash, is_same_controller, label_suffix, resolve_policy
from sim.files.command import choose_elites, command_line
from sim.robots.find import get_robot, resolve_robot
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.likely import Disturbance, choose_likely, find_log_likelihood
from sim.terrains.spaces.base import TerrainSpace


class EliteTerrain(NamedTuple):
    """The terrain of an elite, by its number, or its minimal terrain."""

    number: int
    genes: NDArray[np.float32]  # shape (num_genes,)
    cause: str  # what stops the robot; empty if nothing does, or nobody knows
    minimal: dict[str, Any] | None  # entry of a minimal terrain in minimal.json

    @property
    def stem(self) -> str:
        """Name of files about it: ``elite-3`` or ``minimal-3``."""
        return f"{'minimal' if self.minimal else 'elite'}-{self.number}"

    @property
    def label(self) -> str:
        """For people: ``elite 3 (ridge)``."""
        return f"{'minimal terrain' if self.minimal else 'elite'} {self.number}" + f" ({self.cause})" * bool(self.cause)


@dataclass(frozen=True, kw_only=True)
class OpenedRun:
    """An archive, its robot, and the search that made it."""

    path: Path  # a run directory or an archive file
    archive: Archive
    robot: RobotCfg
    minima: MinimalTerrains | None = None  # of its elites, if there are some
    likely: Mapping[str, Disturbance] = field(default_factory=dict)
    """How conditions are distributed; empty where that is not known."""

    @property
    def folder(self) -> Path:
        """The directory."""
        return find_directory(self.path)

    @property
    def space(self) -> TerrainSpace:
        """What the genes mean."""
        return self.archive.terrain_space

    @property
    def scales(self) -> dict[str, float]:
        """Scale of each penalty."""
        return dict(zip(self.archive.penalties, self.archive.scales, strict=True))

    def rank(self, **options: Any) -> Ranking:
        """Its elites by what is known best of each; ``options`` as of :func:`qd.faults.families.rank`."""
        known: Any = {"half_width": self.robot.half_width, "likely": self.likely}
        return rank(self.archive, self.space, self.minima, **known, **options)

    def log_likelihood(self, genes: NDArray[np.float32]) -> float | None:
        """Of the conditions of a terrain, (num_genes,); None where it is not known how these are distributed."""
        if not self.likely:
            return None
        return float(find_log_likelihood(self.space.condition_rows(genes[None]), self.likely)[0])

    def command(self, word: str, **flags: object) -> str:
        """A command about this run as a user types it."""
        space = self.space.name if self.space.sha256 else None  # code of a user's own runs only if named
        return command_line(word, robot=self.robot.spec, run=self.path, space=space, **flags)

    def as_searched(self) -> tuple[str, FitnessCfg]:
        """Controller and fitness of the search; defaults where the archive lies without its config."""
        if (cfg := self.search()) is not None:
            return cfg.policy, cfg.fitness
        return SHIPPED, FitnessCfg(penalties=self.archive.penalties, scales=self.archive.scales)

    def search(self) -> SearchCfg | None:
        """Settings of the search; None where the archive lies without them."""
        if not (self.folder / CONFIG_FILE).exists():
            return None
        cfg = RunDirectory(self.folder).read_cfg()
        check_config(self.archive, cfg, self.folder)
        return cfg

    def policy(self, named: str | None = None) -> str:
        """The controller to cross with: the named one, or that of the search."""
        if named is not None:
            return resolve_policy(named, self.robot)
        if (cfg := self.search()) is not None:
            return find_policy(self.path, cfg, self.robot)
        policy = resolve_policy(SHIPPED, self.robot)
        searched = self.archive.policy_sha256
        if searched not in (None, digest := controller_hash(policy)):
            differs = f"another controller than {policy} (expected SHA-256 {searched}, got {digest})"
            raise ValueError(f"{self.path} was searched with {differs}: say with --policy which one to cross with")
        return policy

    def suffix(self, policy: str) -> str:
        """Suffix of names of files about a controller's crossings: empty for the search's, else like ``-C-G``."""
        searched = self.archive.policy_sha256
        if searched is None:
            is_searched = is_same_controller(policy, resolve_policy(self.as_searched()[0], self.robot))
        else:
            is_searched = controller_hash(policy) == searched
        return "" if is_searched else label_suffix(policy)

    def certifiers(self) -> dict[str, str]:
        """Files of its certifiers by name, as far as they exist: of the panel, the run, or beside a published run."""
        names = dict(zip(self.archive.certifier_sha256, self.archive.certifiers, strict=True))
        files = [*controllers_in(self.robot.panel).values(), *controllers_in(self.folder / CERTIFIERS_FOLDER).values()]
        files.append(str(self.folder.parent / f"{self.folder.name}.pt"))
        return {names[digest]: file for file in files if (digest := str(controller_hash(file))) in names}

    def certifier(self, number: int) -> str | None:
        """Name of the certifier that crosses an elite most often, of :meth:`certifiers`; None without a certificate."""
        return best_certifier(self.archive, number, self.certifiers())

    def terrains(self, elite: str = "", minimal: str | None = None) -> list[EliteTerrain]:
        """The terrains of elites, the worst one if none is named, or minimal terrains: numbers, or ``all``."""
        genes: Any = self.archive.genes
        if minimal is None:
            if not elite and len(self.archive):
                elite = str(self.rank().worst(1)[0])
            numbers = choose_elites(elite or "0", range(len(self.archive)), f"{self.path} has no elite")
            entries = dict.fromkeys(numbers)
        elif self.minima is None:
            raise FileNotFoundError(f"{self.path} has no minimal terrains: make them with `faultline minimise`")
        else:
            genes = self.minima.genes
            numbers = choose_elites(minimal, [*self.minima.genes], f"{self.path} has no minimal terrain of elite")
            entries = {number: self.minima.entry(number) for number in numbers}
        return [
            EliteTerrain(number, genes[number], "" if cause == UNCLEAR else cause, entries[number])
            for number, cause in zip(numbers, self.rank(numbers=numbers).causes, strict=True)
        ]


def open_run(
    named: str | None, run: Path | None = None, *, space: str | None = None, likely: Path | None = None
) -> OpenedRun:
    """The archive of a run directory or file; without one the robot's newest under runs/, else its published one.

    Robot and terrain space are as the command line names them; without a robot it is that of the run. ``likely`` is the
    file of :func:`sim.terrains.conditions.likely.choose_likely`, in place of what the search knew.
    """
    run = find_run(get_robot(named or "anymal"), run)
    archive = read_archive(run)
    robot = resolve_robot(archive.named(), named, run)
    check_space(archive, space)
    opened = OpenedRun(path=run, archive=archive, robot=robot, minima=read_minimal(find_directory(run), archive))
    searched = opened.as_searched()[1].disturbances if opened.space.conditions and not likely else None
    return replace(opened, likely=searched or choose_likely(opened.space, likely))
