"""The bar of work that takes time: on a terminal of any width, and where there is none."""

import re
from types import SimpleNamespace

from qd.search import progress
from qd.search.progress import Bar


def test_a_terminal_has_one_line_that_fits_with_the_time_left_first(monkeypatch, capsys):
    for name, value in {"FORCE_COLOR": "1", "NO_COLOR": "1", "COLUMNS": "50", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    with Bar("crossing" + 30 * " terrains", total=4, done=2) as bar:
        bar.move_to(3)
    text = capsys.readouterr().err
    assert "\x1b[36m" not in text  # no colour where NO_COLOR is set
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text))
    assert any(re.match(r" +\d+ s left  75% ━━━━━━━━── crossing terrains .*…$", line) for line in lines)
    assert max(map(len, lines)) == 50


def test_elsewhere_a_plain_line_every_half_minute(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with Bar("iteration 3/4", total=4, done=2) as bar:
        for now[0], share in ((10, 0.2), (60, 0.5), (80, 0.9)):
            bar.within(2, 1)(share)
    # Half an iteration took a minute: one and a half take three.
    assert capsys.readouterr().err == " 3 min left  62% ━━━━━━──── iteration 3/4\n"
    with Bar("quick") as bar:
        bar.move_to(1.0)
    assert capsys.readouterr().err == ""
