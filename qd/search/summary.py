"""The last lines of a search or a judging: what stops the robot, the worst terrain, and what comes next."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape

from qd.faults.families import rank, summarise_search
from qd.faults.minimise.results import read_minimal
from qd.search.archive import Archive
from sim.files.command import command_line
from sim.files.templates import open_templates
from sim.robots.find import resolve_robot
from sim.terrains.spaces.registry import get_space

_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_TEMPLATES.filters["escape_markup"] = escape


def print_summary(
    run: Path, archive: Archive, *, robot: str | None = None, policy: str | None = None, space: str | None = None
) -> None:
    """Prints what a run's archive says of the controller; nothing without elites.

    Robot, controller and space are as the command line names them, if it does.
    """
    if not len(archive):
        return
    half_width = resolve_robot(archive.named(), robot, run).half_width
    archive_space = get_space(archive.space, archive.space_sha256)
    ranking = rank(archive, archive_space, read_minimal(run, archive), judged=True, half_width=half_width)
    if not len(ranking):
        return
    number = ranking.worst(1)[0]
    flags = {"run": run, "robot": robot, "space": space}
    text = _TEMPLATES.get_template("summary.txt").render(
        archive=archive,
        ranking=ranking,
        summary=summarise_search(ranking, archive),
        number=number,
        name=ranking.name(ranking.find_row(number)),
        view=command_line("view", **flags, policies=[f"searched={policy}"] if policy else []),
        report=command_line("report", **flags, policy=policy),
        replay=command_line("replay", **flags, elite=number, policy=policy),
        judge=command_line("judge", **flags, policy=policy),
        finetune=command_line("finetune", robot=robot, specialist=run, policy=policy, space=space),
    )
    console = Console(highlight=False)
    console.print(text.rstrip(), soft_wrap=not console.is_terminal)
