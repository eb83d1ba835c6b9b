"""A gate for continuous integration and training: does a controller pass what a gate.toml asks of it?

Episodes are crossed in rounds, one of every terrain, and a sequential test stops as soon as it is clear. Both tests
hold whatever the terrains' own rates are, and however often one looks:

- *Rate*: Wald's (1945) sequential probability ratio test of a mean goal rate ``limit - margin`` against ``limit +
  margin``. The likelihood ratio of a round is at most 1 in expectation where the mean rate of its terrains is the one
  in the denominator, since a geometric mean is at most an arithmetic one; Ville's inequality bounds both errors.
- *Old against new*: pairs of equal terrain, seed and replica differ by d = -1, 0 or 1. Wealth that bets a share x on d,
  times 1 + x d, grows with a chance of at most ``error`` beyond 1 / error where the mean of d is not positive (Waudby-
  Smith and Ramdas 2024); bets are means over :data:`BETS`. At the end of all rounds McNemar's exact test decides.
"""

import hashlib
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.special import betaln
from scipy.stats import binomtest

from qd.evaluate.evaluate import crossings_folder
from qd.evaluate.level import MIN_GOAL_RATE, measure_level_ground
from qd.evaluate.pack import PACK_FILE, Entry, find_pack, pack_set, read_pack
from qd.evaluate.sets import plain_set
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from sim.controllers.spec import controller_identity, crosser_name
from sim.files.atomic import prepare_output, read_json, write_atomically
from sim.files.command import publish
from sim.files.npz import npz_bytes
from sim.files.settings import PositiveInt, from_builtins, read_toml
from sim.rates import MAX_INVALID_SHARE
from sim.robots.find import resolve_robot
from sim.robots.robot import RobotCfg
from sim.terrains.bank import make_heights
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.registry import load_space
from sim.terrains.terrains import Terrains

Error = Annotated[float, Meta(gt=0, lt=0.5)]
Margin = Annotated[float, Meta(gt=0, lt=0.5)]
Limit = Annotated[float, Meta(gt=0, lt=1)]
BETS = np.linspace(0.02, 0.98, 49)
"""Shares of the wealth."""
_SETS = ("hand_crafted", "hard_random")
_SEED_KEY = 20261130  # with seed, check and round, the entropy of a round's episodes, and of nothing else
_SIZE_M = SPACING * np.array([NUM_COLS - 1, NUM_ROWS - 1])
_SAVED = 3  # terrains of a check
_AT_ONCE = 2_000  # episodes between two looks on a GPU, which many robots keep busy; on the CPU it is a round


@dataclass(frozen=True, kw_only=True)
class CheckCfg:
    """One table ``[[check]]`` of a gate.toml: terrains, and what is asked of controllers on them."""

    name: str = ""
    """Of the check in reports; that of its pack or set if left out."""
    pack: str = ""
    """A pack: its folder beside the gate.toml, or the published anymal or cassie."""
    set: str = ""
    """Or terrains that are drawn: hand_crafted or hard_random."""
    space: str | None = None
    """Space of a set, with ground and conditions, as `archive` has it: super_gaussian+noise+push."""
    terrains: PositiveInt = 100
    """How many: the first of a pack."""
    limit: Limit | None = None
    """Mean goal rate that is asked for; none if the check is of old against new alone."""
    margin: Margin = 0.05
    """A rate of limit - margin fails and one of limit + margin passes, but for the error. New may be worse than old by
    less than this."""
    rounds: PositiveInt = 40
    """Episodes of a terrain at most."""


@dataclass(frozen=True, kw_only=True)
class GateCfg:
    """A gate.toml."""

    check: tuple[CheckCfg, ...]
    error: Error = 0.05
    """Chance of a wrong pass, and of a wrong fail, of each check."""
    seed: int = 0
    """Draws terrains of sets, and all episodes."""


def read_gate(file: Path) -> GateCfg:
    """Settings of a gate.toml."""
    cfg = from_builtins(GateCfg, read_toml(file), str(file))
    if not cfg.check:
        raise ValueError(f"{file} must have a table [[check]] or more, got none")
    for number, check in enumerate(cfg.check, 1):
        where = f"{file}, check {number}"
        if bool(check.pack) == bool(check.set) or (check.set and check.set not in _SETS):
            raise ValueError(f"{where} must have a pack, or a set of {', '.join(_SETS)}, got {asdict(check)}")
        if check.pack and check.space is not None:
            raise ValueError(f"{where}: a space is of a set, got pack {check.pack} with one: leave it out")
        if check.limit is not None and not check.margin < min(check.limit, 1.0 - check.limit):
            rule = "limit - margin and limit + margin must lie between 0 and 1"
            raise ValueError(f"{where}: {rule}, got {check.limit:g} and {check.margin:g}: take a smaller margin")
    return cfg


class RateTest:
    """Whether a mean goal rate over terrains is ``limit + margin`` or more, or ``limit - margin`` or less."""

    def __init__(self, limit: float, margin: float, error: float) -> None:
        low, high = limit - margin, limit + margin
        self._hit, self._miss = np.log(high / low), np.log((1.0 - high) / (1.0 - low))
        self._threshold, self._error = np.log(1.0 / error), error
        self.goals = self.episodes = 0

    def add(self, goals: int, episodes: int) -> None:
        """Counts valid episodes of a round, and those that reached the goal."""
        self.goals, self.episodes = self.goals + goals, self.episodes + episodes

    @property
    def log_ratio(self) -> float:
        """Logarithm of the likelihood of the higher rate over that of the lower."""
        return float(self.goals * self._hit + (self.episodes - self.goals) * self._miss)

    @property
    def passes(self) -> bool | None:
        """Whether it passes; None as long as that is not clear."""
        return None if abs(self.log_ratio) < self._threshold else self.log_ratio > 0.0

    def decide(self) -> tuple[bool, str]:
        """What is likelier, at the end of all rounds, and what was done."""
        return self.log_ratio > 0.0, "not clear, so the likelier, with a larger error"

    def interval(self, level: float = 0.95) -> list[float]:
        """Interval of the mean rate that holds whenever one stops: rates that a mixture does not outweigh."""
        rates = np.linspace(0.0005, 0.9995, 1000)
        misses = self.episodes - self.goals
        mixture = betaln(self.goals + 0.5, misses + 0.5) - betaln(0.5, 0.5)
        wealth = mixture - self.goals * np.log(rates) - misses * np.log1p(-rates)
        kept = rates[wealth < -np.log(1.0 - level)]
        low, high = (float(kept[0]), float(kept[-1])) if len(kept) else (self.goals / self.episodes,) * 2
        return [0.0 if not self.goals else low, 1.0 if not misses else high]


class PairedTest:
    """Whether new reaches the goal less often than old on the same episodes, or not by ``margin`` or more."""

    def __init__(self, margin: float, error: float) -> None:
        self._margin, self._error = margin, error
        self.lost = self.won = self.pairs = 0

    def add(self, lost: int, won: int, pairs: int) -> None:
        """Counts valid pairs of a round, those that old alone crosses, and those that new alone does."""
        self.lost, self.won, self.pairs = self.lost + lost, self.won + won, self.pairs + pairs

    def _wealth(self, *outcomes: tuple[int, float]) -> float:
        """Logarithm of the mean wealth over bets, where so many pairs paid each outcome of at least -1."""
        logs = np.sum([count * np.log1p(BETS * paid) for count, paid in outcomes], axis=0)
        return float(np.logaddexp.reduce(logs) - np.log(len(BETS)))

    @property
    def passes(self) -> bool | None:
        """False once new is worse, True once it is not by the margin; None as long as neither is clear."""
        threshold, even, m = -np.log(self._error), self.pairs - self.lost - self.won, self._margin
        if self._wealth((self.lost, 1.0), (self.won, -1.0)) >= threshold:
            return False
        worse_by_less = self._wealth((self.lost, m - 1.0), (self.won, m + 1.0), (even, m)) >= threshold
        return True if worse_by_less else None

    def decide(self) -> tuple[bool, str]:
        """McNemar's exact test, at the end of all rounds, and what was done."""
        count = self.lost + self.won
        p = float(binomtest(self.lost, count, alternative="greater").pvalue) if count else 1.0
        return p > self._error, f"not clear, so McNemar's exact test, p = {p:.3g}"


def draw_round(terrains: Terrains, seed: int, check: int, number: int) -> Terrains:
    """The terrains with the seeds of a round's episodes."""
    sequence = np.random.SeedSequence([_SEED_KEY, seed], spawn_key=(check, number))
    count = len(terrains)
    return Terrains(**{**vars(terrains), "seeds": sequence.generate_state(count).astype(np.uint32)})


def check_terrains(check: CheckCfg, seed: int, robot: RobotCfg, folder: Path) -> tuple[Terrains, list[Entry], str]:
    """Terrains of a check, what a pack says of them (nothing of others), and their SHA-256.

    ``folder`` is where paths of packs begin.
    """
    if not check.pack:
        terrains = plain_set(check.set, check.terrains, seed, load_space(check.space)).terrains
        return terrains, [], hashlib.sha256(np.ascontiguousarray(terrains.values).tobytes()).hexdigest()
    pack = read_pack(find_pack(str(folder / check.pack) if (folder / check.pack).is_dir() else check.pack))
    resolve_robot(pack.content, robot, pack.folder / PACK_FILE, kind="pack")
    terrains = pack_set(pack.heights, check.terrains, seed).terrains
    return terrains, pack.terrains[: len(terrains)], pack.content["terrains_sha256"]


def run_check(
    check: CheckCfg, number: int, cfg: GateCfg, policies: Mapping[str, str], crosser: Crosser, folder: Path
) -> dict[str, Any]:
    """Crosses rounds until each test is clear: verdicts, counts and terrains that ``new`` fails, as JSON values."""
    began = time.perf_counter()
    terrains, known, digest = check_terrains(check, cfg.seed, crosser.robot, folder)
    count, name = len(terrains), check.name or check.pack or check.set
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
        lot = Terrains.join([draw_round(terrains, cfg.seed, number, k) for k in some])
        reached: dict[str, NDArray[np.bool_]] = {}
        for by, policy in policies.items():
            label = f"{name}, {by}, round {done + 1} of at most {check.rounds}"
            result = crosser.cross(policy, lot, replicas=1, label=label, room=each * count, invalid_ok=True)
            valid = ~result.invalid.reshape(len(some), count)
            reached[by] = (result.reached_goal & ~result.invalid).reshape(len(some), count)
            goals[by] += [reached[by].sum(axis=0), valid.sum(axis=0)]
            reached[f"{by} valid"] = valid
        done = some.stop
        new, both = reached["new"], reached["new valid"] & reached.get("old valid", True)
        if isinstance(test := tests.get("rate"), RateTest) and "rate" not in clear:
            test.add(int(new.sum()), int(reached["new valid"].sum()))
        if isinstance(test := tests.get("paired"), PairedTest) and "paired" not in clear:
            old = reached["old"] & both
            test.add(int((old & ~new).sum()), int((~old & new & both).sum()), int(both.sum()))
        clear |= {kind: done for kind, test in tests.items() if kind not in clear and test.passes is not None}
    reached_goal, valid = goals["new"]
    episodes = done * count
    if (invalid := episodes - int(valid.sum())) > MAX_INVALID_SHARE * episodes:
        rule = f"{name}: at most {MAX_INVALID_SHARE:.0%} of the episodes may be invalid"
        raise ValueError(f"{rule}, got {invalid} of {episodes}: `faultline check` says what is wrong with the robot")
    verdicts = {kind: (test.passes, "clear") if kind in clear else test.decide() for kind, test in tests.items()}
    rates = {by: np.divide(*table, out=np.full(count, np.nan), where=table[1] > 0) for by, table in goals.items()}
    fails = np.flatnonzero(rates["new"] < FAILING_GOAL_RATE)
    overall = RateTest(0.5, 0.25, cfg.error)
    overall.add(int(reached_goal.sum()), int(valid.sum()))
    causes = np.array([str(entry["cause"] or "unclear") for entry in known])
    return {
        "name": name,
        "settings": asdict(check),
        "terrains": count,
        "terrains_sha256": digest,
        "passes": all(passes for passes, _ in verdicts.values()),
        "tests": {
            kind: {"passes": passes, "stopped": how, "rounds": clear.get(kind, done)}
            | {key: value for key, value in vars(tests[kind]).items() if not key.startswith("_")}
            for kind, (passes, how) in verdicts.items()
        },
        "rounds": done,
        "episodes": episodes,
        "invalid_episodes": invalid,
        "goal_rate": {by: float(np.nanmean(rate)) for by, rate in rates.items()},
        "goal_interval": overall.interval(),
        "by_cause": {cause: float(np.nanmean(rates["new"][causes == cause])) for cause in np.unique(causes).tolist()},
        "failing": [
            {"terrain": k, "goals": int(reached_goal[k]), "episodes": int(valid[k])}
            | {key: known[k][key] for key in ("elite", "kind", "cause") if known}
            | ({"old_goals": int(goals["old"][0, k])} if "old" in goals else {})
            for k in fails.tolist()
        ],
        "wall_s": time.perf_counter() - began,
    }


def run_gate(file: Path, robot: RobotCfg, policies: Mapping[str, str], compute: Compute) -> dict[str, Any]:
    """Runs the checks of a gate.toml on the controller ``new`` of ``policies``, against ``old`` if there is one.

    A controller that does not cross level ground fails, and is not asked further. Returns JSON values.
    """
    cfg = read_gate(file)
    if lone := [check for check in cfg.check if check.limit is None and "old" not in policies]:
        rule = "a check without a limit is of old against new"
        raise ValueError(f"{rule}, got {lone[0].name or lone[0].pack or lone[0].set} and no old controller: give one")
    for policy in policies.values():
        check_policy(policy, robot, compute.device)
    with Crosser(robot, compute, cache=crossings_folder(robot)) as crosser:
        level = measure_level_ground(crosser, policies["new"])["searched"]
        walks = level["goal"] >= MIN_GOAL_RATE
        each = enumerate(cfg.check if walks else ())
        checks = [run_check(check, k, cfg, policies, crosser, file.resolve().parent) for k, check in each]
    return {
        **compute.origin(cfg.seed),
        **controller_identity(robot, policies["new"]),
        "old": controller_identity(robot, policies["old"]) if "old" in policies else None,
        "gate_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "error": cfg.error,
        "passes": walks and all(check["passes"] for check in checks),
        "level_ground": level | {"passes": walks, "limit": MIN_GOAL_RATE},
        "checks": checks,
        "skipped": [] if walks else [check.name or check.pack or check.set for check in cfg.check],
    }


def reason(check: Mapping[str, Any]) -> str:
    """Why a check passes or fails, in a line."""
    parts = []
    for kind, test in check["tests"].items():
        limit, margin = (check["settings"][key] for key in ("limit", "margin"))
        if kind == "rate":
            asked = f"goal rate {test['goals'] / max(1, test['episodes']):.3f}, asked for {limit:g}"
        else:
            asked = f"{test['lost']} episodes lost, {test['won']} won against old, worse by {margin:g} is too much"
        rounds = f"{test['rounds']} round{'s' * (test['rounds'] > 1)}"
        parts.append(f"{asked}: {test['stopped']}, {rounds} of {check['terrains']} episodes")
    return "; ".join(parts)


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
    counts = {word: str(sum(verdict == word for _, verdict, _, _ in rows)) for word in ("fail", "skipped")}
    about = {"name": "faultline", "tests": str(len(rows)), "errors": "0", "failures": counts["fail"]}
    suite = ElementTree.Element("testsuite", about | {"skipped": counts["skipped"], "timestamp": report["date"]})
    properties = ElementTree.SubElement(suite, "properties")
    for name in ("robot", "policy", "policy_sha256", "gate_sha256", "commit", "device", "seed"):
        ElementTree.SubElement(properties, "property", name=name, value=str(report[name]))
    for name, verdict, why, seconds in rows:
        case = ElementTree.SubElement(
            suite, "testcase", classname=f"faultline.{report['robot']}", name=name, time=f"{seconds:.3f}"
        )
        if verdict == "pass":
            ElementTree.SubElement(case, "system-out").text = why
        else:
            ElementTree.SubElement(case, "failure" if verdict == "fail" else "skipped", message=why)
    suite.set("time", f"{sum(row[-1] for row in rows):.3f}")
    suites = ElementTree.Element("testsuites")
    suites.append(suite)
    return ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True)


def to_markdown(report: Mapping[str, Any]) -> str:
    """The report as a summary in Markdown, as a step of GitHub's shows it."""
    lines = [f"### faultline: {report['robot']} {'passes' if report['passes'] else 'fails'}", ""]
    lines += ["| check | verdict | why |", "|---|---|---|"]
    lines += [f"| {name} | **{verdict}** | {why} |" for name, verdict, why, _ in to_rows(report)]
    for check in report["checks"]:
        low, high = check["goal_interval"]
        rates = ", ".join(f"{by} {rate:.3f}" for by, rate in check["goal_rate"].items())
        invalid = f", {check['invalid_episodes']} invalid" if check["invalid_episodes"] else ""
        crossed = f"{check['episodes']} episodes on {check['terrains']} terrains{invalid}"
        fails = f"new fails {len(check['failing'])} of them"
        rates += f" (new {low:.3f} to {high:.3f}, 95 %)"
        lines += ["", f"**{check['name']}**: goal rate {rates}, {crossed}; {fails}."]
    error = f"Each verdict is wrong with a chance of at most {report['error']:.0%}, if it was clear."
    return "\n".join([*lines, "", error, ""])


def save_failing(report: Mapping[str, Any], gate: Path, robot: RobotCfg, folder: Path) -> None:
    """Writes some terrains that newly fail as height maps, which `faultline film --terrain` takes.

    Those that old crosses come first. Terrains under conditions, which a map does not have, are left out.
    """
    cfg = read_gate(gate)
    for check, found in zip(cfg.check, report["checks"], strict=False):
        space = load_space(check.space)
        if found["passes"] or space.has_conditions or space.ground:
            continue
        terrains, _, _ = check_terrains(check, cfg.seed, robot, gate.resolve().parent)
        failing = sorted(found["failing"], key=lambda row: (-row.get("old_goals", 0), row["goals"] / row["episodes"]))
        rows = [row["terrain"] for row in failing[:_SAVED]]
        heights = terrains.heights if terrains.heights is not None else make_heights(terrains.values, terrains.space)
        for row in rows:
            file = folder / f"{re.sub(r'[^a-z0-9]+', '-', found['name'].lower())}-{row}.npz"
            prepare_output(file)
            write_atomically(file, npz_bytes({"heights": heights[row], "size_m": _SIZE_M}))


def publish_gate(
    file: Path,
    robot: RobotCfg,
    policies: Mapping[str, str],
    compute: Compute,
    *,
    out: Path | None = None,
    junit: Path | None = None,
) -> dict[str, Any]:
    """Runs a gate (:func:`run_gate`), prints its summary and writes it: as JSON, beside it as .md, and as JUnit XML.

    Where GITHUB_STEP_SUMMARY names a file, the summary is added to it. Some terrains that newly fail lie in a folder
    beside it, named as it is.
    """
    out = out or RUNS / f"{crosser_name(robot, policies['new'])}-gate.json"
    writers = {out.with_suffix(".md"): lambda report: to_markdown(report).encode()}
    writers |= {} if junit is None else {junit: to_junit}
    for path in writers:
        prepare_output(path)
    report = publish(out, lambda: run_gate(file, robot, policies, compute), lambda found: print(to_markdown(found)))
    for path, write in writers.items():
        write_atomically(path, write(report))
    save_failing(report, file, robot, out.with_suffix(""))
    if summary := os.environ.get("GITHUB_STEP_SUMMARY"):
        with open(summary, "a", encoding="utf-8") as step:
            step.write(to_markdown(report))
    return report


class GateProcess:
    """A gate that runs in a process of its own, beside a training: it holds none of the training's GPU memory.

    Attributes:
        out: File of the report, which is there once the process has ended.
    """

    def __init__(self, command: Sequence[str], out: Path) -> None:
        prepare_output(out)
        self.out, self._log = out, out.with_suffix(".log")
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True)

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
        if status not in (0, 1):
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise RuntimeError(f"the gate ended with an error: {lines[-1] if lines else f'status {status}'}")
        return read_json(self.out)

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

    Args:
        policy: File of the controller, as ``--policy`` takes it; it must stay until the gate has ended.
        robot: Name of a shipped robot, or settings file of another.
        gate: A gate.toml.
        out: File of the report.
        old: Controller that it is compared with.
        device: A Warp device; CUDA if there is one.
    """
    command = [sys.executable, "-m", "faultline", "evaluate", "--gate", str(gate), "--robot", robot, "--out", str(out)]
    command += ["--policy", str(policy)] if old is None else ["--policies", f"old={old}", f"new={policy}"]
    return GateProcess(command + ([] if device is None else ["--device", device]), Path(out))
