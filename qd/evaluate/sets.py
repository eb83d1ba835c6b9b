"""The terrains that controllers are evaluated on, and which elites of an archive are held out of training for that.

A test set is drawn from random numbers used nowhere else: not in training, calibration or search. All controllers meet
the same terrains with the same episode seeds. Validation sets, by which settings are chosen, have other terrains of the
same kinds: nothing is chosen by what is reported.

Which elites are held out follows from the archive and the seed of the split. An archive that grew, or another seed,
holds out others, among them some that a controller was trained on before: marks in its record tell.
"""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.groups import families_of, rms_distances
from qd.run.directory import directory_of, read_archive_of, search_seed
from sim.bank import heights_of
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.policy.spec import ControllerSpec
from sim.robots.robot import RobotCfg
from sim.space import SUPER_GAUSSIAN, TerrainSpace, get_space
from sim.terrain import NUM_COLS, NUM_ROWS, hand_crafted_crossings

HELD_OUT, INDEPENDENT = ("generated", "generated_far"), "generated_independent"
"""Sets of elites: held out of training, the second a part of the first; and of another search."""
FROM_ARCHIVE = (*HELD_OUT, INDEPENDENT)
"""Those made of elites."""
SETS = ("hand_crafted", "hard_random", *FROM_ARCHIVE)
"""Sets of the tables."""
Part = Literal["test", "validation"]
"""What terrains are for: to be reported, or to choose settings by."""
PAPER_TERRAINS = {"anymal": 300, "cassie": 180}
"""Terrains of each of the paper's test sets."""
PAPER_TRAINING_ELITES = 750
"""Elites that the paper trains on."""
_OTHER_TERRAINS = 300  # of a robot that the paper does not have
_HELD_OUT_SHARE = 0.2
_VALIDATION_SHARE = 0.1  # of as many elites as are trained on
MIN_ELITES = 5
"""Fewest elites that can be split: a fifth of them is one."""

_KEYS = {"test": 20250604, "validation": 20250606}  # with the set's number and the seed, the entropy of a set
_SPLIT_KEY = 20250605
_NUMBERS = {"hand_crafted": 0, "hard_random": 1, "flat": 2, "generated": 3, "pack": 4, INDEPENDENT: 5, "dose": 6}
_BANK = 50  # height maps that are compared at once

TRAINED_ON = "trained_on"
"""Key of the training record, and of checkpoint and controller, with the marks of all elites trained on."""
_MARK_LENGTH = 12  # of 2,000 elites, two have the same with a chance of one in 100 million


@dataclass(frozen=True, kw_only=True)
class EliteSplit:
    """Elites to train on and elites held out; no elite is in two parts."""

    train: NDArray[np.int64]
    """Rows of the archive to train on, in the order drawn."""
    validation: NDArray[np.int64]
    """Rows held out to choose settings by, likewise; none in a split of before there were such."""
    test: NDArray[np.int64]
    """Rows held out to be reported, in the order drawn: the first n are a random choice of n of them."""

    def part(self, part: Part) -> NDArray[np.int64]:
        """Rows held out for a purpose."""
        return self.test if part == "test" else self.validation


@dataclass(frozen=True, kw_only=True)
class Certificates:
    """Who is known to cross T elites that the controller of their search fails (:class:`qd.archive.FaultCounts`)."""

    certifiers: tuple[str, ...]
    """Names of C controllers."""
    sha256: tuple[str, ...]
    """Their hashes."""
    given: NDArray[np.bool_]
    """Whether each certifies each elite, shape (T, C)."""
    searched_sha256: str | None
    """Hash of the controller of the search."""

    @classmethod
    def of(cls, archive: Archive, rows: NDArray[np.int64]) -> "Certificates | None":
        """Those of some elites; None where no certifier was asked."""
        if archive.faults is None or not archive.faults.certifiers:
            return None
        given = archive.faults.certificates() & archive.failing[:, None]
        return cls(
            certifiers=archive.faults.certifiers, sha256=archive.faults.certifier_sha256, given=given[rows],
            searched_sha256=archive.policy_sha256,
        )  # fmt: skip

    @property
    def certified(self) -> NDArray[np.bool_]:
        """Whether anybody certifies each elite, shape (T,)."""
        return np.any(self.given, axis=1).reshape(len(self.given))


@dataclass(frozen=True, kw_only=True)
class TerrainSet:
    """T terrains with the seeds of their episodes."""

    name: str
    terrains: NDArray[np.float32]
    """Genes, shape (T, num_genes), or heights [m], shape (T, NUM_ROWS, NUM_COLS)."""
    seeds: NDArray[np.uint32]
    """Seed of each terrain's episodes, shape (T,)."""
    numbers: NDArray[np.int64]
    """Number of each terrain: of an elite its row in the archive, of others their place in the set; shape (T,)."""
    types: NDArray[np.int64] | None = None
    """Index into :data:`sim.terrain.CROSSING_TYPES` of each hand-crafted terrain, shape (T,)."""
    levels: NDArray[np.int64] | None = None
    """Level of each hand-crafted terrain, likewise."""
    space: str = SUPER_GAUSSIAN.name
    """Terrain space of genes, as :func:`sim.space.load_space` takes it."""
    families: NDArray[np.int64] | None = None
    """Number of each elite's family (:func:`qd.families.families_of`), shape (T,); None of independent terrains."""
    certificates: Certificates | None = None
    """Who crosses elites; None of other terrains, and where nobody was asked."""

    def __len__(self) -> int:
        """Number of terrains."""
        return len(self.seeds)


def paper_terrains(robot: str) -> int:
    """Terrains a set of the published tables of a robot; 300 of one that the paper does not have."""
    return PAPER_TERRAINS.get(robot, _OTHER_TERRAINS)


def split_elites(
    archive: Archive,
    robot: str,
    seed: int = 0,
    *,
    spec: str | None = None,
    run: Path | None = None,
    keep_validation: bool = True,
) -> EliteSplit:
    """Draw at random which elites are trained on and which are held out.

    The paper's numbers where the archive has so many: 750 to train on, 300 (ANYmal) or 180 (Cassie) for the test; else
    80 % and 20 %. A tenth as many as are to be trained on are for validation, at least one. They are those that
    training leaves over, if there are so many; else training has so many fewer. The draw depends on the elites' genes
    and the seed alone, not on their order in the file: evaluating an archive again, which reorders it, moves no elite
    from one part to the other.

    Args:
        archive: The elites.
        robot: Name of the robot that is trained and evaluated.
        seed: Of the draw, from 0 on; training and evaluation must name the same one.
        spec: What the command line calls the robot, for errors; ``robot`` if left out.
        run: Where the archive lies, for errors.
        keep_validation: Whether there is a validation part; False splits as versions did that had none.

    Raises:
        ValueError: If the archive is of another robot, or has fewer than 5 elites.
    """
    _check_robot_of(archive, robot, spec)
    if len(archive) < MIN_ELITES:
        more = {"resume": directory_of(run) if run else "RUN", "iterations": 2 * archive.iterations}
        raise ValueError(
            f"an archive to be split into training and test terrains needs at least {MIN_ELITES} elites, got "
            f"{len(archive)}: let its search go on with `{command_line('archive', robot=spec or robot, **more)}`"
        )
    num_train, num_test = PAPER_TRAINING_ELITES, paper_terrains(robot)
    if len(archive) < num_train + num_test:
        num_test = round(_HELD_OUT_SHARE * len(archive))
        num_train = len(archive) - num_test
    num_validation = max(1, round(_VALIDATION_SHARE * num_train)) if keep_validation else 0
    drawn = _in_order_of_genes(archive)[_split_rng(archive, seed).permutation(len(archive))]
    test, rest = drawn[:num_test], drawn[num_test:]
    num_train = min(num_train, len(rest) - num_validation)
    return EliteSplit(train=rest[:num_train], validation=rest[num_train : num_train + num_validation], test=test)


def _check_robot_of(archive: Archive, robot: str, spec: str | None) -> None:
    if archive.robot != robot:
        raise ValueError(
            f"the archive must be of robot '{robot}', got one of '{archive.robot}': its terrains were found to break "
            f"another body; give an archive of '{robot}', which `{command_line('archive', robot=spec or robot)}` makes"
        )


def _split_rng(archive: Archive, seed: int) -> np.random.Generator:
    return np.random.default_rng([_SPLIT_KEY, seed, int(elites_sha256(archive)[:16], 16)])


def _in_order_of_genes(archive: Archive) -> NDArray[np.int64]:
    """Rows of an archive in an order that does not depend on that of the file."""
    return np.lexsort(archive.genes.T[::-1])


def elites_sha256(archive: Archive) -> str:
    """Hash of an archive's genes, whatever their order."""
    genes = archive.genes[_in_order_of_genes(archive)]
    return hashlib.sha256(np.ascontiguousarray(genes).tobytes()).hexdigest()


def set_rng(name: str, seed: int, part: Part = "test") -> np.random.Generator:
    """Random numbers of a set, shared with no other use of ``seed`` in the project."""
    return np.random.default_rng([_KEYS[part], _NUMBERS[name], seed])


def plain_set(
    name: str, count: int, seed: int, space: TerrainSpace = SUPER_GAUSSIAN, part: Part = "test"
) -> TerrainSet:
    """``count`` terrains of a set that needs no archive: ``hand_crafted``, ``hard_random`` of a space, or ``flat``."""
    rng = set_rng(name, seed, part)
    types = levels = None
    if name == "hand_crafted":
        terrains, types, levels = hand_crafted_crossings(count, rng)
    elif name == "hard_random":
        terrains = space.hard_random(count, rng)
    else:
        terrains = np.zeros((count, NUM_ROWS, NUM_COLS), np.float32)
    return TerrainSet(
        name=name,
        terrains=terrains,
        seeds=rng.integers(2**32, size=count, dtype=np.uint32),
        numbers=np.arange(count),
        types=types,
        levels=levels,
        space=space.name,
    )


def generated_set(archive: Archive, split: EliteSplit, count: int, seed: int, part: Part = "test") -> TerrainSet:
    """Held-out elites: the first ``count`` drawn, or all of them; ``seed`` is that of their episodes."""
    held_out = split.part(part)
    seeds = set_rng("generated", seed, part).integers(2**32, size=len(held_out), dtype=np.uint32)
    return _set_of_elites("generated", archive, held_out[:count], seeds[:count])


def independent_set(archive: Archive, count: int, seed: int) -> TerrainSet:
    """Elites that nobody was trained on: ``count`` of them, or all; ``seed`` draws them and their episodes."""
    rng = set_rng(INDEPENDENT, seed)
    rows = _in_order_of_genes(archive)[rng.permutation(len(archive))]
    seeds = rng.integers(2**32, size=len(archive), dtype=np.uint32)
    return _set_of_elites(INDEPENDENT, archive, rows[:count], seeds[:count])


def _set_of_elites(name: str, archive: Archive, rows: NDArray[np.int64], seeds: NDArray[np.uint32]) -> TerrainSet:
    space = space_of(archive)
    return TerrainSet(
        name=name, terrains=archive.genes[rows], seeds=seeds, numbers=rows, space=space.name,
        families=families_of(archive.genes[rows], space), certificates=Certificates.of(archive, rows),
    )  # fmt: skip


def space_of(archive: Archive) -> TerrainSpace:
    """What an archive's genes mean.

    Raises:
        ValueError: If its space is not at hand (:func:`sim.space.get_space`).
    """
    return get_space(archive.space, archive.space_sha256)


def far_part(distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """Places of the third of terrains with the largest distance to its nearest training terrain, ascending."""
    count = -(-len(distance) // 3)
    return np.sort(np.argsort(-distance, kind="stable")[:count])


def part_of(whole: TerrainSet, places: NDArray[np.int64], name: str) -> TerrainSet:
    """Some of a set's terrains under a name of their own; their episodes are the same."""
    families, given = whole.families, whole.certificates
    return replace(
        whole, name=name, terrains=whole.terrains[places], seeds=whole.seeds[places], numbers=whole.numbers[places],
        families=None if families is None else families[places],
        certificates=None if given is None else replace(given, given=given.given[places]),
    )  # fmt: skip


def nearest_distance(
    genes: NDArray[np.float32], training_genes: NDArray[np.float32], space: TerrainSpace = SUPER_GAUSSIAN
) -> NDArray[np.float64]:
    """Root mean square distance of height maps to the nearest of others.

    Args:
        genes: Terrains, shape (T, num_genes).
        training_genes: Terrains to be far from, shape (N, num_genes).
        space: What the genes of both mean.

    Returns:
        Distance to the nearest over all nodes [m], shape (T,). Computed on the CPU, so that it is the same everywhere.
    """
    maps = _heights(genes, space)
    nearest = np.full(len(maps), np.inf)
    for first in range(0, len(training_genes), _BANK):
        others = _heights(training_genes[first : first + _BANK], space)
        nearest = np.minimum(nearest, rms_distances(maps, others).min(axis=1))
    return nearest


def _heights(genes: NDArray[np.float32], space: TerrainSpace) -> NDArray[np.float64]:
    """Height maps [m] as rows, as :func:`qd.groups.rms_distances` takes them."""
    return heights_of(genes, space).reshape(len(genes), -1).astype(np.float64)


def make_sets(
    names: Sequence[str],
    count: int,
    seed: int,
    *,
    archive: Archive | None = None,
    split: EliteSplit | None = None,
    independent: Archive | None = None,
    space: TerrainSpace = SUPER_GAUSSIAN,
    part: Part = "test",
) -> dict[str, TerrainSet]:
    """The sets of the tables by name, in the order of :data:`SETS`.

    Args:
        names: Some of :data:`SETS`.
        count: Terrains a set; of generated ones fewer where the archive holds out fewer.
        seed: Draws the sets.
        archive: Elites for ``generated`` and ``generated_far``.
        split: Which of them are held out.
        independent: Elites for ``generated_independent``.
        space: Of the hard-random ones.
        part: What the terrains are for.

    Raises:
        ValueError: If a name is unknown or given twice, or a set is made of elites and there are none.
    """
    unknown = [name for name in names if name not in SETS]
    if unknown or not names:
        raise ValueError(f"sets must be some of {', '.join(SETS)}, got {', '.join(unknown) or 'none'}")
    if len(set(names)) < len(names):
        raise ValueError(f"each set may be named once, got {', '.join(names)}")
    missing = [name for name in names if name in HELD_OUT and archive is None]
    if missing:
        raise ValueError(f"set {', '.join(missing)} is made of elites: give the run that found them (--archive RUN)")
    sets = {name: plain_set(name, count, seed, space, part) for name in names if name not in FROM_ARCHIVE}
    if archive is not None and split is not None:
        sets["generated"] = whole = generated_set(archive, split, count, seed, part)
        if "generated_far" in names:
            far = far_part(nearest_distance(whole.terrains, archive.genes[split.train], space_of(archive)))
            sets["generated_far"] = part_of(whole, far, "generated_far")
    if INDEPENDENT in names:
        sets[INDEPENDENT] = independent_set(_given(independent), count, seed)
    return {name: sets[name] for name in SETS if name in names}


def _given(independent: Archive | None) -> Archive:
    if independent is None:
        raise ValueError(
            f"set {INDEPENDENT} is made of elites of another search than the one trained on, to be reported and not "
            "chosen by: give its run (--independent RUN)"
        )
    return independent


def read_independent(
    robot: RobotCfg,
    path: Path,
    *,
    archive: Archive | None = None,
    archive_path: Path | None = None,
    named: str | None = None,
) -> Archive:
    """The archive of another search, which shares no elite and no ancestor of one with an archive.

    Args:
        robot: Who is to cross its elites.
        path: Run directory or archive file.
        archive: The archive that is trained on; None if there is none to be independent of.
        archive_path: Where that lies.
        named: Terrain space that the command line names.

    Raises:
        FileNotFoundError: If there is none at the path.
        ValueError: If it is damaged, empty, of another robot or terrain space, or not of another search.
    """
    found = read_archive_of(robot, path, named)
    _check_robot_of(found, robot.name, robot.spec)
    if not len(found):
        raise ValueError(f"independent must be a search that found something, got {path} without elites")
    if archive is None or archive_path is None:
        return found
    search = "give the run of a search with another --seed"
    if (found.space, found.space_sha256) != (archive.space, archive.space_sha256):
        raise ValueError(
            f"independent must be of the terrain space of --archive {archive_path}, {archive.space}, got {path} of "
            f"{found.space}: {search} in that space"
        )
    if shared := len(set(marks_of(found.genes)) & set(marks_of(archive.genes))):
        raise ValueError(
            f"independent must share no elite with --archive {archive_path}, got {path} with {shared} of its "
            f"{len(found)} in both: {search}"
        )
    seeds = search_seed(path), search_seed(archive_path)
    if seeds[0] is not None and seeds[0] == seeds[1]:
        raise ValueError(
            f"independent must be of another search seed than --archive {archive_path}, got seed {seeds[0]} in both "
            f"{path} and there, whose searches begin with the same terrains: {search}"
        )
    return found


def marks_of(genes: NDArray[np.float32]) -> list[str]:
    """A short mark of each elite that depends on its genes, shape (E, num_genes), alone."""
    rows = np.ascontiguousarray(genes, np.float32)
    return [hashlib.sha256(row.tobytes()).hexdigest()[:_MARK_LENGTH] for row in rows]


def recorded_marks(policy: str) -> set[str]:
    """Marks of the elites that a controller was trained on; none where neither its file nor a record beside it has any.

    Raises:
        ValueError: If the marks are damaged.
    """
    found: set[str] = set()
    for file in ControllerSpec.parse(policy).files:
        record = file.with_suffix(".train.json")
        contents = [(record, read_json(record))] if record.is_file() else []
        for place, content in (*contents, *((file, part) for part in _parts_of(file))):
            marks = content.get(TRAINED_ON, [])
            if not isinstance(marks, list) or not all(isinstance(mark, str) for mark in marks):
                raise ValueError(f"{place} is damaged at {TRAINED_ON}: put a copy of it back")
            found |= set(marks)
    return found


def _parts_of(file: Path) -> list[dict[str, Any]]:
    """Where marks may stand in a file of weights: itself, and what a checkpoint has beside the networks."""
    if file.suffix.lower() in (".py", ".onnx") or not file.is_file():
        return []
    try:
        from sim.policy.loaders import read_weights

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of TorchScript files, which have none
            content = read_weights(file)
    except Exception:  # another kind of file, which has no marks
        return []
    parts = [content, content.get("extra")] if isinstance(content, dict) else []
    return [part for part in parts if isinstance(part, dict)]


def check_untrained(controllers: Mapping[str, str], genes: NDArray[np.float32], elites: str, remedy: str) -> None:
    """Refuse to test a controller on terrains that it was trained on.

    Args:
        controllers: Policy of each controller by its name.
        genes: Elites, shape (T, num_genes).
        elites: What they are, for the message.
        remedy: What to do, likewise.

    Raises:
        ValueError: If one of the controllers was trained on some of them, as far as its record says; naming it.
    """
    marks = marks_of(genes)
    for name, policy in controllers.items():
        trained_on = recorded_marks(policy)
        if count := sum(mark in trained_on for mark in marks):
            raise ValueError(f"{name} was trained on {count} of the {len(marks)} elites {elites}: {remedy}")


def check_held_out(
    controllers: Mapping[str, str], genes: NDArray[np.float32], split_seed: int, part: Part = "test"
) -> None:
    """:func:`check_untrained` of elites that the split of ``split_seed`` holds out for a purpose.

    Args:
        controllers: Policy of each controller by its name.
        genes: The elites, shape (T, num_genes).
        split_seed: For the message.
        part: Likewise.
    """
    remedy = "give the archive as it was then and the split seed of its training"
    if part == "validation":
        remedy += "; one that was trained before any were held out for validation must be trained anew"
    check_untrained(controllers, genes, f"that split seed {split_seed} holds out of this archive for {part}", remedy)
