"""The elites that are crossed for a page: robots close up where they fail, and another controller beside."""

from collections.abc import Sequence
from dataclasses import dataclass

from qd.archive import Archive, FaultCounts
from qd.groups import VERDICTS, Ranking
from qd.run.progress import share_bar
from qd.show.crossed import ARRIVED, Crossed, Rate, crossed_of, draw_crossing
from qd.show.recordings import Recordings, on_elite
from qd.show.report.page import Table, figure_source
from qd.show.report.pictures import close_pictures, failure_of, same_moment
from qd.show.report.search import Material
from sim.recording.recorder import Recording


@dataclass(frozen=True, kw_only=True)
class Beside:
    """Another controller on the same terrain."""

    name: str
    source: str
    """Of its picture."""
    time_s: float
    """Of the picture."""
    rate: Rate
    """How often it reached the goal."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One elite."""

    number: int
    name: str
    """Its cause and how it ends."""
    verdict: str
    source: str
    """Of the picture at the moment of failure; empty without pictures."""
    time_s: float
    """Of that moment."""
    beside: Beside | None
    figure: str
    """Source of the map with paths, profile and penalties; empty of an elite that is shown in short."""
    rates: Table
    film: str
    """The command that films it."""


def cross_cases(
    material: Material, heads: Sequence[int], others: Sequence[int], recordings: Recordings, *, episodes: int,
    pictured: bool,
) -> dict[int, Case]:  # fmt: skip
    """Crosses elites and takes their pictures, by number; one whose episodes are all invalid is left out.

    ``heads`` are crossed by another controller too, if they have a certificate; ``others`` are shown in short.
    """
    opened_run, archive, cases = material.opened_run, material.archive, dict[int, Case]()
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
) -> Case | None:  # fmt: skip
    archive, ranking = material.archive, material.ranking
    scales = dict(zip(archive.penalties, archive.scales, strict=True))
    if (failure := failure_of(recording, scales)) is None:
        return None
    moments = [failure] if other is None else [failure, same_moment(failure, other[1], scales)]
    sources = close_pictures(material.opened_run.robot, moments) if pictured else [""] * len(moments)
    beside = None
    if other is not None:
        rate = crossed_of(other[1]).rates[ARRIVED]
        beside = Beside(name=other[0], source=sources[1], time_s=moments[1].time_s, rate=rate)
    crossed, row = crossed_of(recording), ranking.elites.place_of(number)
    title = f"{archive.robot}, elite {number} of {len(archive):,}: {len(crossed.chosen)} crossings"
    return Case(
        number=number,
        name=ranking.name(row),
        verdict=VERDICTS[int(ranking.elites.verdict[row])],
        source=sources[0],
        time_s=failure.time_s,
        beside=beside,
        figure=figure_source(draw_crossing(crossed, title)) if whole else "",
        rates=_rates(ranking, archive, row, crossed),
        film=material.command("film", elite=number),
    )


def _rates(ranking: Ranking, archive: Archive, row: int, crossed: Crossed) -> Table:
    """Who reaches the goal how often: here, when the elite was found or judged, and under other conditions."""
    elites, number = ranking.elites, int(ranking.elites.numbers[row])
    tries = "fresh tries" if elites.fresh[row] else "tries of the search"
    rates = {
        "for this page": crossed.rates[ARRIVED],
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
