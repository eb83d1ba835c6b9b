"""README and docs/ are true: commands are taken, code works, links lead somewhere, numbers are those of results/."""

import functools
import importlib
import re
import runpy
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

import faultline
from sim.bank import heights_of
from sim.policy.loaders import load_policy
from sim.robots.find import get_robot
from sim.robots.model import build_robot, effort_limits
from sim.spaces.registry import load_space
from tests.builders import rsl_rl_actor, save_checkpoint
from tests.docs import PAGES, ROOT, code_of, commands_of, numbers_of, run_by_make, text_of
from tests.qd.stand_in import open_stand_in
from tests.sim.dogs import MASS, mjcf

REGISTRY = {word: command for group in faultline.COMMANDS.values() for word, command in group.items()}


def command_class(word: str) -> type:
    """The dataclass of a word's flags."""
    module, _, name = REGISTRY[word].where.partition(":")
    return getattr(importlib.import_module(module), name)


def test_readme_is_short_and_leads_to_every_page():
    assert len(text_of("README.md").splitlines()) < 200
    linked = set(re.findall(r"\]\((docs/[\w-]+\.md)", text_of("README.md")))
    assert linked == set(PAGES) - {"README.md"}


@pytest.mark.parametrize("line", [line for page in PAGES for line in commands_of(page)])
def test_commands_are_taken(line):
    words = shlex.split(line)
    if words[0] == "make":
        words = run_by_make(words)
        assert words[0].startswith(".venv/bin/") or "PATH" in words[0] or words[0].startswith("FAULTLINE_DEVICE")
    if words[0].endswith("faultline") and words[1] != "--help":
        tyro.cli(command_class(words[1]), args=words[2:])


@pytest.mark.parametrize("page", PAGES)
def test_links_and_figures_exist(page):
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text_of(page)) if "://" not in link]
    for link in links:
        path, _, anchor = link.partition("#")
        target = (PAGES[page].parent / path).resolve() if path else PAGES[page]
        assert target.exists(), link
        if anchor:
            titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles], link


@pytest.mark.parametrize("page", PAGES)
def test_results_that_are_named_exist(page):
    named = re.findall(r"results/[\w./@-]*\w", text_of(page))
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", PAGES)
def test_numbers_are_those_of_results(page):
    numbers = list(numbers_of(page))
    assert [str(number) for number in numbers if not number.found] == [], "not in the text above"
    assert [f"{number}, which is {number.value:.6g}" for number in numbers if not number.agrees] == []


def test_the_main_tables_are_held_to_results():
    assert len(list(numbers_of("README.md"))) >= 30
    assert sum(len(list(numbers_of(page))) for page in PAGES) >= 300


def test_results_name_no_path_of_the_machine_that_made_them():
    files = [file for kind in ("*.json", "*.jsonl") for file in (ROOT / "results").rglob(kind)]
    assert len(files) >= 100
    place = re.compile(r"(?<![\w.])/(tmp|home|root|work|opt|mnt|usr)/")
    assert [str(file) for file in files if place.search(file.read_text())] == []


def test_a_wrong_number_is_found():
    number = next(numbers_of("README.md"))._replace(file="results/anymal/tables.json", expression="len(controllers)")
    assert number._replace(text=f"{number.value:.3f}").agrees and not number._replace(text="0.006").agrees


def settings_of(page: str, folder: Path) -> dict[str, str]:
    """Writes the robots' settings of a page into a folder, each under the name it has there; returns them."""
    settings = {
        text.split("\n")[0].removeprefix("# mine/"): text for text in code_of(page, "python") if "ROBOT =" in text
    }
    for name, text in settings.items():
        (folder / name).write_text(text)
    return settings


@pytest.mark.parametrize("page", ["README.md", "docs/own-robot.md"])
def test_the_robot_is_read(page, tmp_path):
    assert "dog.py" in settings_of(page, tmp_path)
    (tmp_path / "dog.xml").write_text(mjcf())
    dog = get_robot(str(tmp_path / "dog.py"))
    assert (dog.name, dog.num_joints, dog.observation_size) == ("dog", 8, 51)


def test_the_urdf_of_the_page_is_the_dog(tmp_path):
    settings_of("docs/own-robot.md", tmp_path)
    (text,) = code_of("docs/own-robot.md", "xml")
    leg = text[text.index('  <link name="FL_thigh">') : text.index("  <!-- FR, HL")]
    places = {"FR": "0.2 -0.12 0", "HL": "-0.2 0.12 0", "HR": "-0.2 -0.12 0"}
    others = [leg.replace("FL_", f"{name}_").replace("0.2 0.12 0", place) for name, place in places.items()]
    (tmp_path / "dog.urdf").write_text(text.replace("  <!-- FR, HL and HR likewise -->\n", "".join(others)))
    dog = get_robot(str(tmp_path / "dog_urdf.py"))
    builder = build_robot(dog)
    assert sum(builder.body_mass) == pytest.approx(MASS)
    assert (builder.body_count, effort_limits(builder)) == (9, [30.0] * 8)
    assert dog.default_base_height == 0.29


@pytest.mark.parametrize("file", ["a1.py", "anymal_b.py"])
def test_the_settings_of_public_robots_are_taken(file, tmp_path):
    settings_of("docs/own-robot.md", tmp_path)
    robot = runpy.run_path(str(tmp_path / file))["ROBOT"]
    assert len({*robot.joint_names}) == 12 and len({*robot.foot_geoms}) == 4 and len({*robot.limb_geoms}) == 8


def test_the_controller_of_readme_acts(tmp_path, anymal):
    (text,) = [code for code in code_of("README.md", "python") if "def act" in code]
    (tmp_path / "walk.py").write_text(text)
    actions = load_policy(f"{tmp_path}/walk.py:act", anymal, "cpu")(torch.randn(3, 235))
    assert actions.shape == (3, 12) and not actions.any()


def test_the_adapter_adapts(tmp_path, anymal):
    (text,) = code_of("docs/own-controller.md", "python")
    (tmp_path / "row.py").write_text(text)
    actor = rsl_rl_actor(3 * 3 + 3 * 12)
    policy = load_policy(
        f"{tmp_path}/row.py:adapt@{save_checkpoint(tmp_path / 'm.pt', actor.state_dict())}", anymal, "cpu"
    )
    row = torch.randn(5, 235, generator=torch.Generator().manual_seed(0))
    hind_first = [6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5]
    default = torch.tensor(anymal.default_joint_pos)
    parts = [4 * row[:, 3:6], row[:, 6:9], row[:, 9:12] / torch.tensor([2.0, 2.0, 0.25])]
    parts += [(row[:, 12:24] + default)[:, hind_first], 20 * row[:, 24:36][:, hind_first], row[:, 36:48][:, hind_first]]
    with torch.inference_mode():
        theirs = actor.mlp(torch.cat(parts, dim=1))
        expected = torch.empty(5, 12)
        expected[:, hind_first] = theirs
        torch.testing.assert_close(policy(row), expected, rtol=1e-4, atol=1e-4)


def test_the_map_of_a_script_is_a_ramp_across_the_way(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (text,) = code_of("docs/own-terrain.md", "python")
    Path("hill.py").write_text(text)
    runpy.run_path("hill.py")
    with np.load("hill.npz") as hill:
        assert hill["heights"].shape == (161, 321) and hill["heights"].dtype == np.float32
        at = hill["heights"][:, [0, 140, 170, 320]]  # x = 0, 7, 8.5 and 16 m
        np.testing.assert_allclose(at, np.tile([0, 0.15, 0.3, 0], (161, 1)), atol=1e-6)


def test_the_space_of_a_page_makes_ridges(tmp_path):
    (text,) = code_of("docs/own-space.md", "python")
    assert len(text.splitlines()) <= 30
    (tmp_path / "ridges.py").write_text(text)
    space = load_space(f"{tmp_path}/ridges.py:Ridges")
    genes = np.array([1.0, 0.0, 0.0])  # 0.3 m high, 0.9 m apart: crests at x = 8 m and 8.9 m
    heights = heights_of(genes[None], space)[0, 80]
    np.testing.assert_allclose(heights[[80, 160, 169, 178, 240]], [0, 0.3, 0, 0.3, 0], atol=1e-6)
    assert space.describe(genes) == "ridges of 0.30 m, 0.90 m apart"


@pytest.mark.slow
def test_the_script_of_a_page_searches_judges_crosses_and_trains(tmp_path, monkeypatch, capsys):
    (text,) = code_of("docs/search.md", "python")
    for page_size, small_size in (
        ("iterations=5)", "iterations=1, replicas=2, scheduler=SchedulerCfg(emitters=1, batch_size=4))"),
        ("iterations=100)", "iterations=1, num_envs=4, terrains=2)"),
    ):
        assert page_size in text
        text = text.replace(page_size, small_size)
    (tmp_path / "search.py").write_text("from qd.run.presets import SchedulerCfg\n" + text)
    (tmp_path / "results").symlink_to(ROOT / "results")
    monkeypatch.chdir(tmp_path)
    for name in ("search", "judge", "cross"):
        crossing = functools.partial(getattr(faultline, name), open_evaluator=open_stand_in)
        monkeypatch.setattr(faultline, name, crossing)
    runpy.run_path("search.py", run_name="__main__")
    assert Path("runs/mine-tuned/policy.pt").exists() and "elites" in capsys.readouterr().out


COMMANDS = ["archive", "train", "finetune", "harden", "evaluate", "report", "view", "bench"]
TARGETS = ["help", "setup", *COMMANDS, "test", "test-all", "test-gpu", "lint"]


def test_make_help_teaches_every_target_and_variable():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.findall(r"^([a-z-]+):.*## ", makefile, re.MULTILINE) == TARGETS
    assert re.findall(r"^(\w+) \?=", makefile, re.MULTILINE) == ["PYTHON", "ROBOT", "ARGS", "TORCH", "FAULTLINE_DEVICE"]
    assert [name for name in ("PYTHON", "ROBOT", "ARGS", "TORCH") if f"  {name}=" not in makefile] == []


@pytest.mark.parametrize("name", ["a b", "it's", '"#', "*ü\\", "`id`"])
def test_make_hands_the_robot_on_as_it_is(name):
    assert run_by_make(("make", "view")) == [".venv/bin/faultline", "view"]
    command = run_by_make(("make", "archive", f"ROBOT={name}", "ARGS=--preset small --seed 3"))
    assert command == [".venv/bin/faultline", "archive", "--robot", name, "--preset", "small", "--seed", "3"]


def test_the_quick_tests_leave_out_what_takes_long():
    assert run_by_make(("make", "test"))[-1] == "not slow and not ray"
    assert "-m" not in run_by_make(("make", "test-all"))[3:]
    assert run_by_make(("make", "test-gpu"))[0] == "FAULTLINE_DEVICE=cuda:0"
    assert "make test-all" in (ROOT / ".ci" / "run").read_text()
