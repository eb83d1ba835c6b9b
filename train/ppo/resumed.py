"""What a training that is gone on with was begun with: its settings, out of its directory and its checkpoint."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from sim.files.atomic import read_json
from sim.files.settings import built
from sim.robots.robot import RobotCfg
from train.ppo.learner import check_entries
from train.ppo.ppo import PpoCfg
from train.ppo.run import CHECKPOINT, CONFIG, changes
from train.task.cfg import TaskCfg

_STATE = {"mix": (dict,)}


def settings_of(run: Path, kinds: dict[str, type]) -> dict[str, Any]:
    """What a run was begun with, as far as a command line may leave it out.

    Args:
        run: Its directory.
        kinds: Names of settings, and of which type each is; lists come back as tuples of text.

    Raises:
        ValueError: If its config.json cannot be read, or one of them is of another type.
    """
    config = read_json(run / CONFIG)
    found: dict[str, Any] = {name: config[name] for name in kinds if config.get(name) is not None}
    found = {name: tuple(map(str, value)) if isinstance(value, list) else value for name, value in found.items()}
    wrong = [name for name, value in found.items() if type(value) is not (str if kinds[name] is Path else kinds[name])]
    if wrong:
        raise ValueError(f"{run / CONFIG} is damaged at {', '.join(wrong)}: put a copy of it back")
    return {name: Path(value) if kinds[name] is Path else value for name, value in found.items()}


def task_and_ppo(run: Path, saved: dict[str, Any], robot: RobotCfg) -> tuple[TaskCfg, PpoCfg]:
    """Settings of task and learner that a training of a base controller was begun with.

    Args:
        run: Its directory.
        saved: Its checkpoint.
        robot: Gives what a run of an older version does not know of.

    Raises:
        ValueError: If they are damaged, or of a version that had others.
    """
    settings = saved["extra"]["settings"]
    own = {"task": asdict(TaskCfg.of(robot)), "ppo": asdict(PpoCfg.of(robot))}
    try:
        known = {name: _over(own[name], settings[name]) for name in own}
        return built(TaskCfg, known["task"], "task"), built(PpoCfg, known["ppo"], "ppo")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{run / CHECKPOINT} is damaged, or of another version: {error}; put a copy of it back, or begin a new run"
        ) from None


def _over(own: dict[str, Any], given: Any) -> Any:
    """The given values, and those of one's own where there are none, in nested settings likewise."""
    if not isinstance(given, dict):
        return given
    nested = {name: _over(own[name], value) for name, value in given.items() if isinstance(own.get(name), dict)}
    return {**own, **given, **nested}


def saved_ppo(run: Path | None, saved: dict[str, Any]) -> PpoCfg:
    """Settings of the learner in a checkpoint.

    Raises:
        ValueError: If they are damaged.
    """
    try:
        return built(PpoCfg, saved["extra"]["settings"]["ppo"], "ppo")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run} is damaged: {error} in its settings of ppo; put a copy of it back") from error


def check_resumed(run: Path, saved: dict[str, Any], settings: dict[str, Any]) -> None:
    """Refuse to go on with other settings.

    Raises:
        ValueError: If the checkpoint of the run is damaged, or was made with others; naming them.
    """
    check_entries(saved["extra"], _STATE, run / CHECKPOINT)
    before = saved["extra"]["settings"]
    different = changes(_wherever_elites_lie(before), _wherever_elites_lie(settings))
    if different:
        raise ValueError(
            f"{run} was begun with other settings ({'; '.join(different)}): leave out what is given otherwise, "
            "put an archive that has changed back, or begin a new run"
        )


def _wherever_elites_lie(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings without the place of the archive, which may have moved: its hash says whether it is the same."""
    archive = settings.get("archive")
    if not isinstance(archive, dict):
        return settings
    return {**settings, "archive": {key: value for key, value in archive.items() if key != "path"}}
