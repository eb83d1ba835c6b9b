"""The bar of work that takes time: on a terminal of any width, and where there is none."""

import os
import pty
import re
import subprocess
import sys
from types import SimpleNamespace

from qd.run import progress
from qd.run.progress import Bar, SearchBar

SCRIPT = """
import fcntl, struct, termios
from qd.run.progress import Bar
for width in (50, 0):
    fcntl.ioctl(2, termios.TIOCSWINSZ, struct.pack("HHHH", 24, width, 0, 0))
    with Bar("crossing" + 30 * " terrains", total=4, done=2) as bar:
        bar.move_to(3)
        print("printed meanwhile")
"""


def test_a_terminal_has_one_line_that_fits_with_the_time_left_first():
    main_end, terminal = pty.openpty()
    env = {name: value for name, value in os.environ.items() if name != "COLUMNS"} | {"TERM": "xterm", "NO_COLOR": "1"}
    command = [sys.executable, "-c", SCRIPT]
    subprocess.run(command, stdin=terminal, stdout=terminal, stderr=terminal, env=env, check=True)
    os.close(terminal)
    text = os.read(main_end, 1 << 16).decode()
    assert "\x1b[36m" not in text  # no colour where NO_COLOR is set
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text))
    bars = [line for line in lines if re.match(r" +\d+ s left  75% ━━━━━━━━── crossing terrains .*…$", line)]
    assert {*map(len, bars)} == {50, 80}  # 80 where the terminal reports no width
    assert lines.count("printed meanwhile") == 2


def test_elsewhere_a_plain_line_every_half_minute(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with SearchBar(iterations=4, done=2) as bar:
        for now[0], share in ((10, 0.2), (60, 0.5), (80, 0.9)):
            bar.within(3)(share)
    # Half an iteration took a minute: one and a half take three.
    assert capsys.readouterr().err == " 3 min left  62% ━━━━━━──── iteration 3/4: compiling and evaluating\n"
    with Bar("quick") as bar:
        bar.move_to(1.0)
    assert capsys.readouterr().err == ""
