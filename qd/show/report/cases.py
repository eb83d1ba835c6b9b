"""The elites that are crossed for a page: robots close up where they fail, and another controller beside."""

from collections.abc import Sequence
from typing import Any

from qd.archive import Archive, FaultCounts
from qd.groups import VERDICTS, Ranking
from qd.run.progress import share_bar
from qd.show.crossed import ARRIVED, Rate, draw_crossing, rates_of
from qd.show.recordings import Recordings, on_elite
from qd.show.report.page import Table, figure_source
from qd.show.report.pictures import close_pictures, failure_of, same_moment
from qd.show.report.search import Material
from sim.recording.recorder import Recording


def cross_cases(
    material: Material, heads: Sequence[int], others: Sequence[int], recordings: Recordings, *, episodes: int,
    pictured: bool,
) -> dict[int, dict[str, Any]]:  # fmt: skip
    """Crosses elites and takes their pictures, by number; one whose episodes are all invalid is left out.

    ``heads`` are crossed by another controller too, if they have a certificate; ``others`` are shown in short. What the
    template takes of each: its number, name and verdict, the ``source`` of the picture at the moment of failure
    ``time_s`` [s], empty without pictures, who crosses ``beside`` it, if anybody, the source of the ``figure`` with
    paths and profile, empty in short, the table of its ``rates``, and the command that films it.
    """
    opened_run, archive, cases = material.opened_run, material.archive, dict[int, dict[str, Any]]()
    files = opened_run.certifiers()
    names = {number: name for number in heads if (name := opened_run.certifier(number)) is not None}
    crossings = [(number, material.policy) for number in (*heads, *others)]
    crossings += [(number, files[name]) for number, name in names.items()]
    wanted = [on_elite(archive, number, policy=policy, replicas=episodes) for number, policy in crossings]
    recorded = dict(zip(crossings, recordings.all_of(wanted), strict=True))
    with share_bar("drawing") as progress:
        for number in (*heads, *others):
            name = names.get(number)
            other = None if name is None else (name, recorded[number, files[name]])
            case = _case(material, number, recorded[number, material.policy], other, number in heads, pictured)
            cases |= {number: case} if case else {}
            progress(len(cases) / len([*heads, *others]))
    return cases


def _case(
    material: Material, number: int, recording: Recording, other: tuple[str, Recording] | None, whole: bool,
    pictured: bool,
) -> dict[str, Any] | None:  # fmt: skip
    archive, ranking = material.archive, material.ranking
    scales = dict(zip(archive.penalties, archive.scales, strict=True))
    if (failure := failure_of(recording, scales)) is None:
        return None
    moments = [failure] if other is None else [failure, same_moment(failure, other[1], scales)]
    sources = close_pictures(material.opened_run.robot, moments) if pictured else [""] * len(moments)
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
        "film": material.command("film", elite=number),
    }


def _rates(ranking: Ranking, archive: Archive, row: int, arrived: Rate) -> Table:
    """Who reaches the goal how often: here, when the elite was found or judged, and under other conditions."""
    elites, number = ranking.elites, int(ranking.elites.numbers[row])
    tries = "fresh tries" if elites.fresh[row] else "tries of the search"
    rates = {
        "for this page": arrived,
        tries: Rate(elites.hits("goal_rate", row), int(elites.counted[row])),
    }
    faults = archive.faults or FaultCounts.none_of(len(archive))
    counts = {"finer contact, steps of 1 ms": faults.resolved_outcomes[number]}
    for column, name in enumerate(faults.certifiers):
        counts[name] = faults.certifier_outcomes[number, column]
        counts[f"{name}, finer contact"] = faults.certifier_resolved_outcomes[number, column]
    rates |= {name: Rate(int(ends[0]), int(ends[:3].sum())) for name, ends in counts.items() if ends.any()}
    rows = [[name, f"{rate.hits} of {rate.count}", rate.limits] for name, rate in rates.items()]
    return Table(head=["goal reached", "", "95 % interval"], rows=rows)
