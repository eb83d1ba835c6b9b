"""Settings of a search: presets, what a command line changes of them, and what a run that goes on must still be.

Nothing here imports pyribs, which takes seconds: `--help` and the worker processes do without.
"""

import json
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.descriptors import Cells
from qd.fitness import FitnessCfg
from sim.files.command import split_words
from sim.files.records import PENALTY_DEFINITION, robot_identity
from sim.files.settings import check, from_builtins, setting
from sim.policy.spec import SHIPPED, ControllerSpec, controller_hash, label_suffix, spec_of

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

Settings = dict[str, Any]
"""The settings that make a run what it is, as JSON values."""

METHODS = ("cma_mae", "cma_me", "map_elites", "surrogate", "hard_random", "uniform_random")
ES_KINDS = ("cma_es", "sep_cma_es")
RESTART_RULES = ("basic", "no_improvement")
_SHARE = {"least": 0.0, "most": 1.0}
_STEPS = {"least": 1e-6, "most": 1e3}  # what evolution strategies can reckon with; genes are float32 in [-1, 1]


@dataclass(frozen=True, kw_only=True)
class SchedulerCfg:
    """How terrains are asked for."""

    method: str = "surrogate"
    """Where new terrains come from: `surrogate`, elites varied by iso+line for some generations that networks judge
    (after DSAGE, Bhatt et al. 2022); `cma_mae` (Fontaine and Nikolaidis 2023); `cma_me` (Fontaine et al. 2020);
    `map_elites`, elites varied by iso+line (Vassiliades and Mouret 2018); `hard_random`, the paper's, every height at
    its limit; `uniform_random`. The last two learn nothing. Several are joined by a plus: emitters take them in turn,
    and where there are fewer emitters, the first methods count. docs/comparison.md compares them."""
    emitters: int = setting(10, least=1)
    """Emitters that ask, each with an evolution strategy or a stream of its own."""
    batch_size: int = setting(20, least=2)
    """Terrains an emitter asks for in an iteration."""
    groups: int = setting(1, least=1, most=32)
    """Groups of emitters that ask and are told in turn, in a fixed order: robots have the terrains of the others to
    cross while the last robots of a group's terrains still walk."""
    learning_rate: float = setting(0.09, least=0.0, most=1.0)
    """Step of a cell's acceptance threshold toward the fitness found there; 1 is elitist, 0 pure optimisation."""
    sigma0: float = setting(2.0, **_STEPS)
    """First step size; genes live in [-1, 1]. So wide a start asks for terrains at the genes' limits, which are the
    hard ones: 172 elites after 15 iterations of the paper preset, against 152 from 1.0 and 114 from 0.5 (a seed each).
    """
    restart_rule: str = "50"
    """When an emitter restarts at an elite: every so many iterations, or one of `basic` and `no_improvement`."""
    es: str = setting("cma_es", one_of=ES_KINDS)
    """Evolution strategy: `cma_es` adapts all covariances, `sep_cma_es` the variances alone."""
    iso_sigma: float = setting(0.02, least=0.0, most=_STEPS["most"])
    """Iso+line: standard deviation of each gene's own change (published: .01 of the genes' range)."""
    line_sigma: float = setting(0.2, least=0.0, most=_STEPS["most"])
    """Iso+line: standard deviation of the step along the line to another elite, in its length (published: .2)."""
    crossover_share: float = setting(0.3, **_SHARE)
    """Surrogate: share of the varied elites that take each of their parts, such as bumps, from a further elite with a
    chance of a half; of no effect where a space has no parts."""
    candidates: int = setting(20, least=1, most=10_000)
    """Surrogate: terrains that the networks judge in each generation for one that robots cross."""
    generations: int = setting(10, least=1, most=1_000)
    """Surrogate: generations that the networks judge before robots cross the best."""
    explore_share: float = setting(0.25, **_SHARE)
    """Surrogate: share of its terrains that are elites varied once, whatever the networks say."""
    disagree_share: float = setting(0.1, **_SHARE)
    """Surrogate: share of its terrains that the networks disagree most about."""
    training_steps: int = setting(100, least=1, most=100_000)
    """Surrogate: steps of training an iteration, each on 64 terrains a network."""

    def __post_init__(self) -> None:
        check(self)
        if not set(self.methods) <= set(METHODS) or len(set(self.methods)) < len(self.methods):
            raise ValueError(
                f"method must be one of {', '.join(METHODS)}, or several joined by a plus, each once, got {self.method}"
            )
        if self.restart_rule not in RESTART_RULES and not (self.restart_rule.isdecimal() and int(self.restart_rule)):
            raise ValueError(
                f"restart_rule must be a positive number of iterations or one of {', '.join(RESTART_RULES)}, "
                f"got {self.restart_rule}"
            )
        if self.explore_share + self.disagree_share > 1.0:
            raise ValueError(
                f"explore_share and disagree_share must be at most 1 together, got {self.explore_share} and "
                f"{self.disagree_share}"
            )
        if self.groups > self.emitters:
            raise ValueError(f"groups must be at most as many as emitters, {self.emitters}, got {self.groups}")

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods joined in ``method``."""
        return tuple(self.method.split("+"))

    @property
    def num_terrains(self) -> int:
        """Terrains of one iteration."""
        return self.emitters * self.batch_size


@dataclass(frozen=True, kw_only=True)
class SearchCfg:
    """What is searched, with what, and how; runs that agree in all but ``iterations`` are the same run."""

    robot: str
    """Name of the robot."""
    preset: str
    policy: str
    """Controller: ``shipped``, or as :func:`sim.policy.loaders.load_policy` takes it."""
    policy_sha256: str | None
    """Hash of the controller's files, None where there are none."""
    seed: int = setting(least=0)
    iterations: int = setting(least=1)
    """Iterations to reach; may be raised later."""
    replicas: int = setting(least=1)
    """Episodes a terrain."""
    intervals: int = setting(least=1)
    """Intervals of each ratio."""
    collision_bit: bool
    """Whether base collision is a descriptor of its own."""
    fitness: FitnessCfg
    scheduler: SchedulerCfg
    space: str = "super_gaussian"
    """Terrain space, as :func:`sim.spaces.registry.load_space` takes it."""
    space_sha256: str | None = None
    """Hash of its code if it is a user's own."""
    robot_sha256: str | None = None
    """Hash of the robot's settings, model and meshes; None in a run of a version before there was one."""
    penalty_definition: str = PENALTY_DEFINITION
    """How the penalties are defined (:data:`sim.files.records.PENALTY_DEFINITION`)."""
    reevaluate_every: int = setting(50, least=0)
    """Every so many iterations, up to 200 elites cross 40 fresh episodes each; 0: never."""

    def __post_init__(self) -> None:
        check(self)
        Cells(len(self.fitness.penalties), self.intervals)  # refuses too many

    @property
    def cells(self) -> Cells:
        """The archive's cells."""
        return Cells(len(self.fitness.penalties), self.intervals, collision_bit=self.collision_bit)

    @property
    def episodes_per_iteration(self) -> int:
        """Episodes of one iteration."""
        return self.scheduler.num_terrains * self.replicas


def preset(name: str, robot: "RobotCfg", policy: str | None = None) -> SearchCfg:
    """Settings by the name of a preset.

    ``paper`` is the paper's search: 10 emitters x 20 terrains x 20 episodes, 1,000 iterations. ``wide`` has as many
    episodes, and eight times as many emitters and an eighth of the iterations, which fills a GPU. ``small`` is one that
    a laptop finishes while one waits: 4 emitters x 8 terrains x 4 episodes, 20 iterations.

    Args:
        name: Of the preset.
        robot: Robot to search.
        policy: Controller to search, other than the robot's own.

    Raises:
        ValueError: If there is no such preset, or the robot's penalty scales were never measured.
    """
    if name not in _PRESETS:
        raise ValueError(f"unknown preset '{name}': expected one of {', '.join(_PRESETS)}")
    return SearchCfg(
        robot=robot.name,
        preset=name,
        policy=policy or SHIPPED,
        policy_sha256=None,
        seed=0,
        intervals=10,
        collision_bit=robot.collision_bit,
        fitness=FitnessCfg(penalties=robot.penalties, scales=robot.read_penalty_scales(policy)),
        **_PRESETS[name],
    )


_PRESETS: dict[str, dict[str, Any]] = {
    "wide": {"iterations": 125, "replicas": 20, "scheduler": SchedulerCfg(emitters=80, groups=8, training_steps=400)},
    "paper": {"iterations": 1000, "replicas": 20, "scheduler": SchedulerCfg()},
    "small": {
        "iterations": 20, "replicas": 4,
        "scheduler": SchedulerCfg(emitters=4, batch_size=8, groups=2, generations=3),  # judging takes time on a CPU
    },
}  # fmt: skip


def changed(cfg: SearchCfg, changes: dict[str, Any]) -> SearchCfg:
    """Settings with some of them changed, wherever they stand.

    Args:
        cfg: Settings.
        changes: New values by the names of fields of this class, its fitness or its scheduler; None changes nothing.

    Raises:
        ValueError: If a value is out of range.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    if "emitters" in given:  # a preset's groups are of its own emitters
        given.setdefault("groups", min(cfg.scheduler.groups, max(given["emitters"], 1)))
    for part in ("fitness", "scheduler"):
        current = getattr(cfg, part)
        names = {field.name for field in fields(current)} & given.keys()
        cfg = replace(cfg, **{part: replace(current, **{name: given.pop(name) for name in names})})
    return replace(cfg, **given)


def as_settings(cfg: SearchCfg) -> Settings:
    """What makes a run what it is: all fields but ``iterations``, as JSON values."""
    settings = asdict(cfg, dict_factory=_json_object)
    del settings["iterations"]
    return settings


def _json_object(items: list[tuple[str, Any]]) -> Settings:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in items}


_GONE = {"mirror_share": 0.0, "shares": "fixed", "gradient_share": 0.0, "gradient_sigma": 0.05}
"""Settings that did not pay and are gone, with the values that changed nothing."""


def still_there(values: Any) -> Any:
    """How terrains are asked for, as JSON values, without settings that are gone and changed nothing."""
    if not isinstance(values, dict):
        return values  # which is refused later
    return {name: value for name, value in values.items() if name not in _GONE or value != _GONE[name]}


def from_settings(settings: Settings, iterations: int) -> SearchCfg:
    """Settings as a run directory remembers them.

    Args:
        settings: All fields but ``iterations``, as JSON values.
        iterations: Iterations to reach.

    Raises:
        ValueError: If they are not the settings of a search.
    """
    try:
        own = {"scheduler": still_there(settings.get("scheduler")), "iterations": iterations}
        return from_builtins(SearchCfg, {**settings, **own}, "a search")
    except (TypeError, ValueError) as error:
        raise ValueError(f"settings must be those of a search of this version, but: {error}") from None


_OF_SURROGATE = {
    "crossover_share", "candidates", "generations", "explore_share", "disagree_share", "training_steps",
}  # fmt: skip
"""Settings of no effect where no method of a search is ``surrogate``."""


def differences(there: Settings, wanted: Settings, prefix: str = "") -> list[str]:
    """Settings that differ and have an effect, each as ``scheduler.sigma0 (0.5 there, 0.2 wanted)``."""
    found = []
    unused = set() if any("surrogate" in own.get("method", "surrogate") for own in (there, wanted)) else _OF_SURROGATE
    for key in sorted((there.keys() | wanted.keys()) - unused):
        a, b = there.get(key), wanted.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, f"{prefix}{key}.")
        elif a != b:
            found.append(f"{prefix}{key} ({_short(a)} there, {_short(b)} wanted)")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def policy_spec(cfg: SearchCfg, robot: "RobotCfg") -> str:
    """What to load the controller from, as :func:`sim.policy.loaders.load_policy` takes it."""
    return spec_of(cfg.policy, robot)


def kept_penalties(robot: "RobotCfg", without: Sequence[str]) -> tuple[str, ...]:
    """The robot's penalties without some.

    Args:
        robot: The robot.
        without: Names to leave out; several may stand in one, apart by spaces or commas.

    Raises:
        ValueError: If a name is unknown, or fewer than 2 penalties are left.
    """
    names = split_words(without)
    _check_known(names, robot)
    kept = tuple(name for name in robot.penalties if name not in names)
    if len(kept) < 2:
        raise ValueError(
            f"without must leave at least 2 of {', '.join(robot.penalties)}, got {', '.join(names)}: a single ratio is "
            "always 1"
        )
    return kept


def _check_known(names: Sequence[str], robot: "RobotCfg") -> None:
    unknown = [name for name in names if name not in robot.penalties]
    if unknown:
        raise ValueError(f"no penalty named {', '.join(unknown)}: {robot.name} has {', '.join(robot.penalties)}")


def measured_now(cfg: SearchCfg, robot: "RobotCfg") -> SearchCfg:
    """Settings with the present scales of their penalties and the present hashes of controller and robot.

    Raises:
        ValueError: If the robot lacks one of the penalties, or their scales were never measured.
    """
    penalties = cfg.fitness.penalties
    _check_known(penalties, robot)
    named = None if cfg.policy == SHIPPED else cfg.policy
    scales = dict(zip(robot.penalties, robot.read_penalty_scales(named), strict=True))
    return replace(
        cfg,
        robot=robot.name,
        **robot_identity(robot),
        policy_sha256=controller_hash(policy_spec(cfg, robot)),
        fitness=replace(cfg.fitness, scales=tuple(scales[name] for name in penalties)),
        collision_bit=robot.collision_bit,
    )


def code_of(cfg: SearchCfg) -> str | None:
    """The controller if it is code, which every command that goes on with the run must name; else None."""
    return cfg.policy if ControllerSpec.parse(cfg.policy).runs_code else None


def refuse_unnamed_code(policy: str, given: str | None, path: Path, *, flag: str = "policy") -> None:
    """Refuses to run code that a run directory names and the command line does not.

    Args:
        policy: Controller of the run.
        given: That of the command line, if any.
        path: The run directory.
        flag: The flag that names it.

    Raises:
        ValueError: If the run's is code and none is given.
    """
    if given is None and ControllerSpec.parse(policy).runs_code:
        raise ValueError(
            f"{path} was searched with the controller {policy}, which is code: name it again "
            f"(--{flag} {shlex.quote(policy)}), since no code runs that the command line does not name"
        )


def moved_policy(there: SearchCfg, given: str | None) -> str | None:
    """The file given for a run's controller, if it is the run's own in another place."""
    same = given is not None and there.policy_sha256 is not None and controller_hash(given) == there.policy_sha256
    return given if same else None


def is_searched(cfg: SearchCfg, policy: str, robot: "RobotCfg") -> bool:
    """Whether a controller is that of a search: by its hash, or by its name where it has none."""
    if cfg.policy_sha256 is None:
        return policy == policy_spec(cfg, robot)
    return controller_hash(policy) == cfg.policy_sha256


def suffix_of(cfg: SearchCfg, policy: str, robot: "RobotCfg") -> str:
    """The ending of the names of what is made of a run with a controller: empty for the search's, else ``-C-G``."""
    return "" if is_searched(cfg, policy, robot) else label_suffix(policy)


def own_policy(path: Path, cfg: SearchCfg, robot: "RobotCfg") -> str:
    """The controller that a run was searched with, which must be what it was.

    Raises:
        ValueError: If it is lost, another one now, or code, which only the command line may name.
    """
    refuse_unnamed_code(cfg.policy, None, path)
    policy = policy_spec(cfg, robot)
    if not is_searched(cfg, policy, robot):
        digest = controller_hash(policy)
        state = "lost" if digest is None else "another one now"
        raise ValueError(
            f"{path} was searched with the controller in {policy}, which is {state} (expected SHA-256 "
            f"{cfg.policy_sha256}, got {digest}): put it back, or say with --policy which one to cross with"
        )
    return policy


def resumed(path: Path, there: SearchCfg, robot: "RobotCfg", changes: Settings, moved: str | None) -> SearchCfg:
    """The settings that a run would go on with.

    Args:
        path: Its directory.
        there: Its settings.
        robot: Its robot as it is now, by :func:`sim.robots.find.robot_of`.
        changes: What the command line gives, as :func:`changed` takes it.
        moved: Where the run's controller is now, if elsewhere.

    Raises:
        ValueError: If its controller is lost, or a setting is out of range.
    """
    if moved is not None:
        changes = {**changes, "policy": moved}
    wanted = measured_now(changed(there, changes), robot)
    wanted = replace(wanted, robot_sha256=there.robot_sha256)  # was compared; a run that names none goes on so
    if moved is not None:
        return replace(wanted, policy=there.policy)
    if wanted.policy == there.policy and there.policy_sha256 is not None and wanted.policy_sha256 is None:
        raise ValueError(
            f"{path} was searched with the controller in {policy_spec(there, robot)}, got no such file now: put it "
            "back, or say where it is now with --policy"
        )
    return wanted


def refuse_changes(path: Path, what: str, there: Settings, wanted: Settings) -> None:
    """Refuses to go on with settings that differ in more than the number of iterations.

    Raises:
        ValueError: If a setting differs.
    """
    different = differences(there, wanted)
    if different:
        raise ValueError(
            f"{path} holds a {what} of other settings: {', '.join(different)}: start a new {what} for those"
        )
