"""README and docs/ are true: commands are taken, code works, links lead somewhere, numbers are those of results/."""

import importlib
import os
import re
import runpy
import shlex
import subprocess
import sys
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


@pytest.mark.parametrize("line", [line for page in PAGES for line in commands_of(page)], ids=str)
def test_commands_are_taken(line):
    words = list(line.words)
    if words[0] == "make":
        words = run_by_make(line.words)
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


@pytest.mark.parametrize(("digits", "off", "agrees"), [(3, 0, True), (2, 0, True), (3, 6e-3, False), (2, -1e-2, False)])
def test_a_wrong_number_is_found(digits, off, agrees):
    number = next(iter(numbers_of("README.md")))._replace(
        file="results/anymal/tables.json", expression="goal.hand_crafted.base"
    )
    assert number._replace(text=f"{number.value + off:.{digits}f}").agrees is agrees


def settings_of(page: str, folder: Path) -> dict[str, str]:
    """Writes the robots' settings of a page into a folder, each under the name it has there; returns them."""
    found = {text.split("\n")[0].removeprefix("# mine/"): text for text in code_of(page, "python") if "ROBOT =" in text}
    for name, text in found.items():
        (folder / name).write_text(text)
    return found


@pytest.mark.parametrize("page", ["README.md", "docs/own-robot.md"])
def test_the_robot_is_read(page, tmp_path):
    assert "dog.py" in settings_of(page, tmp_path)
    (tmp_path / "dog.xml").write_text(mjcf(drive=""))
    with pytest.raises(ValueError, match="no gains for FL_hip"):
        get_robot(str(tmp_path / "dog.py"))
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


# Links and joints as the two public URDFs call them, with their lengths: the joint before each link, or fixed.
A1 = """trunk box .267 .08 .114, trunk cylinder .057 .267, trunk cylinder .057 .267
hip_joint hip .1805 .047 0 cylinder .046 .04, thigh_joint thigh 0 .0838 0 box .034 .0245 .1
calf_joint calf 0 0 -.2 box .016 .016 .1, fixed foot 0 0 -.2 sphere .02"""
ANYMAL_B = """base box .531 .27 .24
HAA HIP .277 .116 0, HFE THIGH .0635 .041 0 cylinder .06 .12
KFE SHANK 0 .109 -.25, fixed ADAPTER .1 -.02 0 cylinder .015 .25, fixed FOOT 0 0 -.298 sphere .031"""


def public_urdf(shape: str, legs: str) -> str:
    """A URDF with the names and lengths of a public robot; its other legs are mirror images of the left front one."""
    sizes = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
    inertial = '<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'

    def geometry(kind: str = "", *values: str) -> str:
        values = (" ".join(values),) if kind == "box" else values
        attributes = " ".join(f'{name}="{value}"' for name, value in zip(sizes.get(kind, ()), values, strict=True))
        return f"<collision><geometry><{kind} {attributes}/></geometry></collision>" if kind else ""

    base, *rest = shape.split("\n")
    name = base.split()[0]
    parts = [f'<link name="{name}">{inertial}']
    parts += [geometry(*one.split()[1:]) for one in base.split(", ")] + ["</link>"]
    for leg in legs.split():
        before, hind, right = name, "F" not in leg, leg in ("FR", "RR", "RF", "RH")
        for one in ", ".join(rest).split(", "):
            joint, link, x, y, z, *form = one.split()
            x, y = float(x) * (-1 if hind else 1), float(y) * (-1 if right else 1)
            kind = "fixed" if joint == "fixed" else "revolute"
            axis = "1 0 0" if joint in ("hip_joint", "HAA") else "0 1 0"
            parts.append(
                f'<link name="{leg}_{link}">{inertial}{geometry(*form)}</link><joint name="{leg}_{joint}_{link}" '
                f'type="{kind}"><parent link="{before}"/><child link="{leg}_{link}"/><origin xyz="{x} {y} {z}"/>'
                f'<axis xyz="{axis}"/><limit lower="-3" upper="5" effort="30" velocity="20"/></joint>'
            )
            parts[-1] = parts[-1].replace(f"_{joint}_{link}", f"_{joint}") if kind == "revolute" else parts[-1]
            before = f"{leg}_{link}"
    return f'<robot name="it">{"".join(parts)}</robot>'


@pytest.mark.parametrize(
    ("file", "model", "text", "height"),
    [
        # Longest with hips out by 0.08 rad, thighs at 0.64, calves -1.2 from them:
        # (0.2 cos 0.64 + 0.2 cos 0.56) cos 0.08 - 0.0838 sin 0.08 + 0.02 = 0.342 m.
        ("a1.py", "a1_description/urdf/a1.urdf", public_urdf(A1, "FR FL RR RL"), 0.342),
        # Longest with thighs at 0.48 rad, knees -0.64 from them; the foot lies (0.1, -0.298) m from the knee:
        # 0.25 cos 0.48 + 0.298 cos 0.16 - 0.1 sin 0.16 + 0.031 = 0.531 m.
        ("anymal_b.py", "anymal_b/urdf/anymal_b.urdf", public_urdf(ANYMAL_B, "LF RF LH RH"), 0.531),
    ],
)
def test_the_settings_of_public_robots_fit_urdfs_with_their_names(tmp_path, file, model, text, height):
    assert file in settings_of("docs/own-robot.md", tmp_path)
    (tmp_path / model).parent.mkdir(parents=True)
    (tmp_path / model).write_text(text)
    robot = get_robot(str(tmp_path / file))
    assert robot.num_joints == 12
    assert effort_limits(build_robot(robot)) == pytest.approx(list(robot.effort_limit))
    assert robot.default_base_height == pytest.approx(height, abs=0.01)  # of 64 draws the longest


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
def test_the_script_of_a_page_searches_judges_crosses_and_trains(tmp_path):
    (text,) = code_of("docs/search.md", "python")
    for page_size, small_size in (
        ("iterations=5)", "iterations=1, replicas=2, scheduler=SchedulerCfg(emitters=1, batch_size=4))"),
        ("iterations=100)", "iterations=1, num_envs=4, terrains=2)"),
    ):
        assert page_size in text
        text = text.replace(page_size, small_size)
    (tmp_path / "search.py").write_text("from qd.run.presets import SchedulerCfg\n" + text)
    (tmp_path / "results").symlink_to(ROOT / "results")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    command = [sys.executable, "search.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=580)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs/mine-tuned/policy.pt").exists() and "elites" in done.stdout


COMMANDS = ["archive", "train", "finetune", "harden", "evaluate", "report", "view", "bench"]
TARGETS = ["help", "setup", *COMMANDS, "test", "test-all", "test-gpu", "lint"]


def test_make_help_teaches_every_target_and_variable():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.findall(r"^([a-z-]+):.*## ", makefile, re.MULTILINE) == TARGETS
    assert re.findall(r"^(\w+) \?=", makefile, re.MULTILINE) == ["PYTHON", "ROBOT", "ARGS", "TORCH", "FAULTLINE_DEVICE"]
    assert [name for name in ("PYTHON", "ROBOT", "ARGS", "TORCH") if f"  {name}=" not in makefile] == []


@pytest.mark.parametrize("name", ["a b", "it's", '"', "a#b", "a=b:c", "*", "ü\\", "`id`", "%", "~"])
def test_make_hands_the_robot_on_as_it_is(name):
    command = run_by_make(("make", "archive", f"ROBOT={name}", "ARGS=--preset small --seed 3"))
    assert command == [".venv/bin/faultline", "archive", "--robot", name, "--preset", "small", "--seed", "3"]


@pytest.mark.parametrize("target", [name for name in COMMANDS if name != "bench"])
def test_targets_call_the_command_of_their_name(target):
    assert run_by_make(("make", target)) == [".venv/bin/faultline", target]
    command = run_by_make(("make", target, "ROBOT=cassie"))
    assert command == shlex.split(f".venv/bin/faultline {target} --robot cassie")


def test_the_quick_tests_leave_out_what_takes_long():
    assert run_by_make(("make", "test"))[-1] == "not slow and not ray and not kills"
    assert "-m" not in run_by_make(("make", "test-all"))[3:]
    assert run_by_make(("make", "test-gpu"))[0] == "FAULTLINE_DEVICE=cuda:0"
    assert "make test-all" in (ROOT / ".ci" / "run").read_text()
