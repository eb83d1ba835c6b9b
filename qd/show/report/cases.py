"""The elites that are crossed for a page: robots close up where they fail, and another controller beside."""

from collections.abc import Sequence
from typing import Any

from qd.archive import Archive
from qd.faults import further_rates
from qd.groups import VERDICTS, Ranking
from qd.run.progress import Bar
from qd.show.crossed import ARRIVED, Rate, draw_crossing, rates_of
from qd.show.elites import OpenedRun
from qd.show.recordings import Recordings, on_elite
from qd.show.report.page import Table, figure_source
from qd.show.report.pictures import close_pictures, failure_of, same_moment
from sim.recording.recorder import Recording


def cross_cases(
    opened_run: OpenedRun,
    ranking: Ranking,
    policy: str,
    heads: Sequence[int],
    others: Sequence[int],
    recordings: Recordings,
    *,
    episodes: int,
    pictured: bool,
) -> dict[int, dict[str, Any]]:
    """Lets a controller cross elites and takes their pictures, by number; one without a valid episode is left out.

    ``heads`` are crossed by another controller too, if they have a certificate; ``others`` are shown in short. What the
    template takes of each: its number, name and verdict, the ``source`` of the picture at the moment of failure
    ``time_s`` [s], empty without pictures, who crosses ``beside`` it, if anybody, the source of the ``figure`` with
    paths and profile, empty in short, the table of its ``rates``, and the command that films it.
    """
    files, cases = opened_run.certifiers(), dict[int, dict[str, Any]]()
    names = {number: name for number in heads if (name := opened_run.certifier(number)) is not None}
    crossings = [(number, policy) for number in (*heads, *others)]
    crossings += [(number, files[name]) for number, name in names.items()]
    wanted = [on_elite(opened_run.archive, number, policy=who, replicas=episodes) for number, who in crossings]
    recorded = dict(zip(crossings, recordings.all_of(wanted), strict=True))
    with Bar("drawing", len(heads) + len(others)) as bar:
        for number in (*heads, *others):
            name = names.get(number)
            other = None if name is None else (name, recorded[number, files[name]])
            case = _case(opened_run, ranking, number, recorded[number, policy], other, number in heads, pictured)
            cases |= {number: case} if case else {}
            bar.move_to(len(cases))
    return cases


def _case(
    opened_run: OpenedRun,
    ranking: Ranking,
    number: int,
    recording: Recording,
    other: tuple[str, Recording] | None,
    whole: bool,
    pictured: bool,
) -> dict[str, Any] | None:
    archive = opened_run.archive
    scales = dict(zip(archive.penalties, archive.scales, strict=True))
    if (failure := failure_of(recording, scales)) is None:
        return None
    moments = [failure] if other is None else [failure, same_moment(failure, other[1], scales)]
    sources = close_pictures(opened_run.robot, moments) if pictured else [""] * len(moments)
    beside = None
    if other is not None:
        rate = rates_of(other[1])[ARRIVED]
        beside = {"name": other[0], "source": sources[1], "time_s": moments[1].time_s, "rate": rate}
    arrived, row = rates_of(recording)[ARRIVED], ranking.elites.place_of(number)
    title = f"{archive.robot}, elite {number} of {len(archive):,}: {arrived.count} crossings"
    return {
        "number": number,
        "name": ranking.name(row),
        "verdict": VERDICTS[int(ranking.elites.verdict[row])],
        "source": sources[0],
        "time_s": failure.time_s,
        "beside": beside,
        "figure": figure_source(draw_crossing(recording, title)) if whole else "",
        "rates": _rates(ranking, archive, row, arrived),
        "film": opened_run.command("film", elite=number),
    }


def _rates(ranking: Ranking, archive: Archive, row: int, arrived: Rate) -> Table:
    """Who reaches the goal how often: here, when the elite was found or judged, and under other conditions."""
    elites, number = ranking.elites, int(ranking.elites.numbers[row])
    tries = "fresh tries" if elites.fresh[row] else "tries of the search"
    rates = {
        "for this page": arrived,
        tries: Rate(elites.hits("goal_rate", row), int(elites.counted[row])),
    }
    rates |= {who: Rate(*rate) for who, rate in further_rates(archive, number).items()}
    rows = [[name, f"{rate.hits} of {rate.count}", rate.limits] for name, rate in rates.items()]
    return Table(head=["goal reached", "", "95 % interval"], rows=rows)
