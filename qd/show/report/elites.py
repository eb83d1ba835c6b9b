"""The page's chapters about elites: the failure modes, the worst and the steadiest one by one, and all in a table."""

from qd.elites import Elites
from qd.faults import VERDICTS, elite_words
from qd.modes import MAX_MODES, TOLERANCE, Mode
from qd.show.crossed import ARRIVED, FAILED, Crossed, Rate
from qd.show.crossing_figures import draw_crossing, draw_maps
from qd.show.figures import label_of, look_of
from qd.show.report.figures import draw_modes
from qd.show.report.material import Shown
from qd.show.report.page import Block, absent, counted, heading, paragraph, percent, picture, table
from sim.files.command import plain_command
from sim.files.intervals import wilson_interval


def anchor_of(number: int) -> str:
    """Where an elite is shown in detail."""
    return f"elite-{number}"


def modes_section(shown: Shown) -> list[Block]:
    """The groups of elites, each with a typical terrain."""
    modes, elites = shown.modes, shown.elites
    largest = max(modes.modes, key=lambda mode: len(mode.members))
    text = (
        f"The {counted(len(elites), 'elite')} fall into {counted(len(modes.modes), 'mode')} by how the robot "
        f"struggles and how its crossings end. The largest, mode {largest.number}, has {len(largest.members):,} "
        f"({percent(len(largest.members) / len(elites))}): {_described(largest)}. "
        f"{counted(sum(mode.failing for mode in modes.modes), 'mode is a failure mode', 'modes are failure modes')}: "
        "under half of their robots reach the goal."
    )
    shows = "Mean shares of the penalties and of the ends of crossings by group; silhouette by number of groups"
    drawn = picture("modes", draw_modes(elites, modes), shows)
    blocks = [paragraph(text), paragraph(_how(shown)), drawn, _modes_table(shown)]
    typical = {
        f"mode {mode.number}: elite {mode.typical}, {mode.ending}": shown.crossed[mode.typical]
        for mode in modes.modes
        if mode.typical in shown.crossed
    }
    if not typical:
        return blocks
    arrived = [shown.crossed[mode.typical].rates[ARRIVED] for mode in modes.modes]
    reached = "; ".join(f"mode {mode.number}: {rate}" for mode, rate in zip(modes.modes, arrived, strict=True))
    text = (
        "A typical terrain of each, the elite nearest to all others of its mode, crossed again. Robots that reached "
        f"the goal, with 95 % intervals: {reached}."
    )
    maps = draw_maps(typical, f"{shown.material.archive.robot}: a typical terrain of each mode")
    shows = "Height map of a typical terrain of each mode with the robots' paths"
    return [*blocks, paragraph(text), picture("modes-terrains", maps, shows)]


def _described(mode: Mode) -> str:
    return (
        f"the robot {mode.deed} (goal {percent(mode.goal_rate)}, base collision "
        f"{percent(mode.collision_rate)}, neither {percent(mode.other_rate)}), and the share that stands out is that "
        f"of {label_of(mode.marked_by)}"
    )


def _how(shown: Shown) -> str:
    """How the groups were made."""
    how = (
        "Ward's clustering on the shares and on the rates of goal, base collision and fall, all fractions and "
        f"unweighted; of 2 to {MAX_MODES} groups the most whose mean silhouette is within {TOLERANCE} of the best"
    )
    found = shown.modes.silhouettes
    if not found:
        return f"{how}. These elites are too few or too equal to be divided."
    best = max(found, key=lambda count: found[count])
    taken = len(shown.modes.modes)
    return (
        f"{how}: {taken} have {found[taken]:.2f}, the best, {best}, {found[best]:.2f} (1: apart, 0: touching; under "
        "one half the borders between them are soft)."
    )


def _modes_table(shown: Shown) -> str:
    head = ["mode", "elites", "of all", "goal", "base collision", "neither", "fallen", "fitness",
            "share that stands out", "typical elite"]  # fmt: skip
    rows = [
        [
            f"{mode.number}: {mode.ending}",
            f"{len(mode.members):,}",
            percent(len(mode.members) / len(shown.elites)),
            *(percent(rate) for rate in (mode.goal_rate, mode.collision_rate, mode.other_rate, mode.fallen_rate)),
            f"{mode.fitness:.1f}",
            label_of(mode.marked_by),
            f"{mode.typical}",
        ]
        for mode in shown.modes.modes
    ]
    links = [anchor_of(mode.typical) if mode.typical in shown.crossed else "" for mode in shown.modes.modes]
    return table(head, rows, links=links)


def detail_section(shown: Shown) -> list[Block]:
    """The worst, the most reproducible and the typical elites, each with figure and numbers."""
    if shown.not_crossed:
        return [absent(shown.not_crossed)]
    stubborn = sum(shown.crossed[number].rates[ARRIVED].hits == 0 for number in shown.worst)
    text = (
        f"{choice_told(shown.elites, shown.worst, shown.steady)} Each was crossed {shown.material.cfg.episodes} times "
        "afresh for this page, by the episodes that `faultline replay --elite N` shows; on "
        f"{stubborn} of the first {len(shown.worst)} no robot reached the goal. Scaled penalties: 1 is what a common "
        "one comes to on hard-random terrain."
    )
    return [paragraph(text), *(block for number in shown.numbers for block in _elite(shown, number))]


def choice_told(elites: Elites, worst: list[int], steady: list[int]) -> str:
    """Which elites are shown, in a sentence that holds for any number of them.

    Args:
        elites: All elites.
        worst: Numbers of the worst ones, and of others after them if too few fail.
        steady: Numbers of those that vary least.
    """
    fails = {number: bool(elites.failing[elites.place_of(number)]) for number in worst}
    failed, others = ([number for number in worst if fails[number] is kind] for kind in (True, False))
    parts = []
    if failed:
        parts.append(
            f"terrains on which the controller fails, one of each way of failing first, no two alike while there are "
            f"others ({_list(failed)})"
        )
    if others:
        parts.append(f"{'other ' * bool(failed)}terrains on which it does not fail ({_list(others)})")
    parts.append(
        f"terrains whose penalties vary least between episodes for their size, failed ones first ({_list(steady)})"
    )
    return f"Shown are {'; '.join(parts)}; and a typical terrain of each mode."


def _list(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))


def _elite(shown: Shown, number: int) -> list[Block]:
    """One elite: why it is shown, what became of it, figure and numbers."""
    crossed, archive = shown.crossed[number], shown.material.archive
    place = shown.elites.place_of(number)
    failed = shown.elites.failing[place]
    ranked = (("worst failed" if failed else "hard", shown.worst), ("most reproducible", shown.steady))
    roles = [f"{what}, rank {numbers.index(number) + 1}" for what, numbers in ranked if number in numbers]
    roles += [f"typical of mode {mode.number}" for mode in shown.modes.modes if mode.typical == number]
    headed = heading(f"Elite {number}: {'; '.join(roles)}", anchor_of(number))
    if not len(crossed.chosen):
        return [headed, absent("All its episodes were invalid this time: there is nothing to draw.")]
    title = f"{archive.robot}, elite {number} of {len(archive):,}: {len(crossed.chosen)} crossings"
    drawn = picture(
        f"elite-{number}", draw_crossing(crossed, archive.penalties, title),
        f"Height map of elite {number} with the paths of {len(crossed.chosen)} robots, profile, and penalties",
    )  # fmt: skip
    return [
        headed,
        paragraph(" ".join([_told(shown, crossed, place), *elite_words(archive, number)])),
        paragraph(f"Its terrain: {'; '.join(shown.material.space.describe(archive.genes[number]).splitlines())}."),
        drawn,
        _penalty_table(shown, crossed),
        _rate_table(crossed),
    ]


def _told(shown: Shown, crossed: Crossed, place: int) -> str:
    """What became of the robots, in a sentence or two."""
    elites = shown.elites
    arrived = crossed.rates[ARRIVED]
    failures = {label: crossed.rates[label].hits for label in FAILED}
    others = "; ".join(f"{label} {hits}" for label, hits in failures.items() if hits)
    text = f"{arrived.hits} of {arrived.count} robots reached the goal"
    if others:
        text += f" ({others}), and the middle one of those that did not ended at x = {crossed.failed_at:.1f} m"
    means = crossed.scaled.mean(axis=0)
    main = int(means.argmax())
    count = int(elites.counted[place])
    episodes = f"fresh episode{'s' * (count != 1)}"
    if not elites.fresh[place]:
        episodes = f"episode{'s' * (count != 1)} of the search"
    return (
        f"{text}. The largest penalty is {label_of(elites.penalties[main])}, "
        f"{percent(float(means[main] / max(means.sum(), 1e-12)))} of all. Its fitness is {elites.fitness[place]:.1f} "
        f"by {count:,} {episodes}, whose penalties have a standard deviation of "
        f"{percent(float(elites.variation[place]))} of their mean."
    )


def _penalty_table(shown: Shown, crossed: Crossed) -> str:
    names, scaled = shown.material.archive.penalties, crossed.scaled
    total = max(float(scaled.mean(axis=0).sum()), 1e-12)
    rows = [
        [
            label_of(name) + (f" [{look_of(name).unit}]" if look_of(name).unit else ""),
            f"{raw.mean():.2f}",
            f"{raw.std():.2f}",
            f"{own.mean():.2f}",
            f"{own.std():.2f}",
            percent(float(own.mean()) / total),
        ]
        for name, raw, own in zip(names, crossed.penalties.T, scaled.T, strict=True)
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
        mode, family, found = int(shown.modes.labels[k]), int(families[k]), int(archive.iteration[number])
        judged = int(elites.verdict[k])
        shares, fitness, variation = elites.ratios[k].tolist(), elites.fitness[k], elites.variation[k]
        rows.append(
            [f"{number}", goal, rate.limits, VERDICTS[judged], collision, fallen, f"{mode}", f"{family}",
             f"{fitness:.2f}", f"{variation:.2f}", f"{found}", *(f"{100 * share:.0f}" for share in shares)]
        )  # fmt: skip
        low = wilson_interval(*rate)[0]
        values = [number, rates[0], low, judged, *rates[1:], mode, family, fitness, variation, found, *shares]
        keys.append([f"{value:.5g}" for value in values])
    links = [anchor_of(number) if number in shown.crossed else "" for number in elites.numbers[order].tolist()]
    again = plain_command("replay", robot=shown.material.robot.spec, run=shown.material.run, elite="N")
    listed = table(head, rows, keys=keys, links=links, folded=f"Show {counted(len(rows), 'elite')}")
    text = (
        f"All {counted(len(rows), 'elite')}, faults first, then what fails most; a click on a heading sorts. Terrains "
        f"of one family look alike. `{again}` crosses one again."
    )
    return [paragraph(text), listed]
