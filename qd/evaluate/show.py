"""What evaluations show: rates and tables on the terminal, tables as a figure, the paper's numbers beside ours."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.measures import invalid_lines
from qd.evaluate.pack_rates import fails
from qd.evaluate.publish import resolved_cells, role_words
from sim.files.command import command_line
from sim.files.figures import as_png, bar_lengths, new_figure
from sim.files.intervals import value_words
from sim.maps.picture import draw_heights
from sim.policy.spec import firsts, kind_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FORMS = {"goal": ".3f", "success": ".3f", "fallen": ".3f", "reward": ".1f"}
_WORDS = {
    "goal": "goal",
    "success": "no base collision",
    "fallen": "fallen",
    "reward": "reward",
    "certified_goal": "goal on certified terrains",
    "certified_success": "no base collision on certified terrains",
}
"""Measures in words: no base collision is what the paper calls success."""
SET_LABELS = {
    "hand_crafted": "hand-crafted",
    "hard_random": "hard-random",
    "generated": "generated,\nheld out",
    "generated_far": "generated,\nfarthest third",
    "generated_independent": "generated,\nindependent",
}
"""Sets as axis labels."""

_PANELS = {
    "goal": ("goal reached\n[% of episodes]", 100.0),
    "success": ("no base collision\n[% of episodes]", 100.0),
    "reward": ("training reward\n[sum over 20 s]", 1.0),
}
# Okabe and Ito's colours, apart for every kind of colour blindness; markers tell them apart in grey too.
COLOURS = ("#000000", "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
MARKERS = ("o", "s", "^", "v", "P", "X", "<", ">", "p")
_CHANGES = {"mended": "#0072b2", "still_failing": "#bbbbbb", "newly_broken": "#d55e00"}
_GALLERY, _GALLERY_COLUMNS = 12, 3  # terrains of a pack that are drawn
_RESOLVED = {"resolved": "contact resolved", "mujoco_c": "MuJoCo C, contact resolved"}
_PAPER_LABEL = "of that name in the paper"


def print_rates(report: dict[str, Any]) -> None:
    """Prints the rates of one controller, as ``base.json`` has them."""
    print(f"{'':<24}{'goal':>24}{_WORDS['success']:>24}{'fallen':>8}{'terrains':>10}")
    for name in ("hand_crafted", "hard_random"):
        rows = {name: report[name]}
        for group in ("by_type", "by_level"):
            prefix = "level " if group == "by_level" else ""
            rows |= {f"  {prefix}{key}": value for key, value in (report[name][group] or {}).items()}
        for label, row in rows.items():
            goal, success = (value_words(row[f"{key}_rate"], row.get(f"{key}_interval")) for key in ("goal", "success"))
            fallen = value_words(row["fallen_rate"], None)
            print(f"{label:<24}{goal:>24}{success:>24}{fallen:>8}{row['terrains']:>10}")
    error = value_words(report["flat"]["vx_error_mean"], None)
    print(f"flat ground: v_x is off its command by {error} m/s (root mean square)")
    for line in invalid_lines({name: report[name]["outcomes"] for name in ("hand_crafted", "hard_random")}):
        print(line)


def published_value(report: dict[str, Any], measure: str, name: str, who: str) -> float | None:
    """The paper's number of a measure, a set and a controller's name; None where it has none."""
    return ((report["paper"] or {}).get(measure, {}).get(name) or {}).get(who)


def print_tables(report: dict[str, Any]) -> None:
    """Prints ``tables.json``: every set with every controller, what became of terrains, and what nobody crossed."""
    if report.get("part") == "validation":
        print("\nValidation terrains, to choose settings by. Rates to report are those of --part test.")
    names = (label for name, row in report["success"].items() for label in (name, *row))
    wide = 2 + max(12, *map(len, names))
    for name in report["success"]:
        _print_set(report, name, wide)
    _print_certified(report, wide)
    if report["paper"] is not None:
        print("paper: its success rate, which is no base collision, and reward, where it has a controller of that name")
    _print_over_seeds(report["over_seeds"])
    _print_penalties(report, wide)
    _print_differences(report)
    for name, groups in report["traversable"].items():
        _print_traversable(name, groups, wide)
    for key, how in _RESOLVED.items():
        _print_resolved(report.get(key) or {}, how, wide)
    ended = {f"{who} on {name}": counts for name, row in report["outcomes"].items() for who, counts in row.items()}
    for line in invalid_lines(ended):
        print(line)


def _print_set(report: dict[str, Any], name: str, wide: int) -> None:
    print(f"\n{name}: {report['terrains'][name]} terrains x {report['episodes']} episodes")
    print(_row("", (*map(_WORDS.__getitem__, _FORMS), "paper"), wide, 24))
    for who in report["success"][name]:
        cells = [
            value_words(report[measure][name][who], report["intervals"][measure][name][who], form)
            for measure, form in _FORMS.items()
        ]
        paper = [published_value(report, measure, name, who) for measure in ("success", "reward")]
        cells.append("" if None in paper else "{:.3f}, {:.1f}".format(*paper))
        print(_row(who, cells, wide, 24))


def _print_certified(report: dict[str, Any], wide: int) -> None:
    """Certified terrains alone, with who certifies them."""
    for name, about in report["certified"].items():
        by = ", ".join(f"{who} {count}" for who, count in about["certifiers"].items())
        print(
            f"\n{name}: certified {about['terrains']} of {report['terrains'][name]} terrains, which the search's "
            f"controller fails and another one crosses ({by})"
        )
        if about["terrains"]:
            print(_row("", (_WORDS["goal"], _WORDS["success"]), wide + 12, 24))
            for who in report["certified_goal"][name]:
                cells = [
                    value_words(report[key][name][who], report["intervals"][key][name][who])
                    for key in ("certified_goal", "certified_success")
                ]
                print(_row(who + role_words(about, who), cells, wide + 12, 24))
    roles = {role for about in report["certified"].values() for role in about["chosen_by"].values()}
    if roles:
        print("They were chosen by what these controllers did there in other episodes, so their rates are biased:")
        print("; ".join(f"{role}: {_BIASED[role]}" for role in _BIASED if role in roles))


_BIASED = {"searched": "downward, since it failed them all", "certifier": "upward, since it crossed some of them"}


def _print_resolved(rows: dict[str, Any], how: str, wide: int) -> None:
    """Rates of other crossings of the same terrains, and the bias of those above."""
    if rows:
        print(f"\n{how}: rates, and how far those at the search's settings lie above them (bias)")
    for name, row in rows.items():
        print(_row(name, (_WORDS["goal"], "bias", _WORDS["success"], "bias", "terrains"), wide, 26))
        for who, found in row.items():
            print(_row(f"  {who}", (*resolved_cells(found), str(found["terrains"])), wide, 26))


def _row(label: str, cells: Iterable[str], wide: int, each: int) -> str:
    return f"{label:<{wide}}" + "".join(f"{cell:>{each}}" for cell in cells)


def _print_penalties(report: dict[str, Any], wide: int) -> None:
    rows = report["penalties"]
    names = list(next(iter(next(iter(rows.values())).values())))
    print("\nscaled penalties: 1 is the mean of crossings of hard-random terrain that the shipped controller fails")
    for name, row in rows.items():
        print(_row(name, names, wide, 15))
        for who, values in row.items():
            cells = (value_words(values[key], None, ".2f") for key in names)
            print(_row(f"  {who}", cells, wide, 15))


def _print_differences(report: dict[str, Any]) -> None:
    if not any(report["differences"].values()):
        return
    print(
        "\nTerrains on which under half of the episodes reach the goal: with the first controller and not the second\n"
        "(mended), with both (still failing), with the second alone (newly broken); in brackets those beyond chance."
    )
    for name, pairs in report["differences"].items():
        print(name)
        for pair, found in pairs.items():
            mended, broken = found["mended"], found["newly_broken"]
            gain = value_words(found["gain"]["goal"]["mean"], found["gain"]["goal"]["interval"], "+.3f")
            print(
                f"  {pair}: {mended['count']} mended ({mended['clear']}), {found['still_failing']['count']} still "
                f"failing, {broken['count']} newly broken ({broken['clear']}) of {found['compared']}; goal rate {gain}"
            )


def _print_traversable(name: str, groups: dict[str, Any], wide: int) -> None:
    for key, label in (("crossed", "that some controller crossed"), ("never_crossed", "that none ever crossed")):
        group = groups[key]
        print(f"\n{name}: {group['count']} terrains {label}")
        if group["count"]:
            print(_row("", map(_WORDS.__getitem__, _FORMS), wide, 18))
            for who in group["success"]:
                cells = (value_words(group[measure][who], None, form) for measure, form in _FORMS.items())
                print(_row(who, cells, wide, 18))


def _print_over_seeds(found: dict[str, Any]) -> None:
    """Means over the controllers of a kind; nothing where no kind has several."""
    if not found:
        return
    print("\nmean over the controllers of a kind, and its 95 % t interval over them")
    for name in next(iter(found.values())):
        for kind in found[next(iter(found))][name]:
            each = {measure: rows[name][kind] for measure, rows in found.items() if name in rows}
            words = (
                f"{_WORDS.get(measure, measure)} {value_words(one['mean'], one['interval'])}"
                for measure, one in each.items()
            )
            print(f"  {name}, {kind}: " + ", ".join(words))


def print_pack(report: dict[str, Any]) -> None:
    """Prints the rates of a pack's controllers, as ``pack.json`` has them."""
    count = Counter(about["verdict"] for about in report["terrains"])
    words = (f"{many} {what}{'s' * (many != 1)}" for what, many in count.items())
    print(f"{len(report['terrains'])} terrains: {', '.join(words)}")
    _print_rates_of(report["rates"])


def print_pack_test(report: dict[str, Any], folder: Path) -> None:
    """Prints what of a pack a controller fails, beside the pack's controllers.

    Args:
        report: As the result file has it.
        folder: Of the pack.
    """
    rows = {"this": report["rates"], **report["beside"]}
    _print_rates_of(rows)
    if report["seed"] != report["pack"]["seed"] or report["episodes"] != report["pack"]["episodes"]:
        print("Episodes differ from those of the pack's controllers in number or start.")
    names = {one["mode"]: f"{one['mode']}: {one['ending']}, {one['marked_by']}" for one in report["pack"]["modes"]}
    wide = max(map(len, rows))
    for group, title in (("verdict", "verdict"), ("mode", "failure mode"), ("cause", "cause"), ("kind", "kind")):
        print(f"by {title:<61}{'terrains':>9}  failed by {'  '.join(f'{who:>{wide}}' for who in rows)}")
        for one in report["by"][group]:
            value = names.get(one[group], one[group]) if group == "mode" else one[group] or "not looked for"
            cells = "  ".join(f"{one['failing'][who]:>{wide}}" for who in rows)
            print(f"  {value:<62}{one['terrains']:>9}            {cells}")
    own = report["rates"]
    print(f"It fails {own['failing']} of {own['terrains']} terrains, of {own['failing_families']} families.")
    worst = worst_of(report["terrains"], "this")[:10]
    for place in (place for place in worst if fails(report["terrains"][place]["rates"]["this"])):
        about, row = report["terrains"][place], report["terrains"][place]["rates"]["this"]
        rate = value_words(row["goal_rate"], row["goal_interval"], ".0%")
        print(f"  {place:>3} {about['name']:<22}{rate:<22}family {about['family']:<5}{about['cause'] or ''}")
    print(f"As files:  {command_line('export', pack=folder, elite='all')}")


def _print_rates_of(rows: Mapping[str, dict[str, Any]]) -> None:
    wide = max(12, *(len(who) + 2 for who in rows))
    print(f"{'':<{wide}}{'goal':>24}{_WORDS['success']:>24}{'fallen':>24}{'failed':>8}{'of':>5}")
    for who, row in rows.items():
        rates = (value_words(row[f"{name}_rate"], row[f"{name}_interval"]) for name in ("goal", "success", "fallen"))
        print(f"{who:<{wide}}{''.join(f'{words:>24}' for words in rates)}{row['failing']:>8}{row['terrains']:>5}")


def worst_of(terrains: Sequence[dict[str, Any]], who: str) -> list[int]:
    """Places of the valid terrains of a pack, those with the lowest goal rate first, one of each family before two."""
    valid = [place for place, about in enumerate(terrains) if about["rates"][who]["goal_rate"] is not None]
    seen, turns = Counter[int](), dict[int, int]()
    for place in sorted(valid, key=lambda place: (terrains[place]["rates"][who]["goal_rate"], place)):
        turns[place] = seen[terrains[place]["family"]]
        seen[terrains[place]["family"]] += 1
    failing = {place: fails(terrains[place]["rates"][who]) for place in valid}
    return sorted(
        valid, key=lambda place: (not failing[place], turns[place], terrains[place]["rates"][who]["goal_rate"], place)
    )


def picture_of_pack(terrains: Sequence[dict[str, Any]], heights: NDArray[np.float32], who: str, title: str) -> bytes:
    """Terrains of a pack that a controller fails, as PNG; where it fails fewer, others with the lowest goal rates.

    Args:
        terrains: What is known of each.
        heights: [m], shape (at least as many, nrow, ncol).
        who: The controller, by its name among the rates.
        title: What the controller is called.
    """
    shown = worst_of(terrains, who)[:_GALLERY]
    failing = sum(fails(about["rates"][who]) for about in terrains)
    rows = max(1, -(-len(shown) // _GALLERY_COLUMNS))
    figure = new_figure(13.0, 0.9 + 2.3 * rows)
    figure.suptitle(f"{title}: fails {failing} of {len(terrains)} terrains of the pack; those with the fewest arrivals")
    panels = [figure.add_subplot(rows, _GALLERY_COLUMNS, place + 1) for place in range(len(shown))]
    grounds = [heights[place] for place in shown]
    limits = (min(map(np.min, grounds)), max(map(np.max, grounds))) if grounds else None
    image = None
    for axes, place in zip(panels, shown, strict=True):
        about = terrains[place]
        image = draw_heights(axes, heights[place], limits)
        words = ", ".join(
            filter(None, [about["verdict"], about["cause"], f"{about['rates'][who]['goal_rate']:.0%} arrive"])
        )
        axes.set_title(f"{place}: {about['name']}: {words}", fontsize=9)
    if image is not None:
        figure.colorbar(image, ax=panels, label="height [m]", shrink=0.8, pad=0.01)
    return as_png(figure)


def picture_of(report: dict[str, Any]) -> bytes:
    """The tables, as ``tables.json`` has them, as PNG."""
    return as_png(draw_tables(report))


def draw_tables(report: dict[str, Any]) -> "Figure":
    """Goal rate, no base collision and reward of controllers by set, with intervals, and what became of terrains.

    Where there are such: the goal rate on certified terrains, and how far contact resolved is from it all.
    """
    pairs = _pairs_from_first(report)
    certified = any(about["terrains"] for about in report["certified"].values())
    more = [
        *([lambda axes: _draw_changes(axes, report, pairs)] if pairs else []),
        *([lambda axes: _draw_certified(axes, report)] if certified else []),
        *([lambda axes: _draw_bias(axes, report)] if report.get("resolved") else []),
    ]
    figure, panels = _panels(len(_PANELS) + len(more))
    for axes, (measure, (label, factor)) in zip(panels, _PANELS.items(), strict=False):
        _draw_measure(axes, report, measure, factor)
        axes.set_ylabel(label)
    for axes, draw in zip(panels[len(_PANELS) :], more, strict=True):
        draw(axes)
    sizes = "; ".join(f"{_on_one_line(name)}: {count}" for name, count in report["terrains"].items())
    validation = ", validation" if report.get("part") == "validation" else ""
    title = (
        f"{report['robot']}{validation}: {report['episodes']} episodes on each terrain, 95 % intervals over terrains"
    )
    figure.suptitle(f"{title}\nterrains: {sizes}", fontsize=11)
    found = [axes.get_legend_handles_labels() for axes in panels[: len(_PANELS)]]
    entries = {label: handle for handles, labels in found for handle, label in zip(handles, labels, strict=True)}
    if _PAPER_LABEL in entries:  # once, and last
        entries[_PAPER_LABEL] = entries.pop(_PAPER_LABEL)
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=8, frameon=False)
    return figure


def _panels(count: int) -> "tuple[Figure, list[Axes]]":
    """A figure with so many panels: in one row, or in two."""
    rows, columns, size = {3: (1, 3, (13.0, 4.2)), 4: (2, 2, (11.5, 8.0))}.get(count, (2, 3, (17.0, 8.4)))
    figure = new_figure(*size)
    return figure, [figure.add_subplot(rows, columns, place + 1) for place in range(count)]


def _draw_certified(axes: "Axes", report: dict[str, Any]) -> None:
    """Goal rates on certified terrains, with whose are biased."""
    known = {name: about for name, about in report["certified"].items() if about["terrains"]}
    rows = {"certified_goal": {name: report["certified_goal"][name] for name in known}}
    _draw_measure(axes, {**report, **rows}, "certified_goal", 100.0)
    labels = [f"{SET_LABELS[name]}\n({about['terrains']} certified)" for name, about in known.items()]
    axes.set_xticks(range(len(known)), labels)
    axes.set_ylabel("goal reached on certified terrains\n[% of episodes]")
    roles = {who: role for about in known.values() for who, role in about["chosen_by"].items()}
    ways = {"searched": "too low", "certifier": "too high"}
    told = (f"{who} ({role}) is {ways[role]}" for who, role in roles.items())
    axes.set_xlabel("\n".join(["by choice of the terrains:", *wrap(", ".join(told), 70)]) if roles else "")


def _draw_bias(axes: "Axes", report: dict[str, Any]) -> None:
    """How far goal rates at the search's settings lie above those with contact resolved."""
    controllers = list(report["controllers"])
    kinds = [kind_of(first) for first in firsts(controllers)]
    columns = [(key, who) for key in _RESOLVED if report.get(key) for who in next(iter(report[key].values()))]
    names, step = list(report["resolved"]), min(0.16, 0.7 / len(columns))
    for index, (key, who) in enumerate(columns):
        kind, shift = kinds.index(kind_of(who)), step * (index - (len(columns) - 1) / 2)
        found = [(place, report[key][name][who]) for place, name in enumerate(names)]
        found = [(place, one) for place, one in found if one["goal_bias"] is not None]
        values = np.array([one["goal_bias"] for _, one in found])
        lengths = bar_lengths(values, [one["goal_bias_interval"] for _, one in found])
        axes.errorbar(
            np.array([place for place, _ in found]) + shift, 100.0 * values, 100.0 * lengths, linestyle="", capsize=3,
            marker=MARKERS[kind % len(MARKERS)], color=COLOURS[kind % len(COLOURS)],
            markerfacecolor=None if key == "resolved" else "none", label=f"{who}: {_RESOLVED[key]}",
        )  # fmt: skip
    axes.axhline(0.0, color="0.4", linewidth=0.8)
    axes.set_xticks(range(len(names)), [SET_LABELS[name] for name in names], fontsize=_tick_size(names))
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.set_ylabel("bias of the goal rate\n[points above contact resolved]")
    axes.legend(frameon=False, fontsize=8, loc="best")
    axes.grid(axis="y", alpha=0.3)


def _tick_size(names: Sequence[str]) -> float:
    return 10.0 if len(names) < 5 else 8.5


def _on_one_line(name: str) -> str:
    return SET_LABELS[name].replace("\n", " ")


def _draw_measure(axes: "Axes", report: dict[str, Any], measure: str, factor: float) -> None:
    """Points of all controllers side by side over each set."""
    names = list(report[measure])
    controllers = list(report[measure][names[0]])
    kinds = firsts(controllers)
    step = min(0.16, 0.7 / len(controllers))
    for index, who in enumerate(controllers):
        shift = step * (index - (len(controllers) - 1) / 2)
        kind = [kind_of(first) for first in kinds].index(kind_of(who))  # other seeds look like the first one
        colour, marker = COLOURS[kind % len(COLOURS)], MARKERS[kind % len(MARKERS)]
        there = [place for place, name in enumerate(names) if report[measure][name][who] is not None]
        means = np.array([report[measure][names[place]][who] for place in there])
        limits = [report["intervals"][measure][names[place]][who] for place in there]
        values, lengths = factor * means, factor * bar_lengths(means, limits)
        places = np.array(there) + shift
        seeds = [kind_of(other) for other in controllers].count(kind_of(who))
        label = kind_of(who) + (f" ({seeds} seeds)" if seeds > 1 else "") if who in kinds else ""
        axes.errorbar(places, values, lengths, linestyle="", marker=marker, color=colour, capsize=3, label=label)
        paper = [published_value(report, measure, name, who) for name in names]
        known = [place for place, value in enumerate(paper) if value is not None]
        if known:
            heights = [factor * value for value in paper if value is not None]
            style = {"markersize": 10, "markerfacecolor": "none", "color": "0.4"}
            axes.plot(np.array(known) + shift, heights, "D", label=_PAPER_LABEL, **style)
    axes.set_xticks(range(len(names)), [SET_LABELS[name] for name in names], fontsize=_tick_size(names))
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.grid(axis="y", alpha=0.3)


def _pairs_from_first(report: dict[str, Any]) -> list[str]:
    """Differences of every other controller from the first one."""
    first = next(iter(report["controllers"]))
    return [pair for pair in next(iter(report["differences"].values())) if pair.startswith(f"{first} -> ")]


def _draw_changes(axes: "Axes", report: dict[str, Any], pairs: Sequence[str]) -> None:
    """Share of the terrains that are mended, still failing or newly broken: one bar a controller, set by set."""
    names = list(report["differences"])
    rows = [(name, pair) for name in names for pair in pairs]
    places = [place + 1 + place // len(pairs) for place in range(len(rows))]  # a line for each set's name
    left = np.zeros(len(rows))
    for kind, colour in _CHANGES.items():
        shares = np.array([100.0 * (report["differences"][name][pair][kind]["share"] or 0.0) for name, pair in rows])
        axes.barh(places, shares, left=left, color=colour, label=kind.replace("_", " "))
        left += shares
    for k, name in enumerate(names):
        axes.annotate(
            _on_one_line(name), (0.0, k * (len(pairs) + 1)), xytext=(3, 0), textcoords="offset points", va="center",
            fontsize=9,
        )  # fmt: skip
    first, _, _ = pairs[0].partition(" -> ")
    axes.set_yticks(places, [pair.partition(" -> ")[2] for _, pair in rows], fontsize=8)
    axes.set_ylim(max(places) + 0.7, -0.7)
    axes.set_xlabel(
        f"failed terrains, compared with {first} [% of terrains]\n(under half of the episodes reach the goal)"
    )
    axes.set_xlim(left=0)
    axes.legend(frameon=False, fontsize=8, loc="best")
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
