"""The terrains that controllers are evaluated on, and which elites of an archive are held out of training.

A test set is drawn from random numbers used nowhere else. All controllers cross the same terrains with the same seeds.
Validation sets, by which settings are chosen, have other terrains of the same kinds. An archive that grew holds other
elites out; the marks of those trained on, in a controller's file or its training record, say which it has seen.
"""

import hashlib
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.labels import HELD_OUT, INDEPENDENT, SETS
from qd.faults.families import find_families, rms_distances
from qd.search.archive import Archive
from qd.search.directory import read_robot_archive, search_seed
from qd.search.fitness import ColumnTable
from sim.controllers.formats.rsl_rl import read_weights
from sim.controllers.spec import ControllerSpec
from sim.files.atomic import read_json
from sim.robots.robot import ROBOTS, RobotCfg
from sim.robots.training import PaperCfg
from sim.terrains.bank import make_heights
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, hand_crafted_crossings
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains

TRAINED_ON = "trained_on"  # key of training record, checkpoint and controller, with the marks of all elites trained on
_MARK_LENGTH = 12  # of 2,000 elites, two have the same with a chance of one in 100 million
Purpose = Literal["test", "validation"]  # what terrains are for: numbers to report, or the choice of settings
MIN_ELITES = 5  # fewest elites that can be split: a fifth of them is one
_TRAINING_ELITES = 750  # the paper's
_HELD_OUT_SHARE = 0.2
_VALIDATION_SHARE = 0.1  # of as many elites as are trained on
_KEYS = {"test": 20250604, "validation": 20250606}  # with index of name and seed, the entropy of a set
_SPLIT_KEY = 20250605
_NAMES = ("hand_crafted", "hard_random", "flat", "generated", "pack", INDEPENDENT, "dose", "elites")
_BANK = 50  # height maps that are compared at once


class EliteSplit(NamedTuple):
    """Elites to train on and elites held out, as rows of the archive in the order drawn; the three are disjoint."""

    train: NDArray[np.int64]
    validation: NDArray[np.int64]  # held out for the choice of settings
    test: NDArray[np.int64]  # held out for reported numbers: the first n are a random choice of n of them


@dataclass(frozen=True, kw_only=True)
class TerrainSet(ColumnTable):
    """T terrains to cross, and what is known of each."""

    terrains: Terrains
    numbers: NDArray[np.int64]  # of each terrain, shape (T,): an elite's row in the archive, else the index in the set
    types: NDArray[np.int64] | None = None  # index into CROSSING_TYPES of each hand-crafted terrain, shape (T,)
    levels: NDArray[np.int64] | None = None  # level of each hand-crafted terrain, shape (T,)
    elites: Archive | None = None  # the elites as an archive, with their families; None of other terrains

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def families(self) -> NDArray[np.int64] | None:
        """Number of each elite's family, shape (T,); None of independent terrains."""
        return None if self.elites is None else self.elites.family

    @property
    def certified(self) -> NDArray[np.bool_] | None:
        """Whether another controller crosses each elite that the searched one fails, shape (T,); None if unknown."""
        return self.elites.certified_by_controllers if self.elites is not None and self.elites.certifiers else None


def paper_terrains(robot: str) -> int:
    """Terrains a set of the published tables of a robot; 300 of one that the paper does not have."""
    return (ROBOTS[robot].paper if robot in ROBOTS else PaperCfg()).test_terrains


def split_elites(archive: Archive, *, held_out: bool = True) -> EliteSplit:
    """Draw at random which elites are trained on and which are held out; without ``held_out`` all are trained on.

    Of as many elites as the paper's, 750 are trained on and 300 (ANYmal) or 180 (Cassie) tested on; else 80 % and 20 %.
    Validation has a tenth as many as training from those left over, or else of training's. The draw depends on the
    genes alone: judging an archive again, which reorders it, changes no elite's purpose.
    """
    if not held_out:
        none = np.zeros(0, np.int64)
        return EliteSplit(train=_sort_by_genes(archive), validation=none, test=none)
    if len(archive) < MIN_ELITES:
        rule = f"an archive to be split into training and test terrains needs at least {MIN_ELITES} elites"
        raise ValueError(f"{rule}, got {len(archive)}: let its search go on")
    num_train, num_test = _TRAINING_ELITES, paper_terrains(archive.robot)
    if len(archive) < num_train + num_test:
        num_test = round(_HELD_OUT_SHARE * len(archive))
        num_train = len(archive) - num_test
    num_validation = max(1, round(_VALIDATION_SHARE * num_train))
    rng = np.random.default_rng([_SPLIT_KEY, 0, int(elites_sha256(archive)[:16], 16)])
    drawn = _sort_by_genes(archive)[rng.permutation(len(archive))]
    num_train = min(num_train, len(archive) - num_test - num_validation)
    test, train, validation, _ = np.split(drawn, np.cumsum([num_test, num_train, num_validation]))
    return EliteSplit(train=train, validation=validation, test=test)


def _sort_by_genes(archive: Archive) -> NDArray[np.int64]:
    """Rows of an archive in an order that does not depend on that of the file."""
    return np.lexsort(archive.genes.T[::-1])


def elites_sha256(archive: Archive) -> str:
    """Hash of an archive's genes, whatever their order."""
    return hashlib.sha256(np.ascontiguousarray(archive.genes[_sort_by_genes(archive)]).tobytes()).hexdigest()


def read_independent(path: Path, archive_path: Path | None, robot: RobotCfg, space: str | None = None) -> Archive:
    """The archive of another search, which shares no elite and no ancestor with that of ``archive_path``, if given."""
    independent = read_robot_archive(robot, path, space)
    if not len(independent):
        raise ValueError(f"independent must be a search that found something, got {path} without elites")
    if archive_path is not None:
        archive = read_robot_archive(robot, archive_path, space)
        seed = search_seed(path)
        shared = len({*hash_elites(independent.genes)} & {*hash_elites(archive.genes)})
        other_space = (independent.space, independent.space_sha256) != (archive.space, archive.space_sha256)
        if other_space or shared or (seed is not None and seed == search_seed(archive_path)):
            rule = f"be of space {archive.space} and share neither elites nor the search's seed with {archive_path}"
            got = f"{path} of {independent.space} and seed {seed} with {shared} elites in both"
            raise ValueError(f"independent must {rule}, got {got}: give a search with another seed")
    return independent


def set_rng(name: str, seed: int, purpose: Purpose = "test") -> np.random.Generator:
    """Random numbers of a set, shared with no other use of ``seed`` in the project."""
    return np.random.default_rng([_KEYS[purpose], _NAMES.index(name), seed])


def draw_seeds(rng: np.random.Generator, count: int) -> NDArray[np.uint32]:
    """Seeds of the episodes of a set, shape (count,)."""
    return rng.integers(2**32, size=count, dtype=np.uint32)


def plain_set(
    name: str, count: int, seed: int, space: TerrainSpace = SUPER_GAUSSIAN, purpose: Purpose = "test"
) -> TerrainSet:
    """``count`` terrains of a set that needs no archive: ``hand_crafted``, ``hard_random`` of a space, or ``flat``."""
    rng = set_rng(name, seed, purpose)
    values: dict[str, Any] = {"heights": np.zeros((count, NUM_ROWS, NUM_COLS), np.float32)}
    types = levels = None
    if name == "hand_crafted":
        values["heights"], types, levels = hand_crafted_crossings(count, rng)
        values["heights"] *= np.float32(space.height_share)
    elif name == "hard_random":
        values = {"genes": space.hard_random(count, rng)}
    terrains = Terrains(seeds=draw_seeds(rng, count), space=space, **values)
    return TerrainSet(terrains=terrains, numbers=np.arange(count), types=types, levels=levels)


def generated_set(archive: Archive, count: int, seed: int, purpose: Purpose = "test") -> TerrainSet:
    """Held-out elites: the first ``count`` drawn, or all of them; ``seed`` is that of their episodes."""
    split = split_elites(archive)
    held_out = split.test if purpose == "test" else split.validation
    seeds = draw_seeds(set_rng("generated", seed, purpose), len(held_out))
    return _set_of_elites(archive, held_out[:count], seeds[:count])


def random_elites(name: str, archive: Archive, count: int, seed: int, trained_on: Set[str] = frozenset()) -> TerrainSet:
    """``count`` elites, or all, without those of some marks (:func:`hash_elites`); ``seed`` draws them."""
    rng = set_rng(name, seed)
    rows = _sort_by_genes(archive)[rng.permutation(len(archive))]
    seeds = draw_seeds(rng, len(archive))
    untrained = ~np.isin(hash_elites(archive.genes[rows]), [*trained_on])
    return _set_of_elites(archive, rows[untrained][:count], seeds[untrained][:count])


def _set_of_elites(archive: Archive, rows: NDArray[np.int64], seeds: NDArray[np.uint32]) -> TerrainSet:
    """A set of elites with their families in the whole archive, if it was judged: kin of kin may not be in the set."""
    elites = archive.rows(rows)
    space = archive.terrain_space
    if elites.family is None:
        elites = replace(elites, family=find_families(elites.genes, space))
    return TerrainSet(terrains=Terrains(genes=elites.genes, seeds=seeds, space=space), numbers=rows, elites=elites)


def nearest_distance(
    genes: NDArray[np.float32], training_genes: NDArray[np.float32], space: TerrainSpace = SUPER_GAUSSIAN
) -> NDArray[np.float64]:
    """RMS distance [m] of T height maps to the nearest training map, (T,); on the CPU, so it is the same everywhere."""
    banks = (make_heights(rows, space) for rows in (genes, training_genes))
    maps, training_maps = (bank.reshape(len(bank), -1).astype(np.float64) for bank in banks)
    banks = (training_maps[first : first + _BANK] for first in range(0, len(training_maps), _BANK))
    return np.min([rms_distances(maps, bank).min(axis=1) for bank in banks], axis=0)


def make_sets(
    names: Sequence[str],
    count: int,
    seed: int,
    *,
    archive: Archive | None = None,
    independent: Archive | None = None,
    space: TerrainSpace = SUPER_GAUSSIAN,
    purpose: Purpose = "test",
) -> dict[str, TerrainSet]:
    """The sets of the tables by name, in the order of :data:`qd.evaluate.labels.SETS`; without names all possible ones.

    Each has ``count`` terrains, or all that there are; elites are of ``archive``, held out, and ``independent``.
    """
    lacking = {*(HELD_OUT if archive is None else ()), *((INDEPENDENT,) if independent is None else ())}
    names = names or [name for name in SETS if name not in lacking]
    if unknown := [name for name in names if name not in SETS]:
        raise ValueError(f"sets must be some of {', '.join(SETS)}, got {', '.join(unknown)}")
    if missing := [name for name in names if name in lacking]:
        raise ValueError(f"sets {', '.join(missing)} are made of elites: give --archive or --independent")
    plain = [name for name in names if name not in (*HELD_OUT, INDEPENDENT)]
    sets = {name: plain_set(name, count, seed, space, purpose) for name in plain}
    if archive is not None and not set(HELD_OUT).isdisjoint(names):
        sets["generated"] = whole = generated_set(archive, count, seed, purpose)
        if "generated_far" in names:
            training_genes = archive.genes[split_elites(archive).train]
            distance = nearest_distance(whole.terrains.values, training_genes, whole.terrains.space)
            sets["generated_far"] = whole.rows(np.sort(np.argsort(-distance, kind="stable")[: -(-len(whole) // 3)]))
    if independent is not None and INDEPENDENT in names:
        sets[INDEPENDENT] = random_elites(INDEPENDENT, independent, count, seed)
    return {name: sets[name] for name in SETS if name in names}


def hash_elites(genes: NDArray[np.float32]) -> list[str]:
    """A short mark of each elite that depends on its genes, shape (E, num_genes), alone."""
    rows = np.ascontiguousarray(genes, np.float32)
    return [hashlib.sha256(row.tobytes()).hexdigest()[:_MARK_LENGTH] for row in rows]


def read_trained_on(policy: str) -> set[str]:
    """Marks of the elites that a controller was trained on, by its file and the record beside it; none if none are."""
    marks: set[str] = set()
    for file in ControllerSpec.parse(policy).files:
        record = file.with_suffix(".train.json")
        contents: list[Any] = [read_json(record)] if record.is_file() else []
        with suppress(Exception):  # another kind of file has no marks
            contents.append(read_weights(file))
        for content in contents:
            recorded = content.get(TRAINED_ON, []) if isinstance(content, dict) else []
            if not isinstance(recorded, list) or not all(isinstance(mark, str) for mark in recorded):
                raise ValueError(f"{file} or the record beside it is damaged at {TRAINED_ON}: put a copy of it back")
            marks.update(recorded)
    return marks


def check_untrained(controllers: Mapping[str, str], genes: NDArray[np.float32], elites: str) -> None:
    """Refuses to test controllers on elites, shape (T, num_genes), that they were trained on."""
    marks = hash_elites(genes)
    for name, policy in controllers.items():
        if count := len(read_trained_on(policy).intersection(marks)):
            got = f"{count} of the {len(marks)} elites of {elites}"
            remedy = "give the archive as it was when it was trained, or another search"
            raise ValueError(f"{name} must not be tested on what it was trained on, got {got}: {remedy}")
