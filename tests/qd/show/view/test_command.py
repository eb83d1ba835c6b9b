import dataclasses
import json
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
import tyro

from qd.archive import read_archive, write_archive
from qd.run.directory import RESULTS
from qd.show.view.command import View, check_port, show_of
from tests.builders import small_archive


@pytest.fixture(scope="module")
def run(published):
    return published / "anymal" / "archive"


def test_the_published_archive_is_shown_where_there_is_no_run(tmp_path, monkeypatch, anymal, published):
    (tmp_path / "results").symlink_to(published)
    monkeypatch.chdir(tmp_path)
    show = show_of(View())
    assert show.found.run == RESULTS / "anymal" / "archive"
    assert show.controllers == {"as searched": str(anymal.policy_file)}
    write_archive(make_folder(tmp_path / "runs" / "mine") / "archive.npz", small_archive())
    assert show_of(View()).found.run == Path("runs/mine")


def make_folder(path):
    path.mkdir(parents=True)
    return path


def test_controllers_are_named_and_tried(tmp_path, anymal, run):
    cfg = View(run=run, policies=(f"base=shipped tuned={anymal.policy_file}",))
    assert list(show_of(cfg).controllers) == ["base", "tuned"]
    with pytest.raises(ValueError, match="no such file"):
        show_of(dataclasses.replace(cfg, policies=("base=shipped", f"tuned={tmp_path / 'none.pt'}")))


def test_terrains_are_shown_when_the_controller_of_the_search_is_lost(tmp_path, run):
    shutil.copytree(run, tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    config.write_text(config.read_text().replace('"policy": "shipped"', '"policy": "/gone/policy.pt"'))
    show = show_of(View(run=tmp_path / "run"))
    assert show.controllers == {} and "/gone/policy.pt" in show.note and "--policies" in show.note


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "spot"}, "unknown robot 'spot': expected one of anymal, cassie"),
        ({"run": Path("nowhere")}, r"no archive at nowhere/?.*: give a run directory"),
        ({"robot": "cassie"}, "anymal"),
        ({"elite": "5000"}, r"has no elite 5000: expected .* 0 to {last}"),
        ({"elite": "-1"}, "has no elite -1"),
        ({"elite": "0 1"}, "one elite here, got '0 1'"),
        ({"cache": Path(__file__) / "cache"}, "cannot write to .*test_command"),
        ({"replicas": 0}, "replicas must be at least 1 and at most 100, got 0"),
        ({"policies": ("shipped",)}, "policies must be NAME=FILE each"),
    ],
)
def test_what_is_wrong_is_said_before_a_page_opens(changes, message, run):
    message = message.replace("{last}", str(len(read_archive(run)) - 1))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        show_of(View(**{"run": run} | changes))


def test_a_run_without_elites_is_refused(tmp_path):
    write_archive(tmp_path / "archive.npz", small_archive().rows(np.array([], dtype=int)))
    with pytest.raises(ValueError, match="has no elites yet"):
        show_of(View(run=tmp_path))


def test_terrains_are_shown_when_the_controller_of_the_search_is_code(tmp_path, run):
    shutil.copytree(run, tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    settings = json.loads(config.read_text())
    settings["settings"] |= {"policy": "tests.sim.policies:stand", "policy_sha256": None}
    config.write_text(json.dumps(settings))
    show = show_of(View(run=tmp_path / "run"))
    assert show.controllers == {}
    assert "tests.sim.policies:stand is code" in show.note and "name a controller with --policies" in show.note
    assert "--policy " not in show.note  # which this command does not have
    named = show_of(View(run=tmp_path / "run", policies=("mine=tests.sim.policies:stand",)))
    assert named.controllers == {"mine": "tests.sim.policies:stand"}


@pytest.mark.parametrize("name", ["archive.npz", "config.json"])
def test_a_half_written_run_is_refused(tmp_path, run, name):
    shutil.copytree(run, tmp_path / "run")
    file = tmp_path / "run" / name
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(ValueError, match=name):
        show_of(View(run=tmp_path / "run"))
    (tmp_path / "run" / "archive.npz").unlink()
    with pytest.raises(FileNotFoundError, match="no archive at"):
        show_of(View(run=tmp_path / "run"))


def test_a_port_in_use_is_refused_until_it_is_free():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=rf"port {port} of 127.0.0.1 is in use .* another --port"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)


@pytest.mark.parametrize(
    ("host", "port", "message"),
    [("127.0.0.1", 0, "port must lie in 1..65535"), ("256.1.1.1", 8080, "nothing can be served at port 8080 of 256")],
)
def test_what_cannot_be_listened_at_is_refused(host, port, message):
    with pytest.raises(ValueError, match=message):
        check_port(host, port)


def test_flags_are_handed_over():
    words = [
        "--robot",
        "cassie",
        "--run",
        "a b",
        "--policies",
        "base=shipped",
        "x=y.pt",
        "--port",
        "9000",
        "--elite",
        "3",
    ]
    expected = View(robot="cassie", run=Path("a b"), policies=("base=shipped", "x=y.pt"), port=9000, elite="3")
    assert tyro.cli(View, args=words) == expected
    assert View().host == "127.0.0.1"  # nobody else's business unless asked for
