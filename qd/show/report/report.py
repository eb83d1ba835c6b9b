"""One page about a search, with robots that cross its worst terrains for it, or about the rounds of a hardening."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from qd.evaluate.tables import as_tables, read_tables
from qd.faults.causes import describe_cause
from qd.faults.families import VERDICTS, Ranking, summarise_search
from qd.faults.numbers import describe_witness, fault_numbers, further_rates
from qd.search.directory import METRICS_FILE, ROUNDS_FILE, RunDirectory, output_folder
from qd.search.progress import Bar
from qd.show.crossed import Rate, count_rates, draw_crossing, draw_time_line
from qd.show.elites import OpenedRun, open_run
from qd.show.figures import draw_archive, draw_curves
from qd.show.recordings import Recordings, request_elite
from qd.show.report import page
from qd.workers.compute import check_policy, choose_device
from sim.controllers.spec import SHIPPED, ControllerSpec, resolve_policy
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.files.intervals import RATES, bootstrap_interval
from sim.files.provenance import without_machine
from sim.rates import SUCCESS, rate_labels
from sim.recording.recorder import Recording
from sim.recording.renderer import open_context
from sim.robots.find import get_robot

_OTHER_CAUSES = 3  # beside those of the first pictures; one terrain of each is shown
_MAX_BARS = 10
_FAULT = VERDICTS.index("fault")
_MIN_TERRAINS = 10  # fewer have no interval of their mean


def write_report(
    run: Path | None = None,
    *,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    out: Path | None = None,
    num_elites: int = 3,
    tables: Path | None = None,
    device: str | None = None,
) -> Path:
    """Writes the page about a search, or about the rounds of a hardening; returns its file, *.html.

    The run is a directory of either, or an archive file; the newest search of the robot, else its published archive.
    ``num_elites`` of the worst terrains are shown close up; ``tables`` is the file of an evaluation to show, too.
    """
    if run is not None and (run / ROUNDS_FILE).exists():
        return write_rounds(run, robot, out)
    opened_run = open_run(robot, run, space=space)
    archive = opened_run.archive
    ranking = opened_run.rank(judged=True)
    if not len(ranking):
        raise ValueError(f"{opened_run.path} must have valid elites to report on, got none: let its search go on")
    controller = resolve_policy(policy or opened_run.as_searched()[0], opened_run.robot)
    suffix = "" if policy is None else opened_run.suffix(controller)
    out = out or output_folder(opened_run.path, opened_run.robot.name) / f"report{suffix}.html"
    page.check_page(out)
    device = choose_device(device)
    compared = None
    if tables is not None:
        content = read_tables(tables, opened_run.robot)
        hashes = {about["sha256"] for about in content["controllers"].values()}
        of_searched = archive.policy_sha256 is None or archive.policy_sha256 in hashes
        compared = {"file": without_machine(str(tables)), "tables": content, "of_searched": of_searched}
    content = collect_content(opened_run, ranking, controller, is_searched=not suffix)
    heads, others = _choose_elites(ranking, num_elites)
    cases: dict[int, dict[str, Any]] = {}
    missing = []
    try:
        check_policy(opened_run.policy(policy), opened_run.robot, device)
    except ValueError as error:
        if policy is not None:  # one that the user names must be able to cross
            raise
        reason = f"since the search's controller cannot be loaded: {error}"
        missing.append(f"No terrain is crossed, {reason}. Name it with --policy.")
    else:
        try:
            open_context(8, 8).free()
        except ValueError as error:
            missing.append(f"Close pictures are left out: {error}.")
        cases = cross_cases(opened_run, ranking, controller, heads, others, device, pictured=not missing)
        lost = [number for number in (*heads, *others) if number not in cases]
        missing += [f"All crossings of elite {number} were invalid this time." for number in lost]
    shown = {"heads": [*filter(None, map(cases.get, heads))], "others": [*filter(None, map(cases.get, others))]}
    return page.publish_page(out, "search.html", policy=policy, compared=compared, missing=missing, **shown, **content)


def _choose_elites(ranking: Ranking, num_elites: int) -> tuple[list[int], list[int]]:
    """The worst elites, failing ones if there are any, and the worst of some other causes."""
    rows = ranking.order()[:num_elites]
    rows = rows[ranking.failing[rows] | ~ranking.failing[rows].any()]
    causes = {ranking.causes[row] for row in rows}
    others = [members[0] for cause, members in ranking.by_cause().items() if cause not in causes][:_OTHER_CAUSES]
    return ranking.numbers[rows].tolist(), [int(ranking.numbers[row]) for row in others]


def cross_cases(
    run: OpenedRun, ranking: Ranking, policy: str, heads: list[int], others: list[int], device: str, *, pictured: bool
) -> dict[int, dict[str, Any]]:
    """Lets a controller, and of ``heads`` the best certifier, cross elites; pictures of valid ones by number."""
    files = run.certifiers()
    certifiers = {number: name for number in heads if (name := run.certifier(number)) is not None}
    crossings = [(number, policy) for number in (*heads, *others)]
    crossings += [(number, files[name]) for number, name in certifiers.items()]
    requests = [request_elite(run.archive, number, policy=controller) for number, controller in crossings]
    recorded = dict(zip(crossings, Recordings(run.robot, device=device).record(requests), strict=True))
    cases = {}
    with Bar("drawing", len(heads) + len(others)) as bar:
        for done, number in enumerate((*heads, *others), 1):
            recording, name = recorded[number, policy], certifiers.get(number)
            if (recording.outcome[0] != Outcome.INVALID).any():
                ghost = None if name is None else (name, recorded[number, files[name]])
                cases[number] = case = _make_case(run, ranking, number, recording, ghost, pictured)
                if number in heads:
                    title = (
                        f"{run.archive.robot}, elite {number} of {len(run.archive):,}: {case['rate'].count} episodes"
                    )
                    case["figure"] = page.encode_picture(draw_crossing(recording, title))
            bar.move_to(done)
    return cases


def _make_case(
    run: OpenedRun,
    ranking: Ranking,
    number: int,
    recording: Recording,
    ghost: tuple[str, Recording] | None,
    pictured: bool,
) -> dict[str, Any]:
    """What the template takes of an elite; ``source`` is a picture at ``time_s`` [s], empty without pictures."""
    moments = page.choose_moments(recording, ghost and ghost[1], run.scales)
    sources = page.render_close_pictures(run.robot, moments) if pictured else [""] * len(moments)
    shown = [{"source": source, "time_s": time_s} for source, (*_, time_s) in zip(sources, moments, strict=True)]
    row, genes, limit_s = ranking.find_row(number), run.archive.genes[number], run.robot.max_duration_s
    rate = count_rates(recording)["goal_rate"]
    tries = "fresh tries" if ranking.is_fresh[row] else "tries of the search"
    rates = {"for this page": rate, tries: Rate(ranking.hits("goal_rate", row), int(ranking.counted[row]))}
    rates |= {label: Rate(*counts) for label, counts in further_rates(run.archive, number).items()}
    rows = [[label, f"{rate.hits} of {rate.count}", rate.limits] for label, rate in rates.items()]
    acting = run.space.time_line(genes, limit_s)
    in_time = any((first, last) != (0.0, limit_s) for _, first, last in acting)
    return {
        **shown[0],
        "number": number,
        "name": ranking.name(row),
        "verdict": VERDICTS[int(ranking.verdict[row])],
        "conditions": run.space.condition_text(genes),
        "beside": ghost and {**shown[1], "name": ghost[0], "rate": count_rates(ghost[1])["goal_rate"]},
        "witness": describe_witness(run.archive, number),
        "time_line": page.encode_picture(draw_time_line(acting, recording)) if in_time else "",
        "figure": "",
        "rate": rate,
        "rates": page.Table(head=[SUCCESS[run.space.asks], "", "95 % interval"], rows=rows),
    }


def collect_content(opened_run: OpenedRun, ranking: Ranking, policy: str, *, is_searched: bool) -> dict[str, Any]:
    """Values of the template, without the terrains that a controller crossed for the page."""
    archive, minima, space = opened_run.archive, opened_run.minima, opened_run.space
    search = opened_run.search()
    run = RunDirectory(opened_run.folder)
    searched, _ = opened_run.as_searched()
    labels = rate_labels(space.asks)
    file = run.path / METRICS_FILE  # a run that goes on meanwhile may have some rows more
    metrics = run.read_metrics()[: archive.iterations] if file.exists() else []
    if file.exists() and len(metrics) < archive.iterations:
        rule = f"{file} must have a row for each of {archive.iterations} iterations, got {len(metrics)}"
        raise ValueError(f"{rule}: resume the search, which writes it again")
    controller = "its own controller" if searched == SHIPPED else ControllerSpec.parse(searched).label
    if search is None and opened_run.suffix(resolve_policy(SHIPPED, opened_run.robot)):
        controller = "a controller that is not at hand"
    return {
        "archive": archive,
        "success": SUCCESS[space.asks],
        "run": opened_run.command,
        "search": search,
        "metrics": metrics,
        "gpus": run.read_summary().get("gpus"),
        "controller": controller,
        "crosser": "" if is_searched else ControllerSpec.parse(policy).label,
        "place": without_machine(str(opened_run.path)),
        "summary": summarise_search(ranking, archive),
        "numbers": fault_numbers(archive),
        "fault_families": len(np.unique(ranking.families[ranking.verdict == _FAULT])),
        "means": {label: format_mean(getattr(ranking, rate), ranking.families) for rate, label in labels.items()},
        "causes": count_causes(ranking),
        "tiles": page.draw_sheet(archive.genes[ranking.numbers], space),
        "ranking": ranking,
        "verdicts": VERDICTS,
        "rates": labels,
        "limits": lambda row: Rate(ranking.hits("goal_rate", row), int(ranking.counted[row])).limits,
        "minimal_tiles": None if minima is None else page.draw_sheet(np.array([*minima.genes.values()]), space),
        "minimal": None if minima is None else minima.numbers["elites"],
        "describe_cause": describe_cause,
        "curves": page.encode_picture(draw_curves(archive, metrics)) if metrics else "",
        "parallel": page.encode_picture(draw_archive(archive)),
        "origin": page.origin_rows({} if search is None else run.read_config()),
    }


def format_mean(rates: NDArray[np.float64], families: NDArray[np.int64]) -> str:
    """Mean over terrains, with its interval over families where there are enough terrains."""
    mean = page.percent(float(rates.mean()))
    limits = bootstrap_interval(rates, 0, families=families, bounds=RATES) if len(rates) >= _MIN_TERRAINS else None
    return f"{mean} ({' to '.join(map(page.percent, limits))})" if limits else mean


def count_causes(ranking: Ranking) -> list[dict[str, Any]]:
    """The bars, the longest first; the rarest causes share one. ``tile`` is the row of the worst elite."""
    groups = ranking.by_cause()
    tiles = {cause: int(rows[0]) for cause, rows in groups.items()}
    if len(groups) > _MAX_BARS:
        rest = [groups.pop(cause) for cause in [*groups][_MAX_BARS - 1 :]]
        groups[f"{len(rest)} other causes"] = np.concatenate(rest)
    longest = max(map(len, groups.values()), default=1)
    return [
        {
            "name": name,
            "failing": len(rows),
            "faults": int((ranking.verdict[rows] == _FAULT).sum()),
            "share": 100.0 / longest,
            "tile": tiles.get(name),
        }
        for name, rows in groups.items()
    ]


def write_rounds(run: Path, robot: str | None, out: Path | None) -> Path:
    """Writes the page about the rounds of a hardening; returns its file."""
    content = _read_rounds(run, robot)
    out = out or run / "report.html"
    page.check_page(out)
    content |= {"run": without_machine(str(run)), "origin": page.origin_rows(content)}
    content["report_command"] = lambda search: command_line("report", robot=robot, run=run / search)
    return page.publish_page(out, "rounds.html", **{"choices": {}, **content})


def _read_rounds(run: Path, robot: str | None) -> dict[str, Any]:
    file = run / ROUNDS_FILE
    content = read_json(file)
    if not content.get("rounds"):
        raise ValueError(f"{file} must have a search that is over, got none: let the hardening go on")
    try:
        content["tables"] = as_tables({"robot": content["robot"], **content["tables"]})
        if not all({"controller", "search", "certifiers", "faults"} <= set(row) for row in content["rounds"]):
            raise ValueError("a round lacks a name")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} must be of `faultline harden`, got another or a damaged file: {error}") from None
    if robot is not None and get_robot(robot).name != content["robot"]:
        raise ValueError(f"{file} is of robot {content['robot']}, got --robot {robot}: give that robot or another run")
    for row in content["rounds"]:  # without a specialist faults are by the panel
        row["faults"] = row.get("faults_panel") if row["faults"] is None else row["faults"]
    return content
