"""What an error tells a user to do works as it stands, from where the user is, with the robot and controller given."""

import re
import shlex
from pathlib import Path

import pytest

from faultline import main
from tests.run_docs import KICK
from tests.sim.dogs import write_dog

pytestmark = pytest.mark.slow  # thirteen small searches, trainings and evaluations: minutes

CPU = ["--device", "cpu"]
NET = ["--ppo.hidden-dims", "16", "8", "--ppo.steps-per-env", "4"]
SMALL = {
    "archive": [*CPU, "--workers", "1", "--iterations", "2"],
    "calibrate": [*CPU, "--workers", "1", "--terrains", "4", "--most-terrains", "4", "--replicas", "2"],
    "train": [*CPU, "--num-envs", "6", "--iterations", "2", *NET],
    "finetune": [*CPU, "--num-envs", "12", "--iterations", "2"],
    "evaluate": [*CPU, "--workers", "1", "--terrains", "2", "--episodes", "1"],
    "replay": [*CPU, "--replicas", "2"],
    "reevaluate": [*CPU, "--workers", "1"],
    "report": [*CPU, "--elites", "1", "--episodes", "1"],
    "export": ["--formats", "npz"],
}
SEARCH = ["--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "2"]
KICKED = ["--robot", "kicked/dog.py", "--policy", "kicked/kick.py:act"]
RUN = ["--run", "runs/dog-small-0"]
TRAIN = ["--robot", "bare/dog.py", "--run-dir", "runs/base"]

COMMAND, FLAG = r"`(\S*faultline [^`]+)`", r"(--[a-z-]+(?: [^\s`),:;]\S*?(?=[\s),;]|$))?)"
MISTAKES = [
    # what was typed; where its error has the remedy: a whole command, or flags that were lacking
    (["archive", *KICKED], COMMAND),  # no scales, a controller of the user's own
    (["replay", *KICKED], COMMAND),  # no archive
    (["archive", *KICKED, *SEARCH, "--run-dir", "runs/dog-small-0"], None),  # of other settings
    (["replay", *RUN, "--robot", "kicked/dog.py"], rf"again \({FLAG}\)"),  # searched with code
    (["archive", "--robot", "bare/dog.py"], COMMAND),  # no scales, nor a controller to measure them with
    (["train", *TRAIN, "--export", "bare/dog.pt"], r"give (--overwrite)"),
    (["train", *TRAIN], r"(--resume runs/base)"),  # a training is there
    (["finetune", "--robot", "bare/dog.py", "--resume", "runs/base"], COMMAND),  # it is no fine-tuning
    (["finetune", *KICKED], COMMAND),  # from code
    (["evaluate", "--robot", "lone/dog.py"], COMMAND),  # no controller
    (["export", "--run", "results/anymal/archive"], r"give (--overwrite)"),
    (["evaluate", "--sets", "generated"], r"\((--archive \S+)\)"),
    (["evaluate", "--policy", "walk.py:act", "--sets", "hard_random"], r"give (--policies \S+) instead of"),
    (["report", "--tables", "nothing.json"], COMMAND),
]


@pytest.fixture(scope="module")
def home(tmp_path_factory, published):
    """A folder with three dogs: one with a controller of its own code, and two with none."""
    home = tmp_path_factory.mktemp("home")
    for name in ("kicked", "bare", "lone"):
        write_dog(home / name)
    (home / "kicked" / "kick.py").write_text(KICK)
    (home / "walk.py").write_text("def act(observation):\n    return observation[:, -12:] * 0\n")
    (home / "results").symlink_to(published)
    return home


def run(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit status and errors of a command made small; what the user gave counts."""
    small = SMALL[words[0]]
    status = main([words[0], *small, *words[1:]])
    return status, capsys.readouterr().err


def test_a_remedy_works(home, monkeypatch, capsys):
    monkeypatch.chdir(home)
    for words, pattern in MISTAKES:
        if words[0] == "export":
            assert run(words, capsys)[0] == 0  # the first time
        status, said = run(words, capsys)
        assert status == 2, (words, said)
        if pattern is None:
            continue
        found = re.search(pattern, said)
        assert found, (words, said)
        remedy = shlex.split(found[1])
        if not remedy[0].startswith("--"):
            again = remedy[1:] if remedy[0].endswith("faultline") else remedy[remedy.index("faultline") + 1 :]
        elif "instead of" in pattern:
            place = words.index("--policy")
            again = [*words[:place], *words[place + 2 :], *remedy]
        else:
            again = [
                word for word in words if remedy[0] != "--resume" or word not in ("--run-dir", "runs/base")
            ] + remedy
        status, said = run(again, capsys)
        assert status == 0, (words, again, said)


def test_what_is_refused_leaves_no_folder(home, monkeypatch, capsys):
    monkeypatch.chdir(home)
    Path("file").write_text("")
    for words in (
        ["train", "--run-dir", "gone", "--export", "file/dog.pt"],
        ["export", "--run", "results/anymal/archive", "--elite", "99999", "--out", "gone"],
        ["evaluate", "--policies", "a=nothing.pt", "--run-dir", "gone"],
        ["replay", "--policy", "nothing.pt", "--out", "gone/elite.png"],
    ):
        assert run(words, capsys)[0] == 2
        assert not Path("gone").exists(), words
