"""The report's page from end to end, on small archives with made-up crossings: whole, true to its files, shut off."""

import dataclasses
import json
import re

import matplotlib.image
import numpy as np
import pytest

from qd.archive import FaultCounts, read_archive, write_archive
from qd.groups import elites_of, rank
from qd.show.figures import summary
from qd.show.report import page as page_module
from qd.show.report import report
from qd.show.report.page import MAX_BYTES, Section, absent, at_a_glance, paragraph, percent, render, table
from sim.files.atomic import to_json
from sim.files.command import Interrupted
from sim.files.figures import as_png, new_figure
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values
from tests.qd.recordings import stand_in_cross
from tests.qd.show.report.pages import DOT, Page, make_run, minimal_of, reporter
from tests.qd.show.test_figures import rows
from tests.qd.test_groups import grouped_archive


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A report with its figures, as anyone would get it; not to be changed."""
    run = make_run(tmp_path_factory.mktemp("whole"))
    with pytest.MonkeyPatch.context() as patch:
        return reporter(run, patch)(num_elites=2)


def test_the_page_is_whole_and_fetches_nothing(whole):
    out, crossed = whole
    content = out.read_bytes()
    page = Page(content)
    assert out.name == "report.html" and page.open == [] and len(content) < MAX_BYTES
    assert page.resources and all(re.match("data:image/(png|jpeg);base64,", source) for source in page.resources)
    assert all(link.startswith("#") and link[1:] in page.ids for link in page.links)
    assert len(page.ids) == len(set(page.ids))
    outside = re.sub(rb"data:image/(png|jpeg);base64,[A-Za-z0-9+/=]+", b"", content)
    assert not re.search(rb"https?://|url\(|@import|<link|<iframe|fetch\(", outside)
    assert b"default-src 'none'" in content and str(out.parent.parent).encode() not in content
    figures = sorted(path.name for path in (out.parent / "report-figures").iterdir())
    assert len(figures) == len(page.resources)
    assert {"curves.png", "archive.png", "spread.png", "modes.png", "elite-0.png"} <= set(figures)
    assert sum(name.startswith("failing-") for name in figures) == 6
    for name in figures:
        assert matplotlib.image.imread(out.parent / "report-figures" / name).std() > 0.01  # something is drawn
    assert len(crossed) == len(set(crossed)) == sum(name.startswith("elite-") for name in figures)


def test_the_page_has_the_numbers_of_the_files(whole):
    content = whole[0].read_text()
    text, archive = Page(content.encode()).text, read_archive(whole[0].parent)
    elites, numbers = elites_of(archive), summary(archive, rows(4), gpus=0, origin={})
    failing = int((archive.fresh.goal_rate < 0.5).sum())
    at = np.median(np.linspace(6.0, 14.0, 4)[1:])  # of elite 0 four made-up crossings end, the first at the goal
    for part in (
        f"fails on {failing} of {len(archive)} elites", f"{numbers['terrains_evaluated']} terrains",
        f"{numbers['episodes']} episodes", f"x = {at:.1f} m",
        f"{elites.fitness[0]:.1f} by 40 fresh episodes", "1 of 4 25 % 5 to 70 %",  # Wilson
    ):  # fmt: skip
        assert part in text
    for number in rank(archive, SUPER_GAUSSIAN, judged=True).leaders():
        assert re.search(rf"Elite {number}, failing: goal reached \d of 4", text)
    listed = content[content.index('id="all"') :]
    opened = re.findall(r'<tr data-opens="data:image/jpeg;base64,(\S+)" data-shows="Elite (\d+) from', listed)
    assert sorted(int(number) for _, number in opened) == list(range(20)) and len({image for image, _ in opened}) == 20
    assert "<script>alert" not in content and "&lt;script&gt;alert(1)" in content


def test_the_lead_counts_the_ways_in_which_the_controller_breaks(reported, run):
    archive, _ = grouped_archive()  # 6 stuck, 9 collided, 5 across
    names = ("ratios", "goal_rate", "collision_rate", "fallen_rate", "fitness")
    fresh = dataclasses.replace(fresh_values(archive), **{name: getattr(archive, name) for name in names})
    # afresh, the six land in two cells and the nine in one, which is that of the five too
    fresh.cell[:] = [0, 0, 0, 1, 1, 1, *[2] * 14]
    write_archive(run / "archive.npz", dataclasses.replace(archive, iterations=4, fresh=fresh))
    out = reported()[0]
    text = Page(out.read_bytes()).text
    first = text[: text.index("From iteration 1")]
    assert "15 of 20 elites, in 2 ways." in first and "gets stuck (6, marked by yaw-rate error)" in first
    assert re.search("15 of 20 failure modes.* 2 cells .* 3 ", first)
    assert "OpenGL" in text  # without it terrains are shown from above
    assert len(list(out.with_name("report-figures").glob("failing-*.jpg"))) == 6


def test_what_is_put_into_a_page_is_escaped():
    sorted_by = table(["<t>"], [["<r>"]], keys=[['"']], links=["'x"], folded="<s>")
    blocks = [paragraph("a < b & `x<y`"), absent("<i>", "make <x>"), sorted_by, at_a_glance([("<f>", "&")])]
    page = Page(render("<title>", "<lead>", [Section("<s>", "<a>", blocks)]))
    assert page.open == [] and "<a>" in page.ids and "#'x" in page.links
    for text in ("a < b & x<y", "<i>", "make <x>", "<f>", "<t>", "<r>", "<title>", "<lead>"):
        assert text in page.text


@pytest.mark.parametrize("name", ["$\\foo$", "a\udcff"])
def test_names_that_are_no_formula_or_no_text_are_drawn_as_they_are(name):
    figure = new_figure(2.0, 1.0)
    figure.suptitle(name)
    assert as_png(figure).startswith(DOT)


def test_crossings_are_stored_and_a_stopped_report_goes_on(reported, run):
    cross, done = stand_in_cross([]), []

    def dying(wanted, progress):
        if done:
            raise KeyboardInterrupt
        done.extend(wanted)
        return cross(wanted, progress)

    with pytest.raises((KeyboardInterrupt, Interrupted)):
        report.write_report(run, device="cpu", episodes=4, num_elites=1, cross=dying)
    out, crossed = reported()
    before = out.read_bytes()
    assert crossed and done[0].label not in crossed
    assert reported()[1] == [] and out.read_bytes() == before
    assert len(reported(episodes=3)[1]) == len(crossed) + 1  # other crossings


def test_minimal_terrains_are_shown_where_there_are_some(reported, run):
    (first, second), entries = minimal_of(run, 2)
    out = reported()[0]
    text = Page(out.read_bytes()).text
    assert "1 part to fail (median), in 2 of them a single one" in text and "12.0 cm (median)" in text
    row = " 0 % 0 to 9 % 1 of 2 rise 12.0 failing bump of <0.24> m"
    assert f"{first}{row}" in text and f"{second}{row}" in text
    assert (out.with_name("report-figures") / "minimal.png").exists()
    entries[0]["cell"] += 1  # the search went on: another elite has that number now
    (run / "minimal.json").write_bytes(to_json({"elites": entries}))
    text = Page(reported()[0].read_bytes()).text
    assert f"{first}{row}" not in text and f"{second}{row}" in text


def test_faults_are_counted_where_other_controllers_crossed_what_fails(run, reported):
    archive = read_archive(run)
    # everybody fails with contact resolved; C-G crosses the first ten elites in both settings, and none of the others
    under, over = np.tile([9, 11, 0, 0], (20, 1)), np.where(np.arange(20)[:, None] < 10, [20, 0, 0, 0], [0, 20, 0, 0])
    faults = FaultCounts(
        resolved_outcomes=under, certifiers=("C-G",), certifier_sha256=("a" * 64,),
        certifier_outcomes=over[:, None], certifier_resolved_outcomes=over[:, None],
    )  # fmt: skip
    write_archive(run / "archive.npz", dataclasses.replace(archive, faults=faults))
    count, failing = int(archive.failing[:10].sum()), int(archive.failing.sum())
    assert 0 < count < failing
    text = Page(reported()[0].read_bytes()).text
    assert f"{count} faults: terrains that C-G crosses and this controller does not" in text
    assert f"{failing - count} failing elites are not known" in text
    assert len(re.findall(r"(?<=\s)fault(?=\s)", text)) >= count  # a row each in the table of all elites


@pytest.mark.parametrize("count", [1, 11])
def test_archives_of_any_size_alone_and_without_fresh_values(reported, run, count):
    archive, _ = grouped_archive((count, 0, 0))
    (run / "metrics.jsonl").unlink()
    (run / "config.json").unlink()
    write_archive(run / "archive.npz", dataclasses.replace(archive, iterations=4))
    page = Page(reported()[0].read_bytes())
    assert page.open == [] and "metrics.jsonl" in page.text and "config.json" in page.text
    assert f"{archive.fitness[0]:.1f} by {archive.episodes[0]} episodes of the search" in page.text
    assert ("bootstrap over terrains" in page.text) == (count == 11)


def test_what_cannot_be_crossed_is_left_out(reported, run, monkeypatch):
    config = json.loads((run / "config.json").read_text())
    code = "tests.sim.policies:stand"
    config["settings"]["policy"] = code
    (run / "config.json").write_bytes(to_json(config))
    out, crossed = reported()  # code that only the run names is not run
    assert crossed == [] and code in Page(out.read_bytes()).text
    assert reported(policy=code)[1]
    config["settings"]["policy"] = "shipped"
    (run / "config.json").write_bytes(to_json(config))

    def refuse(policy, robot, device):
        raise ValueError("no such controller <x>")

    monkeypatch.setattr(report, "check_policy", refuse)
    out, crossed = reported()
    assert crossed == [] and "no such controller <x>" in Page(out.read_bytes()).text
    with pytest.raises(ValueError, match="no such controller"):
        reported(policy="lost.pt")


def test_bad_input_is_refused_and_the_page_stays_as_it_was(reported, run, tmp_path, monkeypatch):
    before = reported()[0].read_bytes()

    def refused(error, field, **changes):
        with pytest.raises(error, match=field):
            reported(**changes)
        assert [file.read_bytes() for file in tmp_path.rglob("*.html")] == [before]

    refused(ValueError, "cassie", robot="cassie")
    refused(ValueError, "out", out=tmp_path / "folder")
    with monkeypatch.context() as patch:
        patch.setattr(page_module, "write_atomically", lambda path, data: (path / "full").stat())
        refused(OSError, "full")
    whole = (run / "archive.npz").read_bytes()
    (run / "archive.npz").unlink()
    refused(ValueError, r"archive\.npz")
    (run / "archive.npz").write_bytes(whole)
    lines = (run / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[:2]))
    refused(ValueError, r"metrics\.jsonl")
    (run / "metrics.jsonl").write_text("".join(lines))
    write_archive(run / "archive.npz", dataclasses.replace(grouped_archive((0, 0, 0))[0], iterations=4))
    refused(ValueError, "elites")


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1.0, "100 %"), (0.051, "5.1 %"), (0.9996, "over 99.9 %"), (0.0002, "less than 0.1 %"),
     (0.998, "99.8 %")],
)  # fmt: skip
def test_a_share_is_none_or_all_only_if_it_is(share, text):
    assert percent(share) == text
