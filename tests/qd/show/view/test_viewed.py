"""What is read before a page opens: archive, controllers, port."""

import json
import shutil
import socket
from pathlib import Path

import pytest

from qd.search.archive import write_archive
from qd.show.view.app import check_port
from qd.show.view.viewed import open_viewed_run
from tests.builders import small_archive


def test_the_controller_of_the_search_comes_first_and_certifiers_follow(anymal, run):
    controllers = open_viewed_run(run).controllers
    assert next(iter(controllers.items())) == ("searched controller", str(anymal.policy_file)) and "C-G" in controllers


def test_terrains_are_shown_when_the_controller_of_the_search_is_code(tmp_path, run):
    copied = Path(shutil.copytree(run, tmp_path / "run"))
    settings = json.loads((copied / "config.json").read_text())
    settings["settings"] |= {"policy": "tests.sim.policies:stand", "policy_sha256": None}
    (copied / "config.json").write_text(json.dumps(settings))
    show = open_viewed_run(copied)
    assert show.controllers == {} and "tests.sim.policies:stand is code" in show.note
    named = open_viewed_run(copied, policies=("mine=tests.sim.policies:stand",))
    assert next(iter(named.controllers.items())) == ("mine", "tests.sim.policies:stand")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"robot": "spot"}, "spot"),
        ({"elite": "5000"}, "5000"),
        ({"elite": "0 1"}, "0 1"),
        ({"elite": "0", "minimal": "1"}, "leave one out"),
        ({"policies": ("shipped",)}, "policies"),
    ],
)
def test_what_is_wrong_is_said_before_a_page_opens(changes, field, run):
    with pytest.raises((ValueError, FileNotFoundError), match=field):
        open_viewed_run(**{"run": run} | changes)


def test_a_run_without_elites_is_refused(tmp_path):
    write_archive(tmp_path / "archive.npz", small_archive(0))
    with pytest.raises(ValueError, match="no elites"):
        open_viewed_run(tmp_path)


def test_a_port_in_use_is_refused_until_it_is_free():
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {port}"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)
