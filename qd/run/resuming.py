"""What a run that goes on must still be: the same settings, controller and robot, and only code that is named again."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.run.directory import differences
from qd.run.settings import SearchCfg, Settings, changed, file_hash, measured_now, policy_spec
from sim.policy.spec import ControllerSpec

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg


def refuse_unnamed_code(policy: str, given: str | None, path: Path) -> None:
    """What a run directory names is data: code in it runs only if the command line names it, too.

    Args:
        policy: Controller of the run.
        given: That of the command line, if any.
        path: The run directory.

    Raises:
        ValueError: If the run's is code and none is given.
    """
    if given is None and ControllerSpec.parse(policy).runs_code:
        raise ValueError(
            f"{path} was searched with the controller {policy}, which is code: name it again (--policy), since no code "
            "runs that the command line does not name"
        )


def code_of(cfg: SearchCfg) -> str | None:
    """The controller if it is code, which every command that goes on with the run must name; else None."""
    return cfg.policy if ControllerSpec.parse(cfg.policy).runs_code else None


def own_file(robot: "RobotCfg") -> dict[str, Any]:
    """For the origin of a run: where the settings of a robot that is not shipped were."""
    return {} if robot.settings_file is None else {"robot_file": str(robot.settings_file)}


def origin_in(config: dict[str, Any]) -> dict[str, Any]:
    """Where a run comes from, as its config has it."""
    return {name: value for name, value in config.items() if name not in ("settings", "iterations")}


def moved_policy(there: SearchCfg, given: str | None) -> str | None:
    """The file given for a run's controller, if it is the run's own in another place."""
    same = given is not None and there.policy_sha256 is not None and file_hash(given) == there.policy_sha256
    return given if same else None


def resumed(path: Path, there: SearchCfg, robot: "RobotCfg", changes: Settings, moved: str | None) -> SearchCfg:
    """The settings that a run would go on with.

    Args:
        path: Its directory.
        there: Its settings.
        robot: Its robot as it is now.
        changes: What the command line gives, as :func:`qd.run.settings.changed` takes it.
        moved: Where the run's controller is now, if elsewhere.

    Raises:
        ValueError: If its controller is lost, or a setting is out of range.
    """
    if moved is not None:
        changes = {**changes, "policy": None}
    wanted = measured_now(changed(there, changes), robot)
    if wanted.robot_sha256 != there.robot_sha256:
        raise ValueError(
            f"{path} was searched with robot '{there.robot}' as it was: its settings, model or meshes have changed "
            f"since ({robot.spec}): put them back, or start a new run"
        )
    if moved is not None:
        return replace(wanted, policy_sha256=there.policy_sha256)
    if wanted.policy == there.policy and there.policy_sha256 is not None and wanted.policy_sha256 is None:
        raise ValueError(
            f"{path} was searched with the controller in {policy_spec(there, robot)}, got no such file now: put it "
            "back, or say where it is now with --policy"
        )
    return wanted


def refuse_changes(path: Path, what: str, there: Settings, wanted: Settings) -> None:
    """Nothing but its number of iterations may change where something goes on.

    Raises:
        ValueError: If a setting differs.
    """
    different = differences(there, wanted)
    if different:
        raise ValueError(
            f"{path} holds a {what} of other settings: {', '.join(different)}: start a new {what} for those"
        )
