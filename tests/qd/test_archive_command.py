"""The command that searches: what its flags come to, what it refuses in one line, and that runs stay whole."""

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from qd.commands import ArchiveCommand
from qd.faults.judge import judge
from qd.search import loop, settings
from qd.search.archive import read_archive
from qd.search.crossed import usual_crossed
from qd.search.methods import METHODS
from qd.search.presets import PRESETS
from qd.search.results import print_summary
from qd.show.elites import open_run
from qd.show.view.viewed import open_viewed_run
from qd.workers.compute import Compute
from sim.files.command import run_command
from sim.robots.find import get_robot
from sim.terrains.conditions.kinds import condition_column
from sim.terrains.conditions.likely import SHIPPED, choose_likely, read_likely
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, get_space
from tests.builders import fresh_values
from tests.qd import stand_in
from tests.qd.searches import crossing_by

SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "1", "--iterations", "1"]
TINY = ["--device", "cpu", *SIZE]
MORE = ["--device", "cpu", "--iterations"]
_OF_NO_GPU = ("Warp CUDA warning", "No CUDA device was found")  # said once a process


def fine_policy(observation: torch.Tensor) -> torch.Tensor:
    return observation[:, :12]


def narrow_policy(observation: torch.Tensor) -> torch.Tensor:
    return observation[:, :3]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(settings, "read_penalty_scales", lambda robot, policy=None: stand_in.SCALES)
    before = signal.getsignal(signal.SIGTERM)
    with crossing_by(stand_in.open_stand_in):
        yield
    signal.signal(signal.SIGTERM, before)


def archive(*argv: str) -> int:
    return run_command(ArchiveCommand, argv, name="archive")


def fails(capsys, *argv: str) -> str:
    """The error line of a command that must fail as a user's mistake, and change nothing in a run called a."""
    before = everything_in("a")
    capsys.readouterr()
    assert archive(*argv) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith(_OF_NO_GPU)]
    assert len(lines) == 1 or "archive --help" in "".join(lines), lines  # tyro's box about a flag
    assert everything_in("a") == before
    return "\n".join(lines)


def everything_in(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in Path(folder).glob("*") if path.is_file()}


def config_of(folder: str) -> dict:
    return json.loads(Path(folder, "config.json").read_text())


def change_settings(**changes) -> None:
    config = config_of("a")
    Path("a", "config.json").write_text(json.dumps(config | {"settings": config["settings"] | changes}))


CANNOT_BE = ["--robot dog", "--space blocks", "--preset huge", "--device tpu", "--policy missing.pt", "--run-dir full"]
CANNOT_BE += [f"--policy {__name__}:narrow_policy", "--resume nowhere", "--method guess"]


@pytest.mark.parametrize("flag", CANNOT_BE)
def test_what_cannot_be_is_named_before_there_is_a_run(capsys, flag):
    Path("full").mkdir()
    Path("full/thesis.tex").write_text("years of work")
    assert flag.split()[1] in fails(capsys, *TINY, *flag.split())
    assert os.listdir() == ["full"]
    assert Path("full/thesis.tex").read_text() == "years of work"


def test_what_crosses_again_is_checked_before_robot_and_controller_are(capsys, monkeypatch):
    monkeypatch.setattr(loop, "ensure_ready", lambda *given: pytest.fail("they are looked at"))
    for again, settling, name in (("2", "1", "settling"), ("10001", "0", "again")):
        assert name in fails(capsys, *TINY, "--scheduler.again", again, "--scheduler.settling", settling)
    assert "fitness.crossed" in fails(capsys, *TINY, "--fitness.crossed", ".5")
    assert os.listdir() == []


def test_what_nobody_crosses_earns_less_by_itself_where_that_can_be_learned_and_a_panel_says_it():
    robot, wide, space = get_robot("anymal"), PRESETS["wide"]["scheduler"], SUPER_GAUSSIAN
    assert usual_crossed(wide, robot, space) == 0.95
    for scheduler in (replace(wide, method="map_elites"), replace(wide, again=0), PRESETS["small"]["scheduler"]):
        assert usual_crossed(scheduler, robot, space) == 0.0
    assert usual_crossed(wide, replace(robot, name="dog"), space) == 0.0  # without a panel
    assert usual_crossed(wide, robot, get_space("super_gaussian+stand")) == 0.0
    for number, (flags, weight) in enumerate(((["--scheduler.again", "2"], 0.95), ([], 0.0))):
        assert archive(*TINY, *flags, "--run-dir", f"{number}") == 0
        assert config_of(f"{number}")["settings"]["fitness"]["crossed"] == weight
    assert archive(*TINY, "--scheduler.again", "2", "--fitness.crossed", "0", "--run-dir", "a") == 0
    assert archive("--resume", "a", *MORE, "2") == 0  # 0 is the default of this run now


@pytest.mark.slow
def test_likely_conditions_are_preferred_by_a_model_that_the_run_remembers(capsys):
    likely = [*TINY, "--fitness.crossed", "0", "--fitness.likely", "0.5"]
    assert "fitness.likely" in fails(capsys, *likely, "--space", "super_gaussian+push")
    likely += ["--scheduler.again", "2"]
    assert "conditions" in fails(capsys, *likely, "--space", "course")
    Path("mine.toml").write_text('[grip]\nnumbers = {friction = 1}\ndistribution = "exponential"\nsource = "me"\n')
    pushes = ["--space", "super_gaussian+push"]
    assert "none for push" in fails(capsys, *TINY, *pushes, "--likely", "mine.toml")
    grips = ["--space", "super_gaussian+grip", "--likely", "mine.toml"]
    assert archive(*likely, *grips, "--run-dir", "a") == 0
    assert "--likely" in fails(capsys, "--resume", "a", *MORE, "2", "--likely", "mine.toml")
    Path("mine.toml").rename("other.toml")
    assert archive("--resume", "a", *MORE, "2") == 0  # by the model of the run
    assert archive(*likely, *pushes, "--run-dir", "b") == archive(*TINY, *pushes, "--run-dir", "c") == 0
    a, b, c = (config_of(name)["settings"]["fitness"] for name in "abc")
    assert a["disturbances"] == {"grip": {"numbers": {"friction": 1.0}, "distribution": "exponential", "source": "me"}}
    assert [*b["disturbances"]] == ["push"] and (b["likely"], c["likely"]) == (0.5, 0.0)
    assert c["disturbances"] == b["disturbances"]  # it says how likely what it finds is
    plain = choose_likely(get_space("super_gaussian+grip"))
    assert plain["grip"].distribution != "exponential"
    shown = open_run("anymal", Path("a"))
    assert shown.likely == read_likely(Path("other.toml")) and open_viewed_run(Path("a")).likely == shown.likely
    (entry,) = shown.rank().log_likelihood[:1]  # of the model of the run
    (row,) = shown.space.condition_rows(shown.archive.genes[:1])
    assert entry == pytest.approx(-abs(row[condition_column("friction")] - 1.0), rel=1e-6)
    assert open_viewed_run(Path("a"), likely=SHIPPED).likely == plain


def test_flags_come_to_the_settings_of_the_run():
    flags = ["--method", "map_elites", "--seed", "4", "--fitness.alpha", "0.5", "--fitness.intervals", "5"]
    flags += ["--fitness.penalties", "contact_force", "vel_x", "yaw_rate"]
    assert archive(*TINY, *flags, "--run-dir", "a") == 0
    settings = config_of("a")["settings"]
    assert (settings["preset"], settings["seed"], settings["intervals"], settings["replicas"]) == ("small", 4, 5, 1)
    assert settings["fitness"] | {"lam": 2.0, "alpha": 0.5, "scales": [4.0, 2.0, 1.0]} == settings["fitness"]
    assert settings["fitness"]["penalties"] == ["contact_force", "vel_x", "yaw_rate"]
    assert settings["scheduler"]["method"] == "map_elites" and settings["scheduler"]["emitters"] == 1
    assert archive("--resume", "a", *MORE, "2") == 0  # all of these are defaults now
    stored = read_archive("a")
    assert (stored.iterations, stored.ratios.shape[1]) == (2, 3)


def test_a_method_of_one_file_is_searched_by_its_name_and_listed_with_its_settings(capsys):
    assert archive(*TINY, "--method", "toy+map_elites", "--scheduler.toy-step", "0.5", "--run-dir", "a") == 0
    assert archive("--resume", "a", *MORE, "2") == 0
    scheduler = config_of("a")["settings"]["scheduler"]
    assert (scheduler["method"], scheduler["toy_step"]) == ("toy+map_elites", 0.5)
    stored = read_archive("a")
    assert stored.iterations == 2 and len(stored)
    assert archive("--help") == 0
    text = capsys.readouterr().out
    assert "--scheduler.toy-step" in text and all(name in text for name in METHODS)


def test_a_preset_has_its_own_defaults():
    paper = ArchiveCommand.defaults(["--preset", "paper"])
    scheduler = paper.scheduler
    assert (scheduler.emitters, scheduler.batch_size, paper.replicas, paper.iterations) == (10, 20, 20, 1000)
    assert ArchiveCommand.defaults(["--device", "cuda"]).preset == "wide"
    assert ArchiveCommand.defaults(["--device", "cpu"]).preset == "small"


def test_a_run_goes_on_as_it_is_or_not_at_all(capsys):
    assert archive(*TINY, "--run-dir", "a") == 0
    assert "seed" in fails(capsys, *TINY, "--run-dir", "a", "--seed", "1")
    refused = {"--scheduler.learning-rate 0.5": "learning_rate", "--iterations 0": "iterations"}
    refused |= {"--robot cassie": "cassie", "--space course": "course", "--run-dir b": "run-dir"}
    for flags, name in refused.items():
        assert name in fails(capsys, "--device", "cpu", "--resume", "a", *flags.split()), flags
    assert archive(*TINY, "--run-dir", "a") == 0  # it is the same search
    assert [session["from_iteration"] for session in config_of("a")["sessions"]] == [0]


def test_a_controller_may_move_but_not_change(capsys):
    shutil.copy(get_robot("anymal").policy_file, "mine.pt")
    assert archive(*TINY, "--policy", "mine.pt", "--run-dir", "a") == 0
    Path("mine.pt").rename("moved.pt")
    Path("other.pt").write_bytes(Path("moved.pt").read_bytes() + b"\0")
    assert "mine.pt" in fails(capsys, "--resume", "a", *MORE, "2")
    assert "other.pt" in fails(capsys, "--resume", "a", *MORE, "2", "--policy", "other.pt")
    assert archive("--resume", "a", *MORE, "2", "--policy", "moved.pt") == 0
    assert config_of("a")["settings"]["policy"] == "mine.pt"
    Path("moved.pt").rename("mine.pt")
    assert archive("--resume", "a", *MORE, "3") == 0


def test_the_last_lines_say_what_stops_the_robot_and_which_commands_come_next(capsys):
    fine = f"{__name__}:fine_policy"
    assert archive(*TINY, "--policy", fine, "--run-dir", "a b") == 0
    *_, summary, worst, following, judging = capsys.readouterr().out.splitlines()
    found = read_archive(Path("a b"))
    count = int((found.goal_rate < 0.5).sum())
    assert count and summary.startswith(f"The robot fails {count} of {len(found)} terrains")
    assert summary.endswith("as found, not tried again.")
    number = int(worst.split()[2].rstrip(","))
    assert found.goal_rate[number] == found.goal_rate.min()
    run = "--run 'a b'"
    view, report = f"faultline view {run} --policies searched={fine}", f"faultline report {run} --policy {fine}"
    assert following == f"Next: {view}, {report} or faultline replay {run} --elite {number} --policy {fine}"
    assert judging.startswith(f"faultline judge {run} --policy {fine} ")
    print_summary(Path("a b"), replace(found, fresh=fresh_values(found)), policy=fine)
    judged = capsys.readouterr().out
    assert f"faultline finetune --specialist 'a b' --policy {fine} trains" in judged
    assert f"faultline judge {run} --policy {fine} --stages steered looks" in judged
    print_summary(Path("a b"), found, skip_level_ground=True)
    assert "faultline judge --run 'a b' --skip-level-ground says" in " ".join(capsys.readouterr().out.split())


def test_code_runs_only_if_the_command_line_names_it(capsys):
    fine = f"{__name__}:fine_policy"
    assert archive(*TINY, "--policy", fine, "--run-dir", "a") == 0
    whole = everything_in("a")
    assert fine in fails(capsys, "--resume", "a", *MORE, "2")
    Path("evil.py").write_text("open('it_ran', 'w').close()\ndef act(row): pass\nclass Space: pass\n")
    evil = f"{Path.cwd()}/evil.py"
    change_settings(policy=f"{evil}:act@a/checkpoint.bin")
    assert "code" in fails(capsys, "--resume", "a", *MORE, "2")
    with pytest.raises(ValueError, match="code"):
        judge(Path("a"), compute=Compute())
    change_settings(policy=fine, space=f"{evil}:Space", space_sha256="0" * 64)
    assert "evil.py" in fails(capsys, "--resume", "a", *MORE, "2", "--policy", fine)
    change_settings(space="super_gaussian", space_sha256=None, robot=evil)
    assert "evil.py" in fails(capsys, "--resume", "a", *MORE, "2", "--policy", fine)
    assert not Path("it_ran").exists()
    for name, content in whole.items():
        Path("a", name).write_bytes(content)
    assert archive("--resume", "a", *MORE, "2", "--policy", fine) == 0
    assert read_archive("a").iterations == 2
