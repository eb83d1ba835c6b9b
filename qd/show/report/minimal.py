"""The page's chapter about minimal terrains."""

from typing import Any

import numpy as np

from qd.minimise import NUMBERS_FILE
from qd.show.minimal_figure import draw_minimal
from qd.show.report.material import Shown
from qd.show.report.page import Block, absent, counted, paragraph, percent, picture, table
from sim.files.command import command_line
from sim.files.records import without_machine

_ROWS = 5  # of a table that is not folded


def minimal_section(shown: Shown) -> list[Block]:
    """How little of a terrain it takes to fail, with pictures."""
    material = shown.material
    minima = material.minimal
    if minima is None:
        text, word = f"Left out: there is no {NUMBERS_FILE} of these elites. It is made by", "minimise"
        if material.archive.fresh is None:
            text, word = f"{text} faultline minimise, after", "judge"
        return [absent(text, without_machine(command_line(word, robot=material.robot.spec, run=material.run)))]
    entries = minima.numbers["elites"]
    caption = "How many parts failures take, by the kind of the cause, and minimal terrains from above"
    figure = draw_minimal(material.archive.robot, minima.numbers, minima.genes, material.space)
    return [paragraph(_summary(entries)), picture("minimal", figure, caption), _table(entries)]


def _summary(entries: list[dict[str, Any]]) -> str:
    sizes = [len(entry["bumps"]) for entry in entries]
    alone = sum(size == 1 for size in sizes)
    text = (
        f"Parts of {counted(len(entries), 'failing terrain')} were taken away as long as the controller still failed, "
        "in 20 episodes each, and what was left crossed 40 times. It takes "
        f"{counted(int(np.median(sizes)), 'part')} to fail (median), in {alone:,} of them a single one."
    )
    margins = [entry["margin_m"] for entry in entries if entry["margin_m"] is not None]
    if margins:
        text += (
            " The margin says how far the ground can move toward flat ground until the robot passes: "
            f"{100 * float(np.median(margins)):.1f} cm (median)."
        )
    return f"{text} The cause is the part without which most robots arrive."


def _table(entries: list[dict[str, Any]]) -> str:
    head = ["elite", "goal", "95 % interval", "parts", "cause", "margin [cm]", "verdict", "what is left"]
    rows = [
        [
            f"{entry['elite']}",
            "-" if entry["goal_rate"] is None else percent(entry["goal_rate"]),
            "{:.0f} to {:.0f} %".format(*(100 * limit for limit in entry["goal_interval"])),
            f"{len(entry['bumps'])} of {entry['of']}",
            entry["cause"]["kind"] if entry["cause"] else "-",
            "-" if entry["margin_m"] is None else f"{100 * entry['margin_m']:.1f}",
            str(entry.get("verdict", "")),
            "; ".join(entry["words"]),
        ]
        for entry in entries
    ]
    folded = f"Show {counted(len(rows), 'minimal terrain')}" if len(rows) > _ROWS else ""
    return table(head, rows, words=True, folded=folded)
