"""The page's chapters about elites: the failure modes, the worst and the steadiest one by one, and all in a table."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from qd.faults import elite_words
from qd.groups import MAX_MODES, TOLERANCE, VERDICTS, Elites, Modes
from qd.show.crossed import ARRIVED, FAILED, Crossed, Rate, draw_crossing
from qd.show.figures import label_of, look_of, mode_words
from qd.show.report.material import Shown
from qd.show.report.page import Block, Cards, Folded, Picture, absent, counted, paragraph, percent, picture, table
from qd.show.report.pictures import rendered
from sim.files.command import command_line
from sim.files.figures import new_figure
from sim.files.intervals import wilson_interval
from sim.files.records import without_machine

_MIN_PICTURED = 3  # terrains that the page begins with
_METHOD = (
    "Ward's clustering on the shares and on the rates of goal, base collision and fall, all fractions and unweighted; "
    f"of 2 to {MAX_MODES} groups the most whose mean silhouette (1: apart, 0: touching) is {TOLERANCE} or less below "
    "the best"
)


def anchor_of(number: int) -> str:
    """Where an elite is shown in detail."""
    return f"elite-{number}"


def failures(shown: Shown) -> list[Block]:
    """A picture of the worst terrain of each failure mode, and where these are few of some that are unlike them."""
    elites, leaders = shown.elites, shown.ranking.leaders()
    failing = [number for number in shown.worst if elites.failing[elites.place_of(number)]]
    chosen = list(dict.fromkeys([*leaders, *failing]))[: max(_MIN_PICTURED, len(leaders))]
    if not chosen:
        return [paragraph("No elite fails: there is no failure mode to show.")]
    labels = dict(zip(elites.numbers.tolist(), shown.modes.labels.tolist(), strict=True))
    chosen.sort(key=lambda number: (number not in leaders, labels[number]))
    cards, reason = [], shown.not_crossed
    for number in chosen:
        drawn, missing = _pictured(shown, number)
        reason = reason or missing
        cards.append((drawn, *_card_words(shown, number, more=number not in leaders), anchor_of(number)))
    text = (
        "The worst terrain of each failure mode, where the middle one of the robots that end as most do has ended; "
        f"lines are the ways of all {shown.episodes}."
    )
    if reason:
        text = f"The worst terrain of each failure mode from above. Where robots end on them is not shown. {reason}"
    return [Cards(cards), paragraph(text)]


def _pictured(shown: Shown, number: int) -> tuple[Picture, str]:
    """A terrain with the robots on it if that can be had, else from above, and then why."""
    material, crossed = shown.material, shown.crossed.get(number)
    if crossed is not None and len(crossed.chosen):
        scales = dict(zip(material.archive.penalties, material.archive.scales, strict=True))
        shows = f"Elite {number} with the ways of {len(crossed.chosen)} robots"
        try:
            return Picture(f"failing-{number}.jpg", rendered(crossed, material.robot, scales), shows), ""
        except ValueError as error:
            return _relief(shown, number), str(error)
    return _relief(shown, number), ""


def _relief(shown: Shown, number: int) -> Picture:
    content = shown.reliefs[shown.elites.place_of(number)]
    return Picture(f"failing-{number}.jpg", content, f"Elite {number} from above, start left, goal right")


def _card_words(shown: Shown, number: int, *, more: bool) -> tuple[str, str]:
    """What stands below the picture of a failing terrain."""
    elites, place = shown.elites, shown.elites.place_of(number)
    mode = shown.ranking.mode_of(place)
    assert mode is not None  # it fails
    if more:
        title, about = f"Mode {mode.number} too, another family", ""
    else:
        share = percent(mode.goal_rate)
        title = f"Mode {mode.number}: {mode_words(mode)}"
        about = f"{counted(len(mode.members), 'elite')} of {len(elites):,}; {share} of their robots reach the goal. "
    crossed = shown.crossed.get(number)
    if crossed is None or not len(crossed.chosen):
        rate: object = Rate(elites.hits("goal_rate", place), int(elites.counted[place]))
        ends = ""
    else:
        rate = crossed.rates[ARRIVED]
        ends = "".join(f"; {label} {crossed.rates[label].hits}" for label in FAILED if crossed.rates[label].hits)
    return title, f"{about}Elite {number}, {VERDICTS[int(elites.verdict[place])]}: goal reached {rate}{ends}."


def modes_section(shown: Shown) -> list[Block]:
    """The groups of failing elites."""
    modes, elites = shown.modes, shown.elites
    failing = int(elites.failing.sum())
    if not modes.modes:
        return [paragraph("No elite fails, so there is no failure mode.")]
    count, silhouettes = len(modes.modes), modes.silhouettes
    parting = f"; {count} have {silhouettes[count]:.2f}" if silhouettes else "; these are too few or too equal"
    text = (
        f"The {counted(failing, 'failing elite')} of {len(elites):,} fall into "
        f"{counted(count, 'failure mode')} by how the robot struggles and how its crossings end: "
        f"{_METHOD}{parting}."
    )
    shows = "Mean shares of the penalties and of the ends of crossings by group"
    return [paragraph(text), picture("modes", draw_modes(elites, modes), shows), _modes_table(shown)]


def _modes_table(shown: Shown) -> str:
    head = ["mode", "elites", "of failing", "goal", "base collision", "neither", "fallen", "fitness",
            "share that stands out", "typical elite"]  # fmt: skip
    failing = int(shown.elites.failing.sum())
    rows = [
        [
            f"{mode.number}: {mode.ending}",
            f"{len(mode.members):,}",
            percent(len(mode.members) / failing),
            *(percent(rate) for rate in (mode.goal_rate, mode.collision_rate, mode.other_rate, mode.fallen_rate)),
            f"{mode.fitness:.1f}",
            label_of(mode.marked_by),
            f"{mode.typical}",
        ]
        for mode in shown.modes.modes
    ]
    typical = [mode.typical for mode in shown.modes.modes]
    links = [anchor_of(number) if number in shown.crossed else "" for number in typical]
    return table(head, rows, links=links, opens=_opened(shown, typical))


def _opened(shown: Shown, numbers: Sequence[int]) -> list[Picture]:
    """What the rows of some elites open: their terrains from above."""
    words = "from above, start yellow and goal green; blue is below the start's level, brown above."
    contents = [shown.reliefs[shown.elites.place_of(number)] for number in numbers]
    return [
        Picture(f"elite-{number}.jpg", content, f"Elite {number} {words}")
        for number, content in zip(numbers, contents, strict=True)
    ]


def detail_section(shown: Shown) -> list[Block]:
    """The worst and the most reproducible elites, each with figure and numbers."""
    if shown.not_crossed:
        return [absent(shown.not_crossed)]
    stubborn = sum(shown.crossed[number].rates[ARRIVED].hits == 0 for number in shown.worst)
    text = (
        "Shown are the terrains on which the controller fails most, one of each way of failing first, no two alike "
        f"while there are others ({', '.join(map(str, shown.worst))}), and those whose penalties vary least between "
        f"episodes for their size, failed ones first ({', '.join(map(str, shown.steady))}). Each was crossed "
        f"{shown.episodes} times "
        "afresh for this page, by the episodes that `faultline replay --elite N` shows; on "
        f"{stubborn} of the first {len(shown.worst)} no robot reached the goal. Scaled penalties: 1 is what a common "
        "one comes to on hard-random terrain."
    )
    first = shown.numbers[0]
    return [paragraph(text), *(_elite(shown, number, opened=number == first) for number in shown.numbers)]


def _elite(shown: Shown, number: int, *, opened: bool) -> Folded:
    """One elite: why it is shown, what became of it, figure and numbers."""
    crossed, archive = shown.crossed[number], shown.material.archive
    place = shown.elites.place_of(number)
    mode, verdict = shown.ranking.mode_of(place), VERDICTS[int(shown.elites.verdict[place])]
    ranked = (("worst" if verdict else "hard", shown.worst), ("most reproducible", shown.steady))
    roles = [f"{what}, rank {numbers.index(number) + 1}" for what, numbers in ranked if number in numbers]
    about = [verdict or "not failing", *([f"mode {mode.number}: {mode_words(mode)}"] if mode else [])]
    words = f"Elite {number}: goal reached {crossed.rates[ARRIVED]}; {'; '.join([*about, *roles])}"
    if not len(crossed.chosen):
        return Folded(words, [absent("All its episodes were invalid this time: there is nothing to draw.")])
    title = f"{archive.robot}, elite {number} of {len(archive):,}: {len(crossed.chosen)} crossings"
    drawn = picture(
        f"elite-{number}", draw_crossing(crossed, archive.penalties, title),
        f"Height map of elite {number} with the paths of {len(crossed.chosen)} robots, profile, and penalties",
    )  # fmt: skip
    blocks = [
        paragraph(" ".join([_what_happened(shown, crossed, place), *elite_words(archive, number)])),
        drawn,
        paragraph(f"Its terrain: {'; '.join(shown.material.space.describe(archive.genes[number]).splitlines())}."),
        _penalty_table(shown, crossed),
        _rate_table(crossed),
    ]
    return Folded(words, blocks, anchor_of(number), opened)


def _what_happened(shown: Shown, crossed: Crossed, place: int) -> str:
    """Where the robots ended, and what the elite costs."""
    elites, fresh = shown.elites, bool(shown.elites.fresh[place])
    episodes = counted(int(elites.counted[place]), "fresh episode" if fresh else "episode") + " of the search" * (
        not fresh
    )
    ended = "All reached the goal."
    if crossed.failed_at is not None:
        ended = f"The middle one of those that did not reach the goal ended at x = {crossed.failed_at:.1f} m."
    return (
        f"{ended} Its fitness is {elites.fitness[place]:.1f} by {episodes}, whose penalties have a standard "
        f"deviation of {percent(float(elites.variation[place]))} of their mean."
    )


def _penalty_table(shown: Shown, crossed: Crossed) -> str:
    names, scaled = shown.material.archive.penalties, crossed.scaled
    total = max(float(scaled.mean(axis=0).sum()), 1e-12)
    rows = [
        [
            label_of(name) + (f" [{look_of(name).unit}]" if look_of(name).unit else ""),
            f"{raw.mean():.2f}",
            f"{raw.std():.2f}",
            f"{multiple.mean():.2f}",
            f"{multiple.std():.2f}",
            percent(float(multiple.mean()) / total),
        ]
        for name, raw, multiple in zip(names, crossed.penalties.T, scaled.T, strict=True)
    ]
    return table(["penalty an episode", "mean", "std", "mean, scaled", "std, scaled", "share"], rows)


def _rate_table(crossed: Crossed) -> str:
    rows = [
        [label, f"{rate.hits} of {rate.count}", f"{100 * rate.hits / rate.count:.0f} %", rate.limits]
        for label, rate in crossed.rates.items()
    ]
    return table(["crossings", "", "rate", "95 % interval (Wilson)"], rows)


def all_section(shown: Shown) -> list[Block]:
    """Every elite in a table that can be sorted."""
    elites, archive, families = shown.elites, shown.material.archive, shown.ranking.families
    head = ["elite", "goal [%]", "95 % interval", "judged", "base collision [%]", "fallen [%]", "mode", "family",
            "fitness", "std / mean", "iteration", *(f"{label_of(name)} [%]" for name in elites.penalties)]  # fmt: skip
    rows, keys = [], []
    order = elites.by_severity()
    for k, number in zip(order.tolist(), elites.numbers[order].tolist(), strict=True):
        rate = Rate(elites.hits("goal_rate", k), int(elites.counted[k]))
        rates = [float(values[k]) for values in (elites.goal_rate, elites.collision_rate, elites.fallen_rate)]
        goal, collision, fallen = (f"{100 * value:.0f}" for value in rates)
        mode, family, iteration = int(shown.modes.labels[k]), int(families[k]), int(archive.iteration[number])
        judged = int(elites.verdict[k])
        shares, fitness, variation = elites.ratios[k].tolist(), elites.fitness[k], elites.variation[k]
        rows.append(
            [f"{number}", goal, rate.limits, VERDICTS[judged], collision, fallen, f"{mode or '-'}", f"{family}",
             f"{fitness:.2f}", f"{variation:.2f}", f"{iteration}", *(f"{100 * share:.0f}" for share in shares)]
        )  # fmt: skip
        low = wilson_interval(*rate)[0]
        values = [number, rates[0], low, judged, *rates[1:], mode, family, fitness, variation, iteration, *shares]
        keys.append([f"{value:.5g}" for value in values])
    numbers = elites.numbers[order].tolist()
    links = [anchor_of(number) if number in shown.crossed else "" for number in numbers]
    again = without_machine(command_line("replay", robot=shown.material.robot.spec, run=shown.material.run, elite="N"))
    folded = f"Show {counted(len(rows), 'elite')}"
    listed = table(head, rows, keys=keys, links=links, opens=_opened(shown, numbers), folded=folded)
    text = (
        f"All {counted(len(rows), 'elite')}, faults first, then what fails most. A click on a heading sorts, one on a "
        f"row opens a picture of the terrain, one on a number what is told of it above. Terrains of one family look "
        f"alike. `{again}` crosses one again."
    )
    return [paragraph(text), listed]


_ENDS = (("goal_rate", "goal", "#009e73", "o"), ("collision_rate", "base collision", "#d55e00", "X"),
         ("other_rate", "stuck, late or off", "#0072b2", "s"))  # fmt: skip


def draw_modes(elites: Elites, modes: Modes) -> Figure:
    """The failure modes: their mean shares, and how their crossings end."""
    figure = new_figure(10.0, max(3.4, 0.5 * len(modes.modes) + 2.2))
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.2))
    places = np.arange(len(modes.modes))
    start = np.zeros(len(places))
    for column, penalty in enumerate(elites.penalties):
        shares = 100.0 * np.array([mode.ratios[column] for mode in modes.modes])
        left.barh(places, shares, left=start, label=label_of(penalty), **look_of(penalty).bar)
        start += shares
    for shift, (name, label, colour, marker) in zip((-0.22, 0.0, 0.22), _ENDS, strict=True):
        rates = [100.0 * getattr(mode, name) for mode in modes.modes]
        right.plot(
            rates, places + shift, linestyle="", marker=marker, markersize=8, color=colour, label=label, alpha=0.9
        )
    names = [f"mode {mode.number}: {mode.ending}\n{len(mode.members):,} elites" for mode in modes.modes]
    left.set_yticks(places, names)
    right.set_yticks(places, [])
    for axes, label in ((left, "mean share of the penalties [%]"), (right, "mean share of the crossings [%]")):
        axes.set_ylim(len(places) - 0.5, -0.5)
        axes.set_xlabel(label)
        axes.grid(axis="x", alpha=0.3)
        axes.set_axisbelow(True)
        for place in places[1:]:
            axes.axhline(place - 0.5, color="0.85", linewidth=0.8, zorder=0)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2 if axes is left else 1, frameon=False,
                    fontsize=9)  # fmt: skip
    left.set_xlim(0, 100)
    right.set_xlim(-3, 103)
    return figure
