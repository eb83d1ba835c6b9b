"""Every file of a run damaged in every way: each command works as if nothing were, or says in a line what is wrong."""

import re
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from sim.policy.export import export_onnx
from sim.policy.loaders import load_policy
from sim.robots.find import get_robot
from tests.kills import commands, searches, trainings
from tests.kills.children import run_child
from tests.kills.damage import copied, damages, snapshot

SEED = 11


def error_of(code: int, output: str, what: str) -> str:
    """The one error line of a command that must have failed as a user's mistake."""
    assert "Traceback" not in output and "Exception ignored" not in output, f"{what}:\n{output}"
    assert code == 2, f"{what}: exit code {code}\n{output}"
    (line,) = [line for line in output.splitlines() if line.startswith("error: ")]
    # What, expected or got, and a remedy after it.
    assert len(line) > 60 and re.search(r"expected|must|\bno |damaged|truncated|lost|other|directory", line), line
    return line


def each(cases, check) -> None:
    """Checks cases, two at a time."""
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(check, range(len(cases)), cases))


@pytest.fixture(scope="module")
def search_run(tmp_path_factory):
    """A finished search, the same after one more iteration, and what a replay of it prints."""
    folder = tmp_path_factory.mktemp("searches")
    run, longer = folder / "run", folder / "longer"
    assert run_child(folder / "log", searches.search, run, iterations=2)[0] == 0
    copied(run, longer)
    assert run_child(folder / "log", commands.resume_search, longer)[0] == 0
    code, printed = run_child(folder / "log", commands.replay_elite, longer)
    assert code == 0, printed
    replayed = copied(run, folder / "r")
    printed = run_child(folder / "log", commands.replay_elite, replayed)[1]
    return run, searches.outcome(longer), printed.replace(str(replayed), "RUN")


@pytest.mark.kills
def test_damaged_files_of_a_search_and_going_on_with_it(folder, search_run):
    whole, longer, _ = search_run
    cases = [(file, *case) for file in sorted(whole.iterdir()) for case in damages(file, SEED).items()]
    refused = dict.fromkeys((file.name for file in whole.iterdir()), 0)

    def check(number, case):
        file, name, damage = case
        run = copied(whole, folder / f"run-{number}")
        damage(run / file.name)
        before = snapshot(run)
        code, output = run_child(folder / f"log-{number}", commands.resume_search, run)
        if code == 0:
            assert "Traceback" not in output
            assert searches.outcome(run) == longer, f"{file.name}, {name}: taken, and the search goes another way"
            return
        error_of(code, output, f"{file.name}, {name}")
        if name != "a directory" or file.name in ("config.json", "checkpoint.bin", "metrics.jsonl", "archive.npz"):
            assert snapshot(run) == before, f"{file.name}, {name}: the run was changed"
        refused[file.name] += 1

    each(cases, check)
    files = {name: sum(file.name == name for file, *_ in cases) for name in refused}
    assert refused["checkpoint.bin"] == files["checkpoint.bin"]  # its hash lets nothing pass
    assert refused["config.json"] > 15
    assert refused["metrics.jsonl"] == refused["archive.npz"] == 1  # made again, unless a directory is in the way


@pytest.mark.kills
def test_damaged_files_of_a_search_and_replay(folder, search_run):
    whole, _, printed = search_run
    cases = [
        (whole / name, *case) for name in ("archive.npz", "config.json") for case in damages(whole / name, SEED).items()
    ]
    printed = printed.partition("Figure:")[0]

    def check(number, case):
        file, name, damage = case
        run = copied(whole, folder / f"run-{number}")
        damage(run / file.name)
        before = snapshot(run)
        code, output = run_child(folder / f"log-{number}", commands.replay_elite, run)
        if code == 0:
            assert "Traceback" not in output, output
            if file.name == "archive.npz":  # a config is read by people too and has no checksum
                replayed = output.replace(str(run), "RUN").partition("Figure:")[0]
                assert replayed == printed, f"{file.name}, {name}: taken as another archive"
            return
        error_of(code, output, f"{file.name}, {name}")
        assert snapshot(run) == before, f"{file.name}, {name}: the run was changed"

    each(cases, check)


@pytest.fixture(scope="module")
def training_run(tmp_path_factory):
    """A finished training, and the checkpoint of the same after one more iteration."""
    folder = tmp_path_factory.mktemp("trainings")
    run = folder / "run"
    assert run_child(folder / "log", trainings.train, run, iterations=2)[0] == 0
    code, output = run_child(folder / "log", commands.resume_training, copied(run, folder / "longer"))
    assert code == 0, output
    return run, trainings.saved(folder / "longer")


@pytest.mark.kills
def test_damaged_files_of_a_training_and_going_on_with_it(folder, training_run):
    whole, longer = training_run
    cases = [(file, *case) for file in sorted(whole.iterdir()) for case in damages(file, SEED).items()]
    assert {file.name for file, *_ in cases} >= {"checkpoint.pt", "config.json", "policy.pt", "policy.train.json"}

    def check(number, case):
        file, name, damage = case
        run = copied(whole, folder / f"run-{number}")
        damage(run / file.name)
        before = snapshot(run)
        code, output = run_child(folder / f"log-{number}", commands.resume_training, run)
        if code == 0:
            assert "Traceback" not in output, output
            assert trainings.equal(trainings.saved(run), longer), f"{file.name}, {name}: taken, learns otherwise"
            return
        error_of(code, output, f"{file.name}, {name}")
        if file.name in ("checkpoint.pt", "config.json"):
            assert snapshot(run) == before, f"{file.name}, {name}: the run was changed"

    each(cases, check)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("config.json", commands.resume_search),
        ("checkpoint.bin", commands.resume_search),
        ("checkpoint.bin", commands.reevaluate_search),
        ("config.json", commands.replay_elite),
        ("archive.npz", commands.replay_elite),
        ("checkpoint.pt", commands.resume_training),
        ("", commands.resume_search),
        ("", commands.reevaluate_search),
        ("", commands.resume_training),
    ],
)
def test_files_that_may_not_be_read_and_folders_that_may_not_be_written(
    folder, search_run, training_run, name, command
):
    whole = training_run[0] if command is commands.resume_training else search_run[0]
    run = copied(whole, folder / "run")
    before = snapshot(run)
    folder.chmod(0o755)
    run.chmod(0o777 if name else 0o555)
    if name:
        (run / name).chmod(0o000)
    error_of(*run_child(folder / "log", commands.as_nobody, command, run), f"{name or 'the folder'} forbidden")
    run.chmod(0o755)
    (run / name).chmod(0o755)
    assert snapshot(run) == before


@pytest.mark.parametrize("path", ["missing", "/dev/null", "/dev/null/run", "n" * 300])
def test_paths_that_lead_nowhere(folder, path):
    for command in vars(commands).values():
        if getattr(command, "__module__", "") == commands.__name__ and command.__name__.endswith(ON_A_PATH):
            error_of(*run_child(folder / "log", command, Path(path)), f"{command.__name__} {path}")


ON_A_PATH = ("_search", "_training", "_elite", "_with")


@pytest.fixture(scope="module")
def controllers(tmp_path_factory, training_run):
    """A checkpoint, a TorchScript module and an ONNX file."""
    folder = tmp_path_factory.mktemp("controllers")
    script = torch.jit.script(torch.nn.Sequential(torch.nn.Linear(235, 4), torch.nn.ELU(), torch.nn.Linear(4, 12)))
    script.save(folder / "script.ts")
    (folder / "policy.pt").write_bytes((training_run[0] / "policy.pt").read_bytes())
    export_onnx(load_policy(folder / "policy.pt", get_robot("anymal"), "cpu"), folder / "policy.onnx")
    return folder


def contents(file):
    """What a reader takes from a file: the entries of a zip, else every byte."""
    if not zipfile.is_zipfile(file):
        return file.read_bytes()
    with zipfile.ZipFile(file) as archive:
        return {entry: archive.read(entry) for entry in archive.namelist()}


@pytest.mark.parametrize("command", [commands.calibrate_with, commands.evaluate_with])
@pytest.mark.parametrize("name", ["policy.pt", "script.ts", "policy.onnx"])
def test_damaged_controllers(folder, controllers, name, command):
    cases = list(damages(controllers / name, SEED).items())
    taken = []

    def check(number, case):
        own = folder / str(number)
        own.mkdir()
        policy = own / name
        policy.write_bytes((controllers / name).read_bytes())
        case[1](policy)
        before = snapshot(own)
        code, output = run_child(folder / f"log-{number}", command, policy)
        if code == 0:
            taken.append(case[0])
            return
        assert "policy" in error_of(code, output, f"{name}, {case[0]}")
        assert snapshot(own) == before

    each(cases, check)
    for case in taken:  # nobody reads all of the zip format, but what is read is what was written
        assert "flipped" in case, taken
        damaged = folder / name
        damaged.write_bytes((controllers / name).read_bytes())
        dict(cases)[case](damaged)
        assert contents(damaged) == contents(controllers / name), case


def test_undamaged_controllers_are_taken(folder, controllers):
    for command in (commands.calibrate_with, commands.evaluate_with):
        for file in list(controllers.iterdir()):
            policy = Path(folder / file.name)
            policy.write_bytes(file.read_bytes())
            code, output = run_child(folder / "log", command, policy)
            assert code == 0, output
    assert get_robot("anymal").num_joints == 12
