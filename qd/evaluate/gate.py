"""A gate for continuous integration and training: does a controller pass a gate.toml, by sequential tests in rounds?"""

import hashlib
import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from qd.evaluate.evaluate import crossings_folder
from qd.evaluate.level import MIN_GOAL_RATE, measure_level_ground
from qd.evaluate.pack import PACK_FILE, Entry, count_trained, find_pack, pack_set, read_pack
from qd.evaluate.sequential import PairedTest, RateTest, rate_interval
from qd.evaluate.sets import plain_set
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from sim.controllers.spec import controller_identity, crosser_name
from sim.files.atomic import prepare_output, read_json, write_atomically
from sim.files.command import publish, say
from sim.files.settings import NonNegativeInt, from_builtins, read_toml
from sim.files.templates import open_templates
from sim.rates import MAX_INVALID_SHARE
from sim.robots.find import resolve_robot
from sim.robots.robot import RobotCfg
from sim.terrains.bank import make_heights
from sim.terrains.maps.terrain_files import ExportedTerrain, encode_terrain
from sim.terrains.spaces.registry import load_space, space_at
from sim.terrains.terrains import Terrains

Small = Annotated[float, Meta(ge=1e-3, lt=0.5)]
Limit = Annotated[float, Meta(gt=0, lt=1)]
Name = Annotated[str, Meta(max_length=80, pattern=r"^[^\x00-\x1f|<>&`]*$")]
Count = Annotated[int, Meta(ge=1, le=100_000)]
_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_SETS = ("hand_crafted", "hard_random")
_SEED_KEY = 20261130  # with seed, check and round, the entropy of a round's episodes, and of nothing else
_SAVED = 3  # terrains of a check
_AT_ONCE = 2_000  # episodes between two looks on a GPU, which many robots keep busy; on the CPU it is a round


@dataclass(frozen=True, kw_only=True)
class CheckCfg:
    """One table ``[[check]]`` of a gate.toml: terrains, and what is asked of controllers on them."""

    name: Name = ""  # of the check in reports; that of its pack or set if left out
    pack: Name = ""  # a pack: its folder beside the gate.toml, or a published one: anymal, cassie or anymal@1
    set: str = ""  # or terrains that are drawn: hand_crafted or hard_random
    space: str | None = None  # space of hard_random, with ground and conditions: super_gaussian+noise+push
    terrains: Count = 100  # how many: the first of a pack
    limit: Limit | None = None  # mean goal rate that is asked for; none if the check is of old against new alone
    margin: Small = 0.05  # limit - margin fails, limit + margin passes, but for the error; new may be less worse
    rounds: Count = 40  # episodes of a terrain at most

    @property
    def title(self) -> str:
        """Its name."""
        return self.name or self.pack or self.set


@dataclass(frozen=True, kw_only=True)
class GateCfg:
    """A gate.toml."""

    check: tuple[CheckCfg, ...]
    error: Small = 0.05  # chance of a wrong pass, and of a wrong fail, of each test that is clear
    seed: NonNegativeInt = 0  # draws terrains of sets, and all episodes


def read_gate(file: Path) -> GateCfg:
    """Settings of a gate.toml."""
    cfg = from_builtins(GateCfg, read_toml(file), str(file))
    if not cfg.check:
        raise ValueError(f"{file} must have a table [[check]] or more, got none")
    names = [check.title for check in cfg.check]
    for number, check in enumerate(cfg.check, 1):
        where = f"{file}, check {number}"
        if bool(check.pack) == bool(check.set) or (check.set and check.set not in _SETS):
            got = f"pack '{check.pack}' and set '{check.set}'"
            raise ValueError(f"{where} must have either a pack or a set of {', '.join(_SETS)}, got {got}")
        if check.space is not None and check.set != "hard_random":
            got = check.pack or check.set
            raise ValueError(f"{where}: a space is of the set hard_random, got one with {got}: leave it out")
        low, high = (0.5, 0.5) if check.limit is None else (check.limit - check.margin, check.limit + check.margin)
        if low < 1e-6 or high > 1.0 - 1e-6:
            rule = "limit - margin and limit + margin must lie between 0 and 1"
            raise ValueError(f"{where}: {rule}, got {check.limit:g} and {check.margin:g}: take a smaller margin")
        if names.count(check.title) > 1:
            raise ValueError(f"{where}: names must differ, got {check.title} twice: give each a name")
    return cfg


class CheckTerrains(NamedTuple):
    """Terrains of a check."""

    terrains: Terrains
    sha256: str
    known: list[Entry]  # what a pack says of them; nothing of others
    pack: str | None  # the pack by its name and version


def check_terrains(check: CheckCfg, seed: int, robot: RobotCfg, folder: Path) -> CheckTerrains:
    """Draws or reads the terrains of a check; ``folder`` is where paths of packs begin."""
    if not check.pack:
        space = space_at(load_space(check.space), None, robot)
        terrains = plain_set(check.set, check.terrains, seed, space).terrains
        digest = hashlib.sha256(np.ascontiguousarray(terrains.values).tobytes()).hexdigest()
        return CheckTerrains(terrains, digest, [], None)
    pack = read_pack(find_pack(str(folder / check.pack) if (folder / check.pack).is_dir() else check.pack))
    resolve_robot(pack.content, robot, pack.folder / PACK_FILE, kind="pack")
    terrains = pack_set(pack.heights, check.terrains, seed).terrains
    name = f"{pack.name}, version {pack.content['version']}"
    return CheckTerrains(terrains, pack.content["terrains_sha256"], pack.terrains[: len(terrains)], name)


def run_check(
    check: CheckCfg, drawn: CheckTerrains, number: int, cfg: GateCfg,
    policies: Mapping[str, str], crosser: Crosser,
) -> dict[str, Any]:  # fmt: skip
    """Crosses rounds until each test is clear: verdicts, counts of valid episodes, and terrains that ``new`` fails."""
    began = time.perf_counter()
    terrains, known = drawn.terrains, drawn.known
    count, name = len(terrains), check.title
    goals = {by: np.zeros((2, count), np.int64) for by in policies}  # reached, and valid episodes
    tests: dict[str, RateTest | PairedTest] = {}
    if check.limit is not None:
        tests["rate"] = RateTest(check.limit, check.margin, cfg.error)
    if "old" in policies:
        tests["paired"] = PairedTest(check.margin, cfg.error)
    each = max(1, _AT_ONCE // count) if crosser.compute.on_gpu else 1
    done, clear = 0, dict[str, int]()
    while done < check.rounds and len(clear) < len(tests):
        some = range(done, min(done + each, check.rounds))
        draws = [np.random.SeedSequence([_SEED_KEY, cfg.seed], spawn_key=(number, k)) for k in some]
        lot = Terrains.join([replace(terrains, seeds=draw.generate_state(count)) for draw in draws])
        reached, valid = dict[str, NDArray[np.bool_]](), dict[str, NDArray[np.bool_]]()
        for by, policy in policies.items():
            label = f"{name}, {by}, round {done + 1} of at most {check.rounds}"
            result = crosser.cross(policy, lot, replicas=1, label=label, room=each * count, invalid_ok=True)
            valid[by] = ~result.invalid.reshape(len(some), count)
            reached[by] = result.reached_goal.reshape(len(some), count) & valid[by]
            goals[by] += [reached[by].sum(axis=0), valid[by].sum(axis=0)]
        done = some.stop
        hits: dict[str, tuple[NDArray[np.bool_], ...]] = {"rate": (reached["new"], valid["new"])}
        if "old" in policies:
            both = valid["old"] & valid["new"]
            hits["paired"] = (reached["old"] & ~reached["new"] & both, reached["new"] & ~reached["old"] & both, both)
        for kind, test in tests.items():
            if kind not in clear:
                test.add(*(int(hit.sum()) for hit in hits[kind]))
                clear |= {kind: done} if test.passes is not None else {}
    episodes = done * count
    for by, (_, counted) in goals.items():
        if (invalid := episodes - int(counted.sum())) > MAX_INVALID_SHARE * episodes:
            rule = f"{name}: at most {MAX_INVALID_SHARE:.0%} of the episodes of {by} may be invalid"
            got = f"{invalid} of {episodes}: `faultline check` says what is wrong with the robot"
            raise ValueError(f"{rule}, got {got}")
    verdicts = {kind: (test.passes, "clear") if kind in clear else test.decide() for kind, test in tests.items()}
    reached_goal, counted = goals["new"]
    causes = np.array([str(entry["cause"] or "unclear") for entry in known])
    return {
        "name": name,
        "settings": asdict(check),
        "terrains": count,
        "terrains_sha256": drawn.sha256,
        "pack": drawn.pack,
        "trained_on": count_trained(known, policies["new"]),
        "passes": all(passes for passes, _ in verdicts.values()),
        "tests": {
            kind: {"passes": passes, "stopped": how, "rounds": clear.get(kind, done)}
            | {key: value for key, value in vars(tests[kind]).items() if not key.startswith("_")}
            for kind, (passes, how) in verdicts.items()
        },
        "rounds": done,
        "episodes": episodes,
        "invalid_episodes": episodes - int(counted.sum()),
        "invalid_terrains": int((counted < (1.0 - MAX_INVALID_SHARE) * done).sum()),
        "goal_rate": {by: float(table[0].sum() / table[1].sum()) for by, table in goals.items()},
        "goal_interval": rate_interval(int(reached_goal.sum()), int(counted.sum())),
        "by_cause": {  # on which the pack's searched controller fails
            cause: float(reached_goal[rows].sum() / counted[rows].sum())
            for cause in np.unique(causes).tolist()
            if counted[rows := causes == cause].any()
        },
        "failing": [
            {"terrain": k, "goals": int(reached_goal[k]), "episodes": int(counted[k])}
            | {key: known[k][key] for key in ("elite", "kind", "cause") if known}
            | ({"old_goals": int(goals["old"][0, k])} if "old" in goals else {})
            for k in np.flatnonzero(reached_goal < FAILING_GOAL_RATE * counted).tolist()
        ],
        "wall_s": time.perf_counter() - began,
    }


def run_gate(
    file: Path, cfg: GateCfg, drawn: Sequence[CheckTerrains], robot: RobotCfg, policies: Mapping[str, str],
    compute: Compute,
) -> dict[str, Any]:  # fmt: skip
    """Runs the checks of a gate.toml on ``new`` of the policies; one that does not cross level ground fails at once."""
    if lone := [check.title for check in cfg.check if check.limit is None and "old" not in policies]:
        rule = "a check without a limit is of old against new"
        raise ValueError(f"{rule}, got {lone[0]} and no old controller: give one")
    for policy in policies.values():
        check_policy(policy, robot, compute.device)
    origin = {
        **compute.origin(cfg.seed),
        **controller_identity(robot, policies["new"]),
        "old": controller_identity(robot, policies["old"]) if "old" in policies else None,
        "gate_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
    }
    with Crosser(robot, compute, cache=crossings_folder(robot)) as crosser:
        level = measure_level_ground(crosser, policies["new"])["searched"]
        walks = level["goal"] >= MIN_GOAL_RATE
        each = enumerate(zip(cfg.check, drawn, strict=True) if walks else ())
        checks = [run_check(check, of_check, k, cfg, policies, crosser) for k, (check, of_check) in each]
    return {
        **origin,
        "error": cfg.error,
        "passes": walks and all(check["passes"] for check in checks),
        "level_ground": level | {"passes": walks, "limit": MIN_GOAL_RATE},
        "checks": checks,
        "skipped": [] if walks else [check.title for check in cfg.check],
    }


def reason(check: Mapping[str, Any]) -> str:
    """Why a check passes or fails, in a line."""
    return _TEMPLATES.get_template("reason.txt").render(check)


def to_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str, float]]:
    """Name, verdict (pass, fail or skipped), reason and seconds of every check, level ground first."""
    level = report["level_ground"]
    walked = f"{level['goal']:.0%} of robots cross level ground, asked for {level['limit']:.0%}"
    rows = [("level ground", "pass" if level["passes"] else "fail", walked, 0.0)]
    rows += [(c["name"], "pass" if c["passes"] else "fail", reason(c), c["wall_s"]) for c in report["checks"]]
    return rows + [(name, "skipped", "the controller does not walk", 0.0) for name in report["skipped"]]


def to_junit(report: Mapping[str, Any]) -> bytes:
    """The report as JUnit XML: a test case a check."""
    rows = to_rows(report)
    verdicts = [verdict for _, verdict, _, _ in rows]
    counts = {"tests": len(rows), "errors": 0, "failures": verdicts.count("fail"), "skipped": verdicts.count("skipped")}
    about = {"name": "faultline", **{name: str(count) for name, count in counts.items()}, "timestamp": report["date"]}
    about["time"] = f"{sum(row[-1] for row in rows):.3f}"
    suites = ElementTree.Element("testsuites")
    suite = ElementTree.SubElement(suites, "testsuite", about)
    properties = ElementTree.SubElement(suite, "properties")
    for name in ("robot", "policy", "policy_sha256", "gate_sha256", "commit", "device", "seed"):
        ElementTree.SubElement(properties, "property", name=name, value=str(report[name]))
    for name, verdict, why, seconds in rows:
        about = {"classname": f"faultline.{report['robot']}", "name": name, "time": f"{seconds:.3f}"}
        case = ElementTree.SubElement(suite, "testcase", about)
        if verdict == "pass":
            ElementTree.SubElement(case, "system-out").text = why
        else:
            ElementTree.SubElement(case, "failure" if verdict == "fail" else "skipped", message=why)
    return ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True)


def to_markdown(report: Mapping[str, Any]) -> str:
    """The report as a summary in Markdown, as a step of GitHub's shows it."""
    tests = sum(len(check["tests"]) for check in report["checks"])
    return _TEMPLATES.get_template("gate.md").render(report, rows=to_rows(report), tests=tests) + "\n"


def save_failing(report: Mapping[str, Any], drawn: Sequence[CheckTerrains], folder: Path) -> None:
    """Writes height maps of failed checks for `faultline film --terrain`, none with ground or conditions."""
    for old in folder.glob("*.npz"):
        old.unlink()
    for number, (found, of_check) in enumerate(zip(report["checks"], drawn, strict=False), 1):
        terrains = of_check.terrains
        if found["passes"] or terrains.space.has_conditions or terrains.space.ground:
            continue
        failing = sorted(found["failing"], key=lambda row: (-row.get("old_goals", 0), row["goals"] / row["episodes"]))
        heights = terrains.heights if terrains.heights is not None else make_heights(terrains.values, terrains.space)
        for row in (row["terrain"] for row in failing[:_SAVED]):
            file = folder / f"check-{number}-terrain-{row}.npz"
            prepare_output(file)
            write_atomically(file, encode_terrain(ExportedTerrain(heights=heights[row]), "npz"))


def publish_gate(
    file: Path, robot: RobotCfg, policies: Mapping[str, str], compute: Compute, out: Path | None, junit: Path | None
) -> dict[str, Any]:
    """Runs a gate, prints its summary and writes it: as JSON, beside it as .md, and as JUnit XML.

    GITHUB_STEP_SUMMARY may name a file to which the summary is added. A folder named as the JSON has failed terrains.
    """
    out = out or RUNS / f"{crosser_name(robot, policies['new'])}-gate.json"
    if out.suffix != ".json" or (junit is not None and junit.resolve() in (out.resolve(), out.with_suffix(".md"))):
        raise ValueError(f"out must be a file named *.json, and junit another one, got {out} and {junit}")
    writers = {out.with_suffix(".md"): lambda report: to_markdown(report).encode()}
    writers |= {} if junit is None else {junit: to_junit}
    for path in writers:
        prepare_output(path)
    cfg = read_gate(file)
    drawn = [check_terrains(check, cfg.seed, robot, file.resolve().parent) for check in cfg.check]
    asked = (file, cfg, drawn, robot, policies, compute)
    report = publish(out, lambda: run_gate(*asked), lambda found: print(to_markdown(found)))
    for path, write in writers.items():
        write_atomically(path, write(report))
    save_failing(report, drawn, out.with_suffix(""))
    if summary := os.environ.get("GITHUB_STEP_SUMMARY"):
        try:
            with open(summary, "a", encoding="utf-8") as step:
                step.write(to_markdown(report))
        except OSError as error:
            say(f"GITHUB_STEP_SUMMARY, {summary}, could not be written to: {error.strerror}", error=True)
    return report


class GateProcess:
    """A gate in a process of its own, beside a training, whose GPU memory it does not hold; ``out`` gets its report."""

    def __init__(self, command: Sequence[str], out: Path) -> None:
        prepare_output(out)
        out.unlink(missing_ok=True)  # of another gate
        self.out, self._log = out, out.with_suffix(".log")
        with self._log.open("wb") as log:
            pipes: Any = {"stdout": log, "stderr": subprocess.STDOUT}
            self._process = subprocess.Popen(command, **pipes, start_new_session=True)  # Ctrl-C does not reach it

    @property
    def ended(self) -> bool:
        """Whether there is a report, or an error."""
        return self._process.poll() is not None

    def result(self, timeout_s: float | None = None) -> dict[str, Any]:
        """Waits for the report; a RuntimeError if the gate ended with an error, TimeoutError if it goes on."""
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"the gate goes on after {timeout_s:g} s: {self._log} has its output") from None
        if status not in (0, 1) or not self.out.exists():
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise RuntimeError(f"the gate ended with an error: {lines[-1] if lines else f'status {status}'}")
        return read_json(self.out)

    def stop(self) -> None:
        """Ends the process, whatever it does."""
        self._process.terminate()
        self._process.wait()

    def scalars(self) -> dict[str, float]:
        """Goal rates of the report by check, on a pack also by cause, as names and values for TensorBoard."""
        values = dict[str, float]()
        for check in self.result()["checks"]:
            values[f"gate/{check['name']}/goal_rate"] = check["goal_rate"]["new"]
            values |= {f"gate/{check['name']}/{cause}": rate for cause, rate in check["by_cause"].items()}
        return values


def gate(
    policy: str | Path, robot: str, gate: str | Path, *, out: Path, old: str | Path | None = None,
    device: str | None = None,
) -> GateProcess:  # fmt: skip
    """Starts a gate of a controller's file in a process of its own, and returns at once.

    ``policy`` and ``old``, with which it is compared, are files that must stay until the gate has ended; ``robot`` is a
    shipped one or a settings file, ``gate`` a gate.toml. The report goes to ``out``. Without ``device`` it takes CUDA
    if there is one.
    """
    command = [sys.executable, "-m", "faultline", "evaluate", "--gate", str(gate), "--robot", robot, "--out", str(out)]
    command += ["--policy", str(policy)] if old is None else ["--policies", f"old={old}", f"new={policy}"]
    return GateProcess(command + ([] if device is None else ["--device", device]), Path(out))
