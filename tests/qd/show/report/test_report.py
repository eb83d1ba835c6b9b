"""The report's page from end to end, on small archives with made-up crossings: whole, true to its files, shut off."""

import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser

import matplotlib.image
import numpy as np
import pytest

from qd.archive import FaultCounts, read_archive, write_archive
from qd.groups import elites_of, rank
from qd.minimal import Case, Minimal
from qd.run.minimal_file import write_minimal
from qd.run.settings import as_settings, preset
from qd.show.figures import summary
from qd.show.report import command, pdf
from qd.show.report import page as page_module
from qd.show.report.command import Report
from qd.show.report.material import gather
from qd.show.report.page import MAX_BYTES, Section, absent, at_a_glance, heading, paragraph, render, table
from sim.files.atomic import to_json
from sim.files.command import Interrupted
from sim.files.figures import as_png, new_figure
from sim.robots.find import get_robot
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values
from tests.qd.recordings import stand_in_cross
from tests.qd.show.report.test_numbers import grouped_archive
from tests.qd.show.test_figures import rows

DOT = bytes.fromhex("89504e470d0a1a0a")
VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Text, resources, anchors and balance of a page."""

    def __init__(self, content: bytes) -> None:
        super().__init__()
        self.open, self.words, self.resources, self.links, self.ids = [], [], [], [], []
        self.feed(content.decode())
        self.close()
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        self.resources += [given[name] for name in ("src", "srcset", "data", "action") if name in given]
        self.links += [given["href"]] if "href" in given else []
        self.ids += [given["id"]] if "id" in given else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)


def make_run(root):
    """A whole run of 20 elites with fresh values."""
    archive, _ = grouped_archive()
    archive = dataclasses.replace(archive, iterations=4)
    archive = archive.corrected_by(fresh_values(archive))
    folder = root / "run"
    folder.mkdir()
    write_archive(folder / "archive.npz", archive)
    metrics = [{**row, "mean_duration_s": 15.0} for row in rows(4)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in metrics))
    small = preset("small", get_robot("anymal"))
    fitness = dataclasses.replace(small.fitness, penalties=archive.penalties, scales=archive.scales)
    settings = as_settings(dataclasses.replace(small, fitness=fitness))
    origin = {"command": "python <script>alert(1)</script>", "commit": "abc", "device": "CPU", "seed": 0,
              "versions": {"numpy": "2"}, "date": "today"}  # fmt: skip
    (folder / "config.json").write_bytes(to_json({"settings": settings, "iterations": 4, "sessions": [], **origin}))
    return folder


def reporter(run, patch):
    """Makes a report in a folder without published tables; returns the page and what was crossed."""
    patch.chdir(run.parent)
    patch.setattr(command, "check_policy", lambda policy, robot, device: None)

    def make(**changes):
        cfg = Report(**{"run": run, "device": "cpu", "episodes": 4, "elites": 1, **changes})
        crossed = []
        return command.html_report(cfg, cross=stand_in_cross(crossed)), crossed

    return make


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A report with its figures, as anyone would get it; not to be changed."""
    run = make_run(tmp_path_factory.mktemp("whole"))
    with pytest.MonkeyPatch.context() as patch:
        return reporter(run, patch)(elites=2)


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path)


@pytest.fixture
def reported(run, monkeypatch):
    """Makes reports whose figures are a dot, without rendered pictures: drawing takes most of the time."""
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    monkeypatch.setattr("sim.files.figures._png_of", lambda figure: DOT)
    return reporter(run, monkeypatch)


def test_the_page_is_whole_and_fetches_nothing(whole):
    out, crossed = whole
    run = out.parent
    assert out.name == "report.html" and run.name == "run"
    content = out.read_bytes()
    page = Page(content)
    assert page.open == [] and len(content) < MAX_BYTES
    assert page.resources and all(re.match("data:image/(png|jpeg);base64,", source) for source in page.resources)
    assert all(link.startswith("#") and link[1:] in page.ids for link in page.links)
    assert len(page.ids) == len(set(page.ids))
    outside = re.sub(rb"data:image/(png|jpeg);base64,[A-Za-z0-9+/=]+", b"", content)
    assert not re.search(rb"https?://|url\(|@import|<link|<iframe|fetch\(", outside)
    assert b"default-src 'none'" in content
    figures = sorted(path.name for path in (run / "report-figures").iterdir())
    assert len(figures) == len(page.resources)
    assert {"curves.png", "archive.png", "spread.png", "pairs.png", "modes.png", "elite-0.png"} <= set(figures)
    assert sum(name.startswith("failing-") for name in figures) == 2
    for name in figures:
        assert matplotlib.image.imread(run / "report-figures" / name).std() > 0.01  # something is drawn
    assert len(crossed) == len(set(crossed)) == sum(name.startswith("elite-") for name in figures)


def test_the_sentences_have_the_numbers_of_the_files(whole):
    text = Page(whole[0].read_bytes()).text
    archive = gather(Report(run=whole[0].parent)).archive
    elites, numbers = elites_of(archive), summary(archive, rows(4), gpus=0, origin={})
    failing = int((archive.fresh.goal_rate < 0.5).sum())
    assert f"The controller fails on {failing} of {len(archive)} elites judged (by 40 fresh episodes each" in text
    assert f"from {numbers['terrains_evaluated']} terrains and {numbers['episodes']} episodes" in text
    assert f"{numbers['invalid_episodes']} episodes were invalid" in text
    assert "(40 min of walking, simulated)" in text  # 160 episodes of 15 s
    assert "the archive grew from 5 to 20 elites, half of them found by iteration 2" in text
    assert "QD score, the sum of fitness above -20, rose from 20 to 80" in text
    assert f"The {failing} failing elites of 20 fall into 2 failure modes" in text
    assert f"{int(archive.collided.sum())} of 20 elites had a base collision" in text
    # of elite 0 four made-up crossings end each in its own way, at x = 6, 8.7, 11.3 and 14, the first at the goal
    at = np.median(np.linspace(6.0, 14.0, 4)[1:])
    assert (
        "1 of 4 robots reached the goal (base collision 1; out of time 1; left the terrain 1), and the middle one of "
        f"those that did not ended at x = {at:.1f} m" in text
    )
    assert f"Its fitness is {elites.fitness[0]:.1f} by 40 fresh episodes" in text
    assert "1 of 4 25 % 5 to 70 %" in text  # Wilson
    assert "Show 20 elites" in text


def test_the_first_chapter_says_what_breaks_the_controller_and_in_how_many_ways(reported, run):
    archive, _ = grouped_archive()  # 6 stuck, 9 collided, 5 across
    fresh = dataclasses.replace(
        fresh_values(archive),
        **{
            name: getattr(archive, name) for name in ("ratios", "goal_rate", "collision_rate", "fallen_rate", "fitness")
        },
    )
    # afresh, the six land in two cells and the nine in one, which is that of the five too
    fresh.cell[:] = [0, 0, 0, 1, 1, 1, *[2] * 14]
    write_archive(run / "archive.npz", dataclasses.replace(archive, iterations=4, fresh=fresh))
    text = Page(reported()[0].read_bytes()).text
    first = text[: text.index("From iteration 1")]
    assert (
        "The controller fails on 15 of 20 elites, in 2 ways. The robot strikes the terrain with its base (9, marked"
        in first
    )
    assert "; gets stuck (6, marked by yaw-rate error)." in first and "reaches the goal (" not in first
    assert (
        "15 of 20 failure modes: kinds of these 2 cells that these fall into: different shares of what goes wrong 3"
        in first
    )


def test_without_fresh_episodes_those_of_the_search_are_named(reported, run):
    archive, _ = grouped_archive()
    write_archive(run / "archive.npz", dataclasses.replace(archive, iterations=4, fresh=None))
    fitness, count = archive.fitness[0], archive.episodes[0]
    told = f"Its fitness is {fitness:.1f} by {count} episodes of the search, whose penalties"
    assert told in Page(reported()[0].read_bytes()).text


def test_where_it_comes_from_names_who_made_the_fresh_episodes_too(reported, run):
    again = {"command": "python -m qd.search --resume <b>", "commit": "def", "seed": 7}
    (run / "archive.json").write_bytes(to_json({"reproduced_by": again}))
    content = reported()[0].read_bytes()
    assert "Its search began with: command python <script>" in Page(content).text
    assert "fresh episodes: command python -m qd.search --resume <b> fresh episodes: commit def" in Page(content).text
    assert b'<table class="words">' in content  # a command of any length leaves the other cells in sight


@pytest.mark.parametrize("name", ["$\\foo$", "a\udcff"])
def test_names_that_are_no_formula_or_no_text_are_drawn_as_they_are(name):
    figure = new_figure(2.0, 1.0)
    figure.suptitle(name)
    assert as_png(figure).startswith(DOT)


def test_what_comes_from_files_is_escaped(whole):
    content = whole[0].read_text()
    assert "<script>alert" not in content and "&lt;script&gt;alert(1)" in content
    sorted_by = table(["<t>"], [["<r>"]], keys=[['"']], links=["'x"], folded="<s>")
    blocks = [paragraph("a < b & `x<y`"), heading("<h>", 'a"b'), absent("<i>", "make <x>"), sorted_by]
    blocks.append(at_a_glance([("<f>", "&")]))
    page = Page(render("<title>", "<lead>", [Section("<s>", "<a>", blocks)]))
    assert page.open == []
    for text in ("a < b & x<y", "<h>", "<i>", "make <x>", "<f>", "<t>", "<r>", "<title>", "<lead>"):
        assert text in page.text.replace("x<y", "x<y")
    assert 'a"b' in page.ids and "<a>" in page.ids and "#'x" in page.links


@pytest.mark.slow
def test_crossings_are_kept_and_a_stopped_report_goes_on(reported, run, monkeypatch):
    first, crossed = reported()
    before = first.read_bytes()
    assert crossed and reported()[1] == [] and first.read_bytes() == before
    kept = sorted((run.parent / "runs" / "recordings").iterdir())
    assert len(kept) == len(crossed)
    kept[0].write_bytes(kept[0].read_bytes()[:100])  # damaged: crossed again
    kept[1].unlink()
    assert len(reported()[1]) == 2
    assert len(reported(episodes=3)[1]) == len(crossed)  # other crossings

    cross, done = stand_in_cross([]), []

    def dying(wanted, progress):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.extend(wanted)
        return cross(wanted, progress)

    cfg = Report(run=run, device="cpu", episodes=5, elites=2)
    with pytest.raises(Interrupted, match=r"what was crossed is kept\. The same command goes on"):
        command.html_report(cfg, cross=dying)
    assert len(reported(episodes=5)[1]) == len(crossed) - 2


def test_sections_without_data_name_the_command_that_makes_it(reported, run):
    (run / "metrics.jsonl").unlink()
    (run / "config.json").unlink()
    text = Page(reported()[0].read_bytes()).text
    assert re.search(r"no metrics\.jsonl .* A search writes one: \S*faultline archive --robot anymal", text)
    assert "no config.json beside the archive" in text
    assert re.search(r"made by \S*faultline evaluate --robot anymal --policies base=shipped C-G=FILE", text)


@pytest.mark.parametrize("count", [1, 2, 11])
def test_archives_of_any_size_and_without_fresh_values(reported, run, count):
    archive, _ = grouped_archive((count, 0, 0))
    write_archive(run / "archive.npz", dataclasses.replace(archive, iterations=4))
    page = Page(reported()[0].read_bytes())
    assert f"of {count} elite{'s' * (count > 1)} judged (by the episodes that found them" in page.text
    assert ("95 % intervals (bootstrap over terrains)" in page.text) == (count == 11)
    assert "Over all elites 0 % of the robots" in page.text or count == 11
    assert page.open == []


def test_code_that_only_the_run_names_is_not_run(reported, run):
    config = json.loads((run / "config.json").read_text())
    config["settings"]["policy"] = "tests.sim.policies:stand"
    (run / "config.json").write_bytes(to_json(config))
    out, crossed = reported()
    assert crossed == []
    assert "name it with --policy tests.sim.policies:stand" in Page(out.read_bytes()).text
    assert reported(policy="tests.sim.policies:stand")[1]


def test_a_controller_that_cannot_be_loaded_leaves_its_crossings_out(reported, monkeypatch):
    def refuse(policy, robot, device):
        raise ValueError("no such controller <x>")

    monkeypatch.setattr(command, "check_policy", refuse)
    out, crossed = reported()
    assert crossed == []
    assert "cannot be loaded: no such controller <x>" in Page(out.read_bytes()).text
    with pytest.raises(ValueError, match="no such controller"):
        reported(policy="lost.pt")


def test_bad_input_is_refused_before_any_work(reported, run, tmp_path, monkeypatch):
    def refused(error, message, **changes):
        with pytest.raises(error, match=message):
            reported(**changes)
        assert not list(tmp_path.rglob("*.html")) and not list(tmp_path.rglob("report-*"))

    refused(ValueError, "unknown robot 'spot': expected one of anymal", robot="spot")
    refused(ValueError, "is of anymal, got --robot cassie", robot="cassie")
    refused(FileNotFoundError, "no archive at", run=tmp_path / "nothing")
    refused(FileNotFoundError, "no tables at .*faultline evaluate", tables=tmp_path / "nothing.json")
    refused(ValueError, r"out must be a file named \*\.html, got", out=tmp_path / "folder")
    (tmp_path / "blocked").write_text("a file")
    refused(ValueError, "cannot write to .*blocked", out=tmp_path / "blocked" / "report.html")
    (tmp_path / "damaged.json").write_text("{")
    refused(ValueError, "must be a JSON file", tables=tmp_path / "damaged.json")
    refused(ValueError, "elites must be at least 1 and at most 10, got 0", elites=0)
    whole = (run / "archive.npz").read_bytes()
    (run / "archive.npz").write_bytes(whole[: len(whole) // 2])
    refused(ValueError, "must be the archive of a search, but it is damaged")
    (run / "archive.npz").unlink()
    refused(ValueError, r"got one without archive\.npz: let it go on with `.*faultline archive --resume ")
    (run / "archive.npz").write_bytes(whole)
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[:2]))
    refused(ValueError, "a row for each of the archive's 4 iterations, got 2: the run is half-written")
    (run / "metrics.jsonl").write_text("".join(lines))
    write_archive(run / "archive.npz", dataclasses.replace(grouped_archive((0, 0, 0))[0], iterations=4))
    refused(ValueError, "must have elites to report on, got an archive of none after 4 iterations")
    other = dataclasses.replace(grouped_archive()[0], iterations=4, penalties=("yaw_rate", "<b>"))
    write_archive(run / "archive.npz", other)
    refused(ValueError, "penalties that robot anymal does not have: <b>")


@pytest.mark.slow
def test_a_page_is_whole_or_as_it_was(reported, run, monkeypatch):
    out, _ = reported()
    before = out.read_bytes()

    def full(path, data):
        raise OSError("no space left")

    monkeypatch.setattr(page_module, "write_atomically", full)
    with pytest.raises(OSError, match="no space left"):
        reported(elites=1)
    assert out.read_bytes() == before


def test_published_results_are_not_written_to(monkeypatch, tmp_path, run):
    monkeypatch.chdir(tmp_path)
    published = tmp_path / "results" / "anymal" / "archive"
    published.parent.mkdir(parents=True)
    run.rename(published)
    material = gather(Report())
    assert str(material.run) == "results/anymal/archive"
    assert str(material.out) == "runs/anymal-published/report.html"


def minimal_of(run, count=1):
    """The first failing elites of a run, each with its first part alone as the minimal terrain."""
    archive = read_archive(run)
    numbers = np.flatnonzero(archive.failing)[:count].tolist()
    cases = {n: Case(parts=(0, 1), how="greedy", scalable=True) for n in numbers}
    never, much = np.array([0, 40, 0, 0]), np.array([20, 0, 0, 0])
    one = Minimal(parts=(0,), counts=never, without={0: much}, scale=0.5, passing_scale=None, scales={}, subsets=1)
    genes = dict(zip(numbers, archive.genes[numbers], strict=True))
    write_minimal(run, archive, cases, dict.fromkeys(numbers, one), archive.rows(np.array(numbers)), genes)
    entries = [
        {"elite": n, "cell": int(archive.cell[n]), "iteration": int(archive.iteration[n]), "bumps": [0],
         "words": ["bump of <0.24> m"], "of": 2, "goal_rate": 0.0, "goal_interval": [0.0, 0.088],
         "cause": {"bump": 0, "kind": "rise"}, "margin_m": 0.12, "verdict": "failing"}
        for n in numbers
    ]  # fmt: skip
    (run / "minimal.json").write_bytes(to_json({"elites": entries}))
    return numbers, entries


@pytest.mark.slow
def test_minimal_terrains_are_shown_where_there_are_some(reported, run):
    text = Page(reported()[0].read_bytes()).text
    assert re.search(r"there is no minimal\.json of these elites\. It is made by \S*faultline minimise", text)
    (first, second), entries = minimal_of(run, 2)
    out = reported()[0]
    text = Page(out.read_bytes()).text
    assert "Parts of 2 failing terrains were taken away" in text
    assert "It takes 1 part to fail (median), in 2 of them a single one." in text and "12.0 cm (median)" in text
    row = " 0 % 0 to 9 % 1 of 2 rise 12.0 failing bump of <0.24> m"
    assert f"{first}{row}" in text and f"{second}{row}" in text
    assert (out.with_name("report-figures") / "minimal.png").exists()
    entries[0]["cell"] += 1  # the search went on: another elite has that number now
    (run / "minimal.json").write_bytes(to_json({"elites": entries}))
    text = Page(reported()[0].read_bytes()).text
    assert "Parts of 1 failing terrain were taken away" in text and f"{first}{row}" not in text


def test_minimal_files_that_do_not_belong_together_are_refused(reported, run):
    _, entries = minimal_of(run, 2)
    (run / "minimal.json").write_bytes(to_json({"elites": entries[:1]}))
    with pytest.raises(ValueError, match=r"must hold the 1 minimal terrain of minimal\.json, got one of 2"):
        reported()
    (run / "minimal.json").write_bytes(to_json({"elites": [{}]}))
    with pytest.raises(ValueError, match=r"minimal\.json must hold minimal terrains, but it is damaged"):
        reported()


def test_a_terrain_that_is_crossed_is_in_no_failure_mode(reported, run):
    archive = read_archive(run)
    again = dataclasses.replace(archive.fresh, goal_rate=np.ones(20), collision_rate=np.zeros(20))
    write_archive(run / "archive.npz", dataclasses.replace(archive, fresh=again))
    text = Page(reported()[0].read_bytes()).text
    assert "The controller fails on 0 of 20 elites." in text and "No elite fails, so there is no failure mode." in text


def test_every_row_of_all_elites_opens_a_picture(whole):
    content = whole[0].read_text()
    rows = content[content.index('id="all"') :]
    pictures = re.findall(
        r'<tr data-opens="data:image/jpeg;base64,([A-Za-z0-9+/=]+)" data-shows="Elite (\d+) from', rows
    )
    assert sorted(int(number) for _, number in pictures) == list(range(20))
    assert len({picture for picture, _ in pictures}) == 20


def test_without_opengl_terrains_are_shown_from_above(reported, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    out = reported()[0]
    assert "Where robots end on them is not shown. pictures need OpenGL" in Page(out.read_bytes()).text
    assert len(list(out.with_name("report-figures").glob("failing-*.jpg"))) == 2


def test_paths_of_the_machine_are_left_out(whole):
    assert str(whole[0].parent.parent) not in whole[0].read_text()


@pytest.mark.slow
def test_a_short_form_is_printed_as_a_pdf(reported, run, monkeypatch):
    monkeypatch.setattr(pdf.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=r"a PDF is printed by a browser, and none of chromium, .* install one"):
        reported(format="pdf")
    monkeypatch.undo()
    if not any(map(shutil.which, pdf._BROWSERS)):
        pytest.skip("there is no browser: apt-get install chromium")
    monkeypatch.chdir(run.parent)
    with pytest.raises(ValueError, match=r"out must be a file named \*\.pdf, got"):
        reporter(run, monkeypatch)(format="pdf", out=run / "x.html")
    out, _ = reporter(run, monkeypatch)(format="pdf")
    assert out == run / "report.pdf" and out.read_bytes().startswith(b"%PDF-") and out.stat().st_size > 20_000


def test_the_page_leads_with_what_fails_one_terrain_a_mode(whole):
    page = whole[0].read_bytes()
    text = Page(page).text
    first = text[: text.index("The smallest terrains that still break it", text.index("judged (by"))]
    assert page.index(b'class="cards"') < page.index(b"judged (by")
    assert "Which of these are faults, terrains that another controller crosses, is not known yet." in first
    assert page.index(b'id="outcome"') < page.index(b'id="minimal"') < page.index(b'id="terrains"')
    archive = gather(Report(run=whole[0].parent)).archive
    for number in rank(archive, SUPER_GAUSSIAN, judged=True).leaders():
        assert re.search(rf"Elite {number}, failing: goal reached \d of 4", first)


def test_faults_are_told_where_other_controllers_crossed_what_fails(run, reported, whole):
    assert "not known to be passable" not in Page(whole[0].read_bytes()).text
    archive = read_archive(run)
    # everybody fails with contact resolved; C-G crosses the first ten elites in both settings, and none of the others
    under, over = np.tile([9, 11, 0, 0], (20, 1)), np.where(np.arange(20)[:, None] < 10, [20, 0, 0, 0], [0, 20, 0, 0])
    faults = FaultCounts(
        resolved_outcomes=under, mujoco_c_outcomes=0 * under, certifiers=("C-G",), certifier_sha256=("a" * 64,),
        certifier_outcomes=over[:, None], certifier_resolved_outcomes=over[:, None],
    )  # fmt: skip
    write_archive(run / "archive.npz", dataclasses.replace(archive, faults=faults))
    count, failing = int(archive.failing[:10].sum()), int(archive.failing.sum())
    assert 0 < count < failing
    text = Page(reported()[0].read_bytes()).text
    assert f"faults: elites that C-G crosses and this controller does not {count}" in text
    assert f"{count} faults: terrains that C-G crosses and this controller does not. The controller fails" in text
    assert f"{failing - count} failing elites are not known to be passable." in text
    assert len(re.findall(r"(?<=\s)fault(?=\s)", text)) >= count  # a row each in the table of all elites
