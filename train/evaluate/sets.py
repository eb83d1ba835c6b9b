"""The terrains that controllers are evaluated on, and which elites of an archive are held out of training for that.

A test set is drawn from random numbers used nowhere else: not in training, calibration or search. All controllers meet
the same terrains with the same episode seeds.

Which elites are held out follows from the archive and the seed of the split. An archive that grew, or another seed,
holds out others, among them some that a controller was trained on before: marks in its record tell.
"""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.families import families_of, rms_distances
from qd.run.directory import directory_of
from sim.bank import heights_of
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.policy.spec import ControllerSpec
from sim.space import SUPER_GAUSSIAN, TerrainSpace, get_space
from sim.terrain import NUM_COLS, NUM_ROWS, hand_crafted_crossings

SETS = ("hand_crafted", "hard_random", "generated", "generated_far")
"""Sets of the tables; the last two need an archive, and the last is a part of the third."""
FROM_ARCHIVE = ("generated", "generated_far")
"""Those made of elites."""
PAPER_TERRAINS = {"anymal": 300, "cassie": 180}
"""Terrains of each of the paper's test sets."""
PAPER_TRAINING_ELITES = 750
"""Elites that the paper trains on."""
_OTHER_TERRAINS = 300  # of a robot that the paper does not have
_HELD_OUT_SHARE = 0.2
MIN_ELITES = 5
"""Fewest elites that can be split: a fifth of them is one."""

_TEST_KEY = 20250604  # with the set's number and the seed, the entropy of a test set
_SPLIT_KEY = 20250605
_NUMBERS = {"hand_crafted": 0, "hard_random": 1, "flat": 2, "generated": 3, "pack": 4, "dose": 5}
_BANK = 50  # height maps that are compared at once

TRAINED_ON = "trained_on"
"""Key of the training record, and of checkpoint and controller, with the marks of all elites trained on."""
_MARK_LENGTH = 12  # of 2,000 elites, two have the same with a chance of one in 100 million


@dataclass(frozen=True, kw_only=True)
class EliteSplit:
    """Elites to train on and elites held out; no elite is in both."""

    train: NDArray[np.int64]
    """Rows of the archive to train on, in the order drawn."""
    test: NDArray[np.int64]
    """Rows of the archive held out, in the order drawn: the first n are a random choice of n of them."""


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

    def __len__(self) -> int:
        """Number of terrains."""
        return len(self.seeds)


def paper_terrains(robot: str) -> int:
    """Terrains a set of the published tables of a robot; 300 of one that the paper does not have."""
    return PAPER_TERRAINS.get(robot, _OTHER_TERRAINS)


def split_elites(
    archive: Archive, robot: str, seed: int = 0, *, spec: str | None = None, run: Path | None = None
) -> EliteSplit:
    """Draw at random which elites are trained on and which are held out.

    The paper's numbers where the archive has so many: 750 to train on, 300 (ANYmal) or 180 (Cassie) held out; else
    80 % and 20 %. The draw depends on the elites' genes and the seed alone, not on their order in the file: evaluating
    an archive again, which reorders it, moves no elite from one part to the other.

    Args:
        archive: The elites.
        robot: Name of the robot that is trained and evaluated.
        seed: Of the draw, from 0 on; training and evaluation must name the same one.
        spec: What the command line calls the robot, for errors; ``robot`` if left out.
        run: Where the archive lies, for errors.

    Raises:
        ValueError: If the archive is of another robot, or has fewer than 5 elites.
    """
    if archive.robot != robot:
        raise ValueError(
            f"the archive must be of robot '{robot}', got one of '{archive.robot}': its terrains were found to break "
            f"another body; give an archive of '{robot}', which `{command_line('archive', robot=spec or robot)}` makes"
        )
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
    by_genes = np.lexsort(archive.genes.T[::-1])
    rng = np.random.default_rng([_SPLIT_KEY, seed, int(elites_sha256(archive)[:16], 16)])
    drawn = by_genes[rng.permutation(len(archive))]
    return EliteSplit(train=drawn[num_test : num_test + num_train], test=drawn[:num_test])


def elites_sha256(archive: Archive) -> str:
    """Hash of an archive's genes, whatever their order."""
    genes = archive.genes[np.lexsort(archive.genes.T[::-1])]
    return hashlib.sha256(np.ascontiguousarray(genes).tobytes()).hexdigest()


def set_rng(name: str, seed: int) -> np.random.Generator:
    """Random numbers of a test set, shared with no other use of ``seed`` in the project."""
    return np.random.default_rng([_TEST_KEY, _NUMBERS[name], seed])


def plain_set(name: str, count: int, seed: int, space: TerrainSpace = SUPER_GAUSSIAN) -> TerrainSet:
    """``count`` terrains of a set that needs no archive: ``hand_crafted``, ``hard_random`` of a space, or ``flat``."""
    rng = set_rng(name, seed)
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


def generated_set(archive: Archive, split: EliteSplit, count: int, seed: int) -> TerrainSet:
    """Held-out elites: the first ``count`` drawn, or all of them; ``seed`` is that of their episodes."""
    seeds = set_rng("generated", seed).integers(2**32, size=len(split.test), dtype=np.uint32)
    rows, space = split.test[:count], space_of(archive)
    return TerrainSet(
        name="generated", terrains=archive.genes[rows], seeds=seeds[: len(rows)], numbers=rows, space=space.name,
        families=families_of(archive.genes[rows], space),
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
    return replace(
        whole, name=name, terrains=whole.terrains[places], seeds=whole.seeds[places], numbers=whole.numbers[places],
        families=None if whole.families is None else whole.families[places],
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
    """Height maps [m] as rows, as :func:`qd.families.rms_distances` takes them."""
    return heights_of(genes, space).reshape(len(genes), -1).astype(np.float64)


def make_sets(
    names: Sequence[str],
    count: int,
    seed: int,
    *,
    archive: Archive | None = None,
    split: EliteSplit | None = None,
    space: TerrainSpace = SUPER_GAUSSIAN,
) -> dict[str, TerrainSet]:
    """The sets of the tables by name, in the order of :data:`SETS`.

    Args:
        names: Some of :data:`SETS`.
        count: Terrains a set; of generated ones fewer where the archive holds out fewer.
        seed: Draws the test sets.
        archive: Elites for ``generated`` and ``generated_far``.
        split: Which of them are held out.
        space: Of the hard-random ones.

    Raises:
        ValueError: If a name is unknown or given twice, or a set is made of elites and there are none.
    """
    unknown = [name for name in names if name not in SETS]
    if unknown or not names:
        raise ValueError(f"sets must be some of {', '.join(SETS)}, got {', '.join(unknown) or 'none'}")
    if len(set(names)) < len(names):
        raise ValueError(f"each set may be named once, got {', '.join(names)}")
    missing = [name for name in names if name in FROM_ARCHIVE and archive is None]
    if missing:
        raise ValueError(f"set {', '.join(missing)} is made of elites: give the run that found them (--archive RUN)")
    sets = {name: plain_set(name, count, seed, space) for name in names if name not in FROM_ARCHIVE}
    if archive is not None and split is not None:
        sets["generated"] = whole = generated_set(archive, split, count, seed)
        if "generated_far" in names:
            far = far_part(nearest_distance(whole.terrains, archive.genes[split.train], space_of(archive)))
            sets["generated_far"] = part_of(whole, far, "generated_far")
    return {name: sets[name] for name in SETS if name in names}


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


def check_held_out(controllers: Mapping[str, str], genes: NDArray[np.float32], split_seed: int) -> None:
    """Refuse to call terrains held out that a controller was trained on.

    Args:
        controllers: Policy of each controller by its name.
        genes: Elites that are to be crossed, shape (T, num_genes), held out by the split of ``split_seed``.
        split_seed: For the message.

    Raises:
        ValueError: If one of the controllers was trained on some of them, as far as its record says; naming it.
    """
    marks = marks_of(genes)
    for name, policy in controllers.items():
        trained_on = recorded_marks(policy)
        if count := sum(mark in trained_on for mark in marks):
            raise ValueError(
                f"{name} was trained on {count} of the {len(marks)} elites that split seed {split_seed} holds out of "
                "this archive: give the archive as it was then and the split seed of its training"
            )
