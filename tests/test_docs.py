"""README and docs/ are true: commands are taken, code works, links lead somewhere, numbers are those of their files."""

import re
import runpy
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

import faultline
from kernels.course import SPACING
from qd.search import loop
from qd.workers import crosser
from sim.controllers.described import TERMS, Described, read_controller
from sim.controllers.loaders import load_policy
from sim.robots.compiled import robot_spec
from sim.robots.find import get_robot
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.elements.kinds import ELEMENTS
from sim.terrains.spaces.course import Course
from tests import docs as pages
from tests.docs import PAGES, ROOT, code_of, text_of
from tests.qd.stand_in import open_stand_in
from tests.sim.dogs import urdf


def test_pages_are_short_and_readme_leads_to_each():
    assert len(text_of("README.md").splitlines()) <= 130
    written = [re.sub("<!-- table:.*?<!-- end -->", "", text_of(page), flags=re.S) for page in PAGES]
    assert len(PAGES) <= 1 + 18 and sum(len(text.encode()) for text in written) <= 130_000  # tables are made
    assert set(re.findall(r"\]\((docs/[\w-]+\.md)", text_of("README.md"))) == set(PAGES) - {"README.md"}
    pictures = {Path(name).name for page in PAGES for name in re.findall(r"pictures/([\w.-]+)", text_of(page))}
    files = [*(ROOT / "docs/pictures").iterdir()]
    assert pictures == {file.name for file in files if file.suffix in (".jpg", ".png", ".gif")}


@pytest.mark.parametrize("line", sorted({line for page in PAGES for line in pages.commands_of(page)}))
def test_commands_are_taken(line):
    program, *flags = pages.run_by_make(shlex.split(line)) if line.startswith("make") else shlex.split(line)
    if program.endswith("faultline") and "--help" not in flags:
        tyro.cli(faultline.load_command(flags[0]), args=flags[1:])


@pytest.mark.parametrize("page", PAGES)
def test_links_figures_and_results_exist(page):
    for path, _, anchor in (link.partition("#") for link in re.findall(r"\]\(([^)\s]+)\)", text_of(page))):
        target = (PAGES[page].parent / path).resolve() if path else PAGES[page]
        assert "://" in path or target.exists(), path
        if anchor:
            titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles], anchor
    assert [name for name in re.findall(r"results/[\w./@-]*\w", text_of(page)) if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", PAGES)
def test_numbers_of_prose_are_those_of_their_sources(page):
    assert pages.unknown_numbers(page) == []
    for row in (row for row in pages.numbers() if row.page == page or row.text in pages.prose_of(page)):
        assert row.text in pages.prose_of(page) and row.is_rounded(row.value), f"{row.text}: {row.value:.6g}"


def test_the_elements_of_the_page_are_those_of_courses():
    rows, kinds = pages.table_of("element", "genes: size"), [ELEMENTS[name] for name in Course().kinds]
    for (name, *words, _, _), kind in zip(rows, kinds, strict=True):
        slopes, lengths = (re.findall(rf"{mark}(\d[\d.]*)", " ".join(words)) for mark in ("1:", r"(?<![\d.:])(?!1:)"))
        said = {1.0 / float(number) for number in slopes} | set(map(float, lengths))
        # Whole numbers are of cells, or of steps and pallets. A turn is a direction, or a shift by so many cells.
        ends = [{end, SPACING * end} for about in kind.ranges for end in about[:2]]
        assert all(any(np.isclose(number, [*end]).any() for end in ends) for number in said), (name, said, ends)
        for pair in re.findall(r"(?<![\d:.])(\d[\d.]*) to (\d[\d.]*)(?!:)", " ".join(words)):
            pairs = [
                (SPACING**cells * about.low, SPACING**cells * about.high) for about in kind.ranges for cells in (0, 1)
            ]
            assert any(np.allclose([*map(float, pair)], both) for both in pairs), (name, pair)
        for end in ends[:-2]:
            assert 0 in end or any(np.isclose(number, [*end]).any() for number in said), (name, said, end)


def test_the_conditions_of_the_page_are_those_of_spaces():
    shipped = {name: kind for name, kind in CONDITIONS.items() if type(kind).__module__.startswith("sim.")}
    order, kinds, known = [*shipped], [], {name: set() for name in shipped}
    for names, _, *numbers in pages.table_of("", "what it does", "gene of -1", "nominal"):
        if named := re.findall(r"`(\w+)`", names):
            kinds = order[order.index(named[0]) : order.index(named[-1]) + 1]
        for kind in kinds:
            known[kind].add(tuple(float(number.split()[0]) if number else None for number in numbers))
    for name, kind in shipped.items():
        ends = {(gene.low, gene.high): round(float(gene.to_value(gene.absent)), 9) for gene in kind.genes}
        assert {(low, high) for low, _, high in known[name]} == {*ends}, name
        assert all(nominal in (None, ends[low, high]) for low, nominal, high in known[name]), name  # None: none is


def test_the_robots_of_the_page_are_read(tmp_path):
    for text in (text for text in code_of("docs/robots.md", "python") if "ROBOT =" in text):
        (tmp_path / text.split("\n")[0].removeprefix("# mine/")).write_text(text)
    (tmp_path / "dog.urdf").write_text(urdf())
    model = robot_spec(get_robot(str(tmp_path / "dog_urdf.py"))).compile()
    assert model.actuator_forcerange[:, 1].tolist() == [30.0] * 8


def test_the_controllers_of_the_page_act(tmp_path, anymal):
    for text in code_of("docs/controllers.md", "python"):
        (tmp_path / re.findall(r"\w+\.py", text)[0]).write_text(text)
    row = torch.randn(5, 235)
    assert not load_policy(f"{tmp_path}/walk.py:act", anymal, "cpu")(row.clone()).any()
    # Its actor returns joint positions, which stand behind angular velocity, gravity and command in its row.
    adapted = runpy.run_path(str(tmp_path / "row.py"))["adapt"](lambda parts: parts[:, 9:21], anymal)(row)
    torch.testing.assert_close(adapted, row[:, 12:24], rtol=1e-5, atol=1e-6)


def test_the_description_of_the_page_is_read(tmp_path, anymal):
    (text,) = code_of("docs/controllers.md", "toml")
    (tmp_path / "controller.toml").write_text(text)
    robot = replace(anymal, scan_x=(0.0, 0.4, 0.8), scan_y=(-0.2, 0.2))
    described = Described(read_controller(tmp_path / "controller.toml"), robot, "it")
    # Five steps of four terms of three columns, three of six joints and a clock; one of six points.
    assert (described.observation_size, described.num_actions) == (5 * (4 * 3 + 3 * 6 + 2) + 6, 6)
    assert re.findall(r"^\| `(\w+)` \| [1-4a]", text_of("docs/controllers.md"), re.MULTILINE) == [*TERMS]


def test_the_map_of_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("hill.py").write_text(code_of("docs/terrains.md", "python")[0])
    runpy.run_path("hill.py")
    with np.load("hill.npz") as arrays:
        at = arrays["heights"][:, [0, 140, 170, 320]]  # x = 0, 7, 8.5 and 16 m
        np.testing.assert_allclose(at, np.tile([0, 0.15, 0.3, 0], (161, 1)), atol=1e-6)


@pytest.mark.slow
def test_the_script_of_a_page_searches_judges_crosses_and_trains(tmp_path, monkeypatch, capsys):
    (text,) = code_of("docs/searching.md", "python")
    smaller = "iterations=1, replicas=2, scheduler=SchedulerCfg(emitters=1, batch_size=4))"
    small = text.replace("iterations=5)", smaller).replace("iterations=100)", "iterations=1, num_envs=4, terrains=2)")
    (tmp_path / "search.py").write_text("from qd.search.presets import SchedulerCfg\n" + small)
    (tmp_path / "results").symlink_to(ROOT / "results")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(crosser, "open_pipeline", open_stand_in)
    monkeypatch.setattr(loop, "open_pipeline", open_stand_in)
    runpy.run_path("search.py", run_name="__main__")
    assert Path("runs/mine-tuned/policy.pt").exists() and "elites" in capsys.readouterr().out


def test_make_records_the_tests_of_a_gpu_where_all_of_them_run():
    record = "--record=results/bench/gpu-tests.json"
    assert pages.run_by_make(("make", "test-gpu"))[-3:] == ["-m", "gpu", record]
    assert pages.run_by_make(("make", "test-gpu", "ARGS=-k contact"))[-4:] == ["-m", "gpu", "-k", "contact"]


def test_make_hands_on_what_it_is_given():
    for name in ("a b", "it's", '"#', "*ü\\", "`id`"):
        command = pages.run_by_make(("make", "archive", f"ROBOT={name}", "ARGS=--preset small --seed 3"))
        assert command == [".venv/bin/faultline", "archive", "--robot", name, "--preset", "small", "--seed", "3"]
    assert pages.run_by_make(("make", "test"))[-1] == "not slow and not ray"
    assert "-m" not in pages.run_by_make(("make", "test-all"))[3:]
