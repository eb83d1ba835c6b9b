"""Packs: terrains on which any controller can be tested, as two files of a folder; how they are made, read and tested.

``pack.npz`` has the terrains, ``pack.json`` what is known of each, and rates of controllers. A pack is made of judged
searches of one controller and does not change: one that is made in its place has the next ``version``. Every terrain is
a fault or a *near-fault*: under :data:`NEAR_GOAL_RATE` of the robots reach the goal in 40 fresh episodes, and another
controller or a witness is certified on it, or the searched one crosses it in at least half of its episodes.
"""

import hashlib
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import cross_sets, crossings_folder, fill_sizes
from qd.evaluate.labels import MEASURES, RATES, SetsCfg
from qd.evaluate.sets import TerrainSet, draw_seeds, elites_sha256, hash_elites, read_trained_on, set_rng
from qd.evaluate.tables import measure_bounds, rate_cells, show_table, terrain_rates, valid_interval, valid_mean
from qd.faults.families import VERDICTS, find_families, find_verdicts, kin_distances, rank
from qd.faults.numbers import EPISODES, SPECIALIST, fresh_counts, judgement, rate_numbers, read_minimal
from qd.faults.searches import Search, find_certifiers
from qd.search.archive import Archive
from qd.search.directory import RUNS, SUMMARY_FILE
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from sim.controllers.spec import controller_identity, crosser_name, describe_controllers, is_same_controller
from sim.files.atomic import prepare_output, read_json, write_atomically
from sim.files.command import publish, say
from sim.files.intervals import wilson_interval
from sim.files.npz import npz_bytes, read_arrays
from sim.rates import counted_episodes
from sim.robots.robot import ROBOTS, RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.bank import make_heights
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import Terrains

PACK_FILE = "pack.json"
TERRAINS_FILE = "pack.npz"
HEIGHT_UNIT_M = 1e-3  # heights of a pack are whole numbers of it, in its file and where they are crossed [m]
NEAR_GOAL_RATE = 0.75  # goal rate of the searched controller from which on a terrain is no near-fault
_MAX_BYTES = 1e9  # of an array that is read
_COUNTED = {"failing": "terrains", "failing_families": "families"}  # parts of a pack and the whole
_SPREAD_OVER = ("family", "cause", "kind")
# What a pack keeps of where each of its runs was made.
_OF_RUN = ("command", "commit", "sources_sha256", "device", "versions", "date", "episodes")
_KEYS = ("robot", "robot_sha256", "penalty_definition", "terrains", "rates", "terrains_sha256", "seed", "episodes")

Entry = dict[str, Any]  # what a pack says of one terrain, as JSON values; rates by controller


@dataclass(frozen=True, kw_only=True)
class Pack:
    """A pack of N terrains."""

    folder: Path
    heights: NDArray[np.float32]  # [m], shape (N, NUM_ROWS, NUM_COLS)
    genes: NDArray[np.float32]  # shape (N, num_genes)
    content: dict[str, Any]  # of pack.json

    @property
    def name(self) -> str:
        """What a published one is asked for by, ``anymal@1``, or its folder."""
        robot, folder = self.content["robot"], self.folder
        return f"{robot}@" * (robot in ROBOTS and folder.parent == ROBOTS[robot].packs) + folder.name

    @property
    def terrains(self) -> list[Entry]:
        """What the pack says of each terrain."""
        return self.content["terrains"]


def find_pack(name: str) -> Path:
    """The folder of a pack by its path, or a published one: the newest of a shipped robot, or ``anymal@1``."""
    folder, (robot, named, version) = Path(name), name.partition("@")
    packs = ROBOTS[robot].packs if robot in ROBOTS else folder
    versions = sorted(int(pack.parent.name) for pack in packs.glob(f"*/{PACK_FILE}") if pack.parent.name.isdecimal())
    if robot in ROBOTS and versions and not (folder / PACK_FILE).is_file():
        folder = packs / (version if named else str(versions[-1]))
    if not (folder / PACK_FILE).is_file() or (named and not version):
        known = ", ".join(f"{robot}@{number}" for number in versions if robot in ROBOTS) or ", ".join(ROBOTS)
        raise FileNotFoundError(f"no pack {name}: give its folder, or {known}; `faultline export --pack` makes one")
    return folder


def read_pack(folder: Path) -> Pack:
    """Reads a pack; data only, nothing in it can run."""
    file = folder / TERRAINS_FILE
    try:
        content = read_json(folder / PACK_FILE)
        if missing := [name for name in _KEYS if name not in content]:
            raise ValueError(f"{PACK_FILE} lacks {', '.join(missing)}")
        if hashlib.sha256(file.read_bytes()).hexdigest() != content["terrains_sha256"]:
            raise ValueError(f"{TERRAINS_FILE} is not the one that {PACK_FILE} names")
        arrays = read_arrays(file, ("twists", "height_unit_m", "genes"), max_bytes=_MAX_BYTES)
        content = {"version": 1, "licence": None} | content  # which the first packs do not say, nor marks
        for entry, mark in zip(content["terrains"], hash_elites(arrays["genes"]), strict=True):
            entry.setdefault("mark", mark)
        units = np.cumsum(np.cumsum(arrays["twists"], axis=1), axis=2)
        heights = (units * float(arrays["height_unit_m"])).astype(np.float32)
        expected = (len(content["terrains"]), NUM_ROWS, NUM_COLS)
        if heights.shape != expected or not np.isfinite(heights).all() or not len(heights):
            raise ValueError(f"heights must be finite, of shape {expected}, got {heights.shape}")
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"{folder} must be a pack, but is damaged: {error}: put a copy of it back") from None
    return Pack(folder=folder, heights=heights, genes=arrays["genes"], content=content)


def write_terrains(folder: Path, heights: NDArray[np.float32], genes: NDArray[np.float32]) -> str:
    """Writes ``pack.npz`` of rounded heights [m], (N, NUM_ROWS, NUM_COLS), and genes; returns its SHA-256."""
    units = np.rint(heights.astype(np.float64) / HEIGHT_UNIT_M).astype(np.int32)
    # Of smooth ground the rise along x hardly changes along y, so that this packs into a third of the bytes.
    twists = np.diff(np.diff(units, axis=2, prepend=np.int32(0)), axis=1, prepend=np.int32(0))
    arrays = {"twists": twists, "height_unit_m": np.array(HEIGHT_UNIT_M), "genes": genes}
    data = npz_bytes(arrays, compression=zipfile.ZIP_BZIP2)
    write_atomically(folder / TERRAINS_FILE, data)
    return hashlib.sha256(data).hexdigest()


def round_heights(heights: NDArray[np.floating]) -> NDArray[np.float32]:
    """Heights [m] as a pack has them, in whole numbers of :data:`HEIGHT_UNIT_M`."""
    return (np.rint(np.asarray(heights, np.float64) / HEIGHT_UNIT_M) * HEIGHT_UNIT_M).astype(np.float32)


def pack_set(heights: NDArray[np.float32], count: int, seed: int) -> TerrainSet:
    """The first ``count`` terrains of a pack; ``seed`` draws their episodes."""
    seeds = draw_seeds(set_rng("pack", seed), len(heights))[:count]
    return TerrainSet(terrains=Terrains(heights=heights[:count], seeds=seeds), numbers=np.arange(len(seeds)))


def evaluate_pack(
    pack: Pack, robot: RobotCfg, policy: str, cfg: SetsCfg, *, compute: Compute, out: Path | None = None
) -> dict[str, Any]:
    """Tests a controller on the first terrains of a pack: prints and writes its rates beside the pack's controllers."""
    size = len(pack.terrains)
    count, episodes = fill_sizes(compute, cfg.terrains, cfg.episodes, full=(size, EPISODES), small=(min(24, size), 4))
    check_policy(policy, robot, compute.device)
    terrain_set = pack_set(pack.heights, count, cfg.seed)
    entries = pack.terrains[: len(terrain_set)]
    if trained := count_trained(entries, policy):
        say((f"It was trained on {trained} of these {len(entries)} terrains", "bold"), ": its rates say little.")
    controller = crosser_name(robot, policy)

    def make_report() -> dict[str, Any]:
        sets = {"pack": terrain_set}
        results = cross_sets({controller: policy}, sets, robot, compute, episodes, cache=crossings_folder(robot))
        tested = add_rates(entries, {"this": results["pack"][controller]})
        keys = ("robot", "robot_sha256", "terrains_sha256", "episodes", "seed", "searched", "version", "licence")
        return {
            **compute.origin(cfg.seed),
            **controller_identity(robot, policy),
            "episodes": episodes,
            "trained_on": trained,
            "pack": {key: pack.content[key] for key in keys} | {"folder": pack.name, "terrains": size},
            "rates": summarise_rates(tested, "this", cfg.seed),
            "beside": {name: summarise_rates(entries, name, cfg.seed) for name in pack.content["rates"]},
            "by": {group: count_failing(tested, "this", group) for group in ("verdict", "cause", "kind")},
            "terrains": tested,
        }

    return publish(out or RUNS / f"{controller}-pack.json", make_report, show_pack_test)


def count_trained(entries: Sequence[Entry], policy: str) -> int:
    """On how many terrains, or the elites that these are parts of, a controller was trained, as far as it is known."""
    marks = read_trained_on(policy)
    return sum(entry["mark"] in marks for entry in entries)


def passes(report: dict[str, Any], min_goal_rate: float) -> bool:
    """Whether the lower end of the goal rate's interval of :func:`evaluate_pack` is at least so high; prints both."""
    interval = report["rates"]["goal_interval"]
    low = interval[0] if interval else 0.0  # one family says nothing of the spread
    verdict = ("passes", "bold green") if low >= min_goal_rate else ("fails", "bold red")
    say(verdict, f": the goal rate is at least {low:.3f} (95 %), asked for {min_goal_rate:.3f}")
    return low >= min_goal_rate


def add_rates(entries: Sequence[Entry], results: Mapping[str, RolloutResult]) -> list[Entry]:
    """Entries with the ``rates`` of controllers, and the goal rate's interval (Wilson); None on an invalid terrain."""
    crossed: list[dict[str, Any]] = [{} for _ in entries]
    for controller, result in results.items():
        counted = counted_episodes(result.invalid)
        counts = zip((result.reached_goal & counted).sum(axis=1).tolist(), counted.sum(axis=1).tolist(), strict=True)
        rates = terrain_rates(result)
        for k, (goals, valid) in enumerate(counts):
            row = {f"{name}_rate": float(values[k]) if valid else None for name, values in rates.items()}
            crossed[k][controller] = row | {"goal_interval": [*wilson_interval(goals, valid)], "valid_episodes": valid}
    return [entry | {"rates": row} for entry, row in zip(entries, crossed, strict=True)]


def _read_rates(entries: Sequence[Entry], controller: str, name: str) -> NDArray[np.float64]:
    """A controller's rate on each terrain, shape (N,); NaN on an invalid one."""
    return np.array([entry["rates"][controller][f"{name}_rate"] for entry in entries], np.float64)


def summarise_rates(entries: Sequence[Entry], controller: str, seed: int) -> dict[str, Any]:
    """Means of rates with intervals over families, and how many terrains and families fail, as JSON values."""
    families = np.array([entry["family"] for entry in entries], np.int64)
    summary: dict[str, Any] = {}
    for name in RATES:
        values = _read_rates(entries, controller, name)
        summary[f"{name}_rate"] = valid_mean(values)
        summary[f"{name}_interval"] = valid_interval(values, seed, families, measure_bounds(name))
    goal = _read_rates(entries, controller, "goal")
    failing = goal < FAILING_GOAL_RATE
    valid = ~np.isnan(goal)
    return summary | {
        "failing": int(failing.sum()),
        "terrains": int(valid.sum()),
        "failing_families": len(np.unique(families[failing])),
        "families": len(np.unique(families[valid])),
    }


def count_failing(entries: Sequence[Entry], controller: str, group: str) -> dict[str, dict[str, int]]:
    """How many ``terrains`` there are and ``failing``, by verdict, cause or kind, the most frequent value first."""
    values = np.array([str(entry[group] or "unclear") for entry in entries])
    fails = _read_rates(entries, controller, "goal") < FAILING_GOAL_RATE
    by_frequency = sorted(Counter(values.tolist()).items(), key=lambda item: (-item[1], item[0]))
    return {value: {"terrains": count, "failing": int(fails[values == value].sum())} for value, count in by_frequency}


def show_pack_test(report: dict[str, Any]) -> None:
    """Prints how many terrains of a pack a controller fails, beside the pack's controllers."""
    title = f"pack {report['pack']['folder']} of {report['pack']['robot']}"
    show_pack_rates(title, {"this": report["rates"], **report["beside"]})
    for group, counts in report["by"].items():
        rows = [(value, count["failing"], count["terrains"]) for value, count in counts.items()]
        show_table(f"failed, by {group}", ("", "fails", "of"), rows)


def show_pack_rates(title: str, rates: Mapping[str, dict[str, Any]]) -> None:
    """Prints the rates of controllers on a pack."""
    rows = [
        (name, *rate_cells(row), *(f"{row[part]} of {row[whole]}" for part, whole in _COUNTED.items()))
        for name, row in rates.items()
    ]
    show_table(title, ("", *map(MEASURES.__getitem__, RATES), "fails", "families"), rows)


class Candidate(NamedTuple):
    """A terrain that a pack may take."""

    entry: Entry
    genes: NDArray[np.float32]  # shape (num_genes,)
    of: NDArray[np.float32]  # genes of the elite that it is, or a part of


def make_pack(
    searches: Sequence[Search],
    controllers: Mapping[str, str],
    *,
    compute: Compute,
    apart_from: Sequence[Archive] = (),
    size: int = 100,
    episodes: int = EPISODES,
    seed: int = 0,
    licence: str = "",
    version: int | None = None,
    overwrite: bool = False,
    out: Path | None = None,
) -> dict[str, Any]:
    """Chooses terrains of judged searches, lets controllers cross them, and writes the pack; returns its JSON values.

    Without ``controllers`` (policies by name) these are the shipped one and the runs' certifiers; the searched one
    always crosses. There are ``size`` terrains, or as many as there are, none of them kin of an elite of
    ``apart_from``, nor a part of such kin. Without ``version`` it is 1, or the next of one that it may ``overwrite``.
    """
    search, robot = searches[0], searches[0].robot
    out = out or RUNS / f"{robot.name}-pack"
    former = read_json(out / PACK_FILE).get("version", 1) if (out / PACK_FILE).exists() else 0
    if former and not overwrite:
        raise ValueError(f"{out} has a pack, version {former}: give another --out, or --overwrite for the next version")
    archives = _read_judged(searches)
    controllers = {**(controllers or {"base": str(robot.policy_file), **_name_certifiers(searches)})}
    if not any(is_same_controller(search.policy, policy) for policy in controllers.values()):
        controllers = {"searched": search.policy, **controllers}
    for policy in controllers.values():
        check_policy(policy, robot, compute.device)
    candidates, not_passable = find_candidates(searches, archives)
    others = [file for name, file in controllers.items() if not name.startswith(SPECIALIST)]
    trained_on = set[str]().union(*map(read_trained_on, others))
    candidates = [candidate for candidate in candidates if candidate.entry["mark"] not in trained_on]
    apart = drop_kin(candidates, apart_from, search)
    chosen = [apart[index] for index in choose_terrains([candidate.entry for candidate in apart], size)]
    if not chosen:
        rule = "must have faults or near-faults that no controller but a specialist was trained on"
        got = f"none, {len(candidates)} that are kin of --making.apart-from, and {not_passable} that nobody crosses"
        raise ValueError(f"{search.run} {rule}, got {got}")
    print(f"{len(chosen)} of {len(apart)} faults and near-faults; {not_passable} more that nobody crosses.")
    genes = np.array([candidate.genes for candidate in chosen], np.float32)
    heights = round_heights(make_heights(genes, search.space))
    prepare_output(out / TERRAINS_FILE)

    def make_report() -> dict[str, Any]:
        terrains = {"pack": pack_set(heights, len(heights), seed)}
        results = cross_sets(controllers, terrains, robot, compute, episodes, cache=crossings_folder(robot))
        crossed = add_rates([candidate.entry for candidate in chosen], results["pack"])
        described = describe_controllers(controllers, robot).items()
        return {
            **compute.origin(seed),
            **controller_identity(robot, search.policy),
            "version": version or 1 + former,
            "licence": licence or None,
            "space": search.cfg.space,
            "space_sha256": search.cfg.space_sha256,
            "episodes": episodes,
            "searched": next(name for name, policy in controllers.items() if is_same_controller(policy, search.policy)),
            "runs": [
                {"run": one.run.name, "seed": one.cfg.seed, "iterations": archive.iterations}
                | {"elites": len(archive), "elites_sha256": elites_sha256(archive)}
                | {name: value for name, value in read_json(one.run / SUMMARY_FILE).items() if name in _OF_RUN}
                for one, archive in zip(searches, archives, strict=True)
            ],
            "apart_from": [elites_sha256(archive) for archive in apart_from],
            "certifiers": sorted({name for archive in archives for name in archive.certifiers}),
            "candidates": len(apart),
            "not_known_to_be_passable": not_passable,
            "controllers": {
                name: about | {"trained_on": count_trained(crossed, controllers[name])} for name, about in described
            },
            "rates": {name: summarise_rates(crossed, name, seed) for name in controllers},
            "terrains_sha256": write_terrains(out, heights, genes),
            "terrains": crossed,
        }

    def show(report: dict[str, Any]) -> None:
        verdicts = Counter(entry["verdict"] for entry in report["terrains"])
        title = ", ".join(f"{verdict}: {count} terrains" for verdict, count in verdicts.items())
        show_pack_rates(title, report["rates"])

    return publish(out / PACK_FILE, make_report, show)


def _read_judged(searches: Sequence[Search]) -> list[Archive]:
    """The archives of runs that can share a pack, which are of heights alone and judged by all stages that it needs."""
    first, archives = searches[0], list[Archive]()
    if first.space.ground or first.space.has_conditions:
        got = f"terrains of {first.space.name}, which have ground or conditions of their own"
        raise ValueError(f"a pack holds heights alone, got {got}")
    for number, search in enumerate(searches):
        if search.run.resolve() in {one.run.resolve() for one in searches[:number]}:
            raise ValueError(f"runs of one pack must be different ones, got {search.run} twice: leave it out")
        spaces = [(one.cfg.space, one.cfg.space_sha256, one.robot) for one in (first, search)]
        if spaces[0] != spaces[1] or not is_same_controller(search.policy, first.policy):
            rule = f"runs of one pack must search one controller of one robot in one space, as {first.run} does"
            raise ValueError(f"{rule}, got {search.run} with {search.policy} in {search.cfg.space}: leave it out")
        archive = search.read_archive()
        crossed = archive.resolved_outcomes.any(axis=1)
        if archive.witnesses is None:  # else ways were sought
            crossed &= archive.certifier_outcomes.any(axis=(1, 2))
        if archive.fresh is None or (archive.failing & ~crossed).any():
            rule = "must have its failing elites crossed with contact resolved and by other controllers, or steered"
            got = f"{(archive.failing & crossed).sum()} of {archive.failing.sum()}"
            remedy = "run `faultline judge` on it first, with --certifiers or the stage steered"
            raise ValueError(f"{search.run} {rule}, got {got}: {remedy}")
        archives.append(archive)
    return archives


def _name_certifiers(searches: Sequence[Search]) -> dict[str, str]:
    """Certifiers of all runs by name, with the run's number behind the name of another controller."""
    named = dict[str, str]()
    for number, search in enumerate(searches):
        for name, file in find_certifiers(search).items():
            is_other = name in named and not is_same_controller(named[name], file)
            named[f"{name}-run-{number}" if is_other else name] = file
    return named


def drop_kin(candidates: Sequence[Candidate], apart_from: Sequence[Archive], search: Search) -> list[Candidate]:
    """Candidates that are no kin of an elite of some archives, nor parts of such kin."""
    for archive in apart_from:
        if (archive.space, archive.space_sha256) != (search.cfg.space, search.cfg.space_sha256):
            rule = f"archives to be apart from must be of the space {search.cfg.space}"
            raise ValueError(f"{rule}, got {archive.space}: leave it out")
    if not candidates or not apart_from:
        return [*candidates]
    own = np.array([genes for candidate in candidates for genes in (candidate.genes, candidate.of)], np.float32)
    others = np.concatenate([archive.genes for archive in apart_from])
    distances = kin_distances(np.concatenate([own, others]), search.space)[: len(own), len(own) :]
    is_kin = (distances < 1.0).any(axis=1).reshape(-1, 2).any(axis=1)
    print(f"{is_kin.sum()} of {len(candidates)} are kin of what controllers trained on.")
    return [candidates[row] for row in np.flatnonzero(~is_kin).tolist()]


def find_candidates(searches: Sequence[Search], archives: Sequence[Archive]) -> tuple[list[Candidate], int]:
    """The faults and near-faults of runs, which count once in families over all runs; how many more nobody crosses.

    They are elites as they are, and minimal terrains that lack some of their parts.
    """
    near: list[NDArray[np.int64]] = []
    for archive in archives:
        assert archive.fresh is not None
        near.append(np.flatnonzero(archive.fresh.valid & (archive.fresh.goal_rate < NEAR_GOAL_RATE)))
    of_all = np.concatenate([archive.genes[rows] for archive, rows in zip(archives, near, strict=True)])
    by_run = np.split(find_families(of_all, searches[0].space), np.cumsum([len(rows) for rows in near])[:-1])
    candidates, not_passable = dict[tuple[str, str], Candidate](), 0
    for run, (search, archive, rows, own) in enumerate(zip(searches, archives, near, by_run, strict=True)):
        of_run = {"run": run} if len(searches) > 1 else {}
        found = _candidates_of(search, archive, dict(zip(rows.tolist(), own.tolist(), strict=True)), of_run)
        not_passable += found.count(None)
        for candidate in filter(None, found):
            candidates.setdefault((candidate.entry["mark"], candidate.entry["kind"]), candidate)
    return [*candidates.values()], not_passable


def _candidates_of(
    search: Search, archive: Archive, families: Mapping[int, int], of_run: Mapping[str, int]
) -> list[Candidate | None]:
    """Those of one run, None where nobody crosses; ``families`` are by elite, and entries have ``of_run``, too."""
    assert archive.fresh is not None
    minima, rate, witnesses = read_minimal(search.run, archive), archive.fresh.goal_rate, archive.witnesses
    causes = rank(archive, search.space, minima, half_width=search.robot.half_width).causes if families else ()
    marks, verdicts = hash_elites(archive.genes), find_verdicts(archive)
    prefix = "".join(f"run-{number}-" for number in of_run.values())

    def describe(number: int, parts: list[int] | None, verdict: str, numbers: Mapping[str, Any]) -> Entry:
        entry = {
            "name": f"{prefix}elite-{number}{'' if parts is None else '-minimal'}",
            "kind": "elite" if parts is None else "minimal",
            "elite": number,
            "mark": marks[number],
            "cell": int(archive.cell[number]),
            "iteration": int(archive.iteration[number]),
            "parts": parts,
            "verdict": "fault" if verdict == "fault" else "near-fault",
            "cause": causes[number] or None,
            "family": families[number],
        }
        return {**entry, **of_run, **numbers}

    candidates: list[Candidate | None] = []
    for number in families:
        candidate = None
        if archive.certified[number] or rate[number] >= FAILING_GOAL_RATE:
            numbers = {"searched": rate_numbers(fresh_counts(archive, number)), **judgement(archive, number)}
            if witnesses is not None and witnesses.on_line[number]:
                goals, episodes = witnesses.counts[number, :, 1][:, [0, 3]].T.tolist()  # by physics, steered
                witness = {"controller": str(witnesses.walker[number]), "limit_m": witnesses.limit_m}
                numbers["witness"] = witness | {"goals": goals, "episodes": episodes}
            entry = describe(number, None, VERDICTS[verdicts[number]], numbers)
            candidate = Candidate(entry, archive.genes[number], archive.genes[number])
        candidates.append(candidate)
    for minimal in minima.numbers["elites"] if minima else ():
        number, candidate = minimal["elite"], None
        if not archive.failing[number] or len(minimal["bumps"]) == minimal["of"]:
            continue  # with all its parts it is the elite itself
        if minima and minimal["certificates"]:
            numbers = {"searched": {key: minimal[key] for key in ("goal_rate", "goal_interval", "valid_episodes")}}
            numbers |= {key: minimal[key] for key in ("resolved", "certificates")}
            entry = describe(number, minimal["bumps"], minimal["verdict"], numbers)
            candidate = Candidate(entry, minima.genes[number], archive.genes[number])
        candidates.append(candidate)
    return candidates


def choose_terrains(entries: Sequence[Entry], size: int) -> list[int]:
    """Indices of some candidates, so that each beginning of the list is spread as well as can be.

    Faults come first, then the families, causes and kinds that were chosen least often, then the lowest goal rates.
    """
    left = list(range(len(entries)))
    chosen: list[int] = []
    counts = Counter[Any]()

    def priority(index: int) -> tuple[Any, ...]:
        entry = entries[index]
        alike = (counts[name, entry[name]] for name in _SPREAD_OVER)
        return entry["verdict"] != "fault", *alike, entry["searched"]["goal_rate"], entry["elite"], entry["kind"]

    while left and len(chosen) < size:
        best = min(left, key=priority)
        left.remove(best)
        chosen.append(best)
        counts.update((name, entries[best][name]) for name in _SPREAD_OVER)
    return chosen
