"""The report's page from end to end over made-up crossings, and figures of a search, by hand."""

import base64
import dataclasses
import io
import json
import re

import matplotlib.image
import numpy as np
import pytest
from PIL import Image

from kernels.episode import Outcome
from qd.faults.families import VERDICTS, rank, summarise_search
from qd.search.archive import read_archive, write_archive
from qd.show.elites import open_run
from qd.show.figures import draw_archive, draw_curves, relief, write_figures
from qd.show.report.page import TILE, choose_moments, draw_sheet, open_pages, percent
from qd.show.report.report import count_causes, write_report
from sim.controllers.spec import controller_hash
from sim.files.atomic import to_json
from sim.robots.robot import robot_identity
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, make_report, small_archive
from tests.qd.recordings import grouped_archive, make_run, minimal_of, recording_of, reporter, rows, text_of

SOURCE = r"data:image/webp;base64,([A-Za-z0-9+/=]+)"


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path)


@pytest.fixture
def reported(run, monkeypatch):
    """Makes reports whose figures are a dot, without close pictures: drawing takes most of the time."""
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    monkeypatch.setattr("qd.show.report.page.as_image", lambda figure: Image.new("RGB", (1, 1)))
    return reporter(run, monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A report with its figures, as anyone would get it; not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        return reporter(make_run(tmp_path_factory.mktemp("whole")), patch)(num_elites=2)


@pytest.mark.slow
def test_the_page_is_whole_and_fetches_nothing(whole):
    out, crossed = whole
    content = out.read_text()
    assert out.name == "report.html" and len(content) < 4_000_000 and str(out.parent.parent) not in content
    outside = re.sub(SOURCE, "", content)
    assert not re.search(r'https?://|url\((?!\))|@import|<link|<iframe|fetch\(|href|src="[^"]', outside)
    assert "default-src 'none'" in content and "<script>alert" not in content
    images = [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in re.findall(SOURCE, content)]
    assert all(image.std() > 1.0 for image in images)  # something is drawn
    # the sheet, one elite more of each cause than the two, maps of the two, curves and archive
    assert len(images) == 1 + len(crossed) + 2 + 2 and len(crossed) == len(set(crossed))


@pytest.mark.slow
def test_the_page_begins_with_the_sentence_and_has_the_numbers_of_the_files(whole):
    content, archive = whole[0].read_text(), read_archive(whole[0].parent)
    ranking, text = rank(archive, SUPER_GAUSSIAN, half_width=0.4, judged=True), text_of(content.encode())
    assert text.startswith(f"anymal: terrains that it fails {summarise_search(ranking, archive)}")
    failing = int((archive.fresh.goal_rate < 0.5).sum())
    assert f"failed {failing}" in text and "40 terrains and 160 episodes in 10 s" in text
    assert "for this page 5 of 20 11 to 47 %" in text
    for number in ranking.worst(2):
        row = ranking.find_row(number)
        assert f"{ranking.name(row)} Terrain {number}, {VERDICTS[int(ranking.verdict[row])]}, after" in text
    listed = re.findall(r'<td><i class="tile elites"[^>]*></i></td><td>(\d+)</td>', content)
    assert sorted(map(int, listed)) == list(range(20))


def test_bars_count_terrains_and_faults_by_cause():
    ranking = rank(grouped_archive(), SUPER_GAUSSIAN, half_width=0.4)
    verdict = ranking.verdict.copy()
    verdict[[0, 6, 7]] = VERDICTS.index("fault")
    causes = ("ridge",) * 6 + ("drop",) * 9 + ("",) * 5
    ranking = dataclasses.replace(ranking, verdict=verdict, causes=causes)
    drop, ridge = count_causes(ranking)
    assert drop == {"name": "drop", "failing": 9, "faults": 2, "share": 100 / 9, "tile": 6}
    assert ridge == {"name": "ridge", "failing": 6, "faults": 1, "share": 100 / 9, "tile": 0}
    many = tuple(f"cause {k}" for k in range(15)) + ("",) * 5
    *_, last = bars = count_causes(dataclasses.replace(ranking, causes=many))
    assert len(bars) == 10 and (last["name"], last["failing"], last["tile"]) == ("6 other causes", 6, None)


def test_the_controller_that_crosses_a_terrain_is_shown_beside(reported, run):
    certifier, archive = run / "certifiers" / "C-G.pt", read_archive(run)
    certifier.parent.mkdir()
    certifier.write_bytes(b"another controller")
    # all are confirmed; C-G crosses the first ten
    counts = np.where(np.arange(20)[:, None] < 10, [20, 0, 0, 0], [0, 20, 0, 0])
    judged = dataclasses.replace(
        archive, resolved_outcomes=np.tile([9, 11, 0, 0], (20, 1)), certifiers=("C-G",),
        certifier_sha256=(str(controller_hash(certifier)),), certifier_outcomes=counts[:, None],
        certifier_resolved_outcomes=counts[:, None],
    )  # fmt: skip
    write_archive(run / "archive.npz", judged)
    opened_run, failing = open_run(None, run), np.flatnonzero(archive.failing)
    assert opened_run.certifiers() == {"C-G": str(certifier)}
    assert [opened_run.certifier(number) for number in (failing[0], failing[-1])] == ["C-G", None]
    out, crossed = reported(num_elites=2)
    text = text_of(out.read_bytes())
    assert f"faults {(failing < 10).sum()} confirmed" in text and "Beside it C-G" in text and "MUJOCO_GL must" in text
    assert max(map(crossed.count, crossed)) == 2  # by both controllers


def test_the_other_controller_is_shown_at_the_same_moment_from_the_same_start():
    ends = [Outcome.TIME_OUT, Outcome.GOAL, Outcome.TIME_OUT]
    recording, arrives = recording_of(ends, [7.0, 14.0, 7.0]), recording_of([Outcome.GOAL] * 3, [14.0] * 3, frames=11)
    failure, beside = choose_moments(recording, arrives, {})
    # from x = 2 m to 7 m in 20 frames of 0.02 s, 0.25 m each: within 0.3 m of the end from the 19th on
    assert failure == (recording, 0, 0.38) and beside == (arrives, 0, 0.2)  # it has arrived by then
    other = recording_of([ends[0], ends[1], ends[1]], [8.0, 14.0, 14.0])
    assert choose_moments(recording, other, {})[1][1] == 1 and len(choose_moments(recording, None, {})) == 1


def test_small_pictures_stand_in_one_image():
    genes = np.stack([np.full(64, value, np.float32) for value in (-1.0, 0.0, 0.5, 1.0, 0.2)])
    sheet = draw_sheet(genes, SUPER_GAUSSIAN)
    image = Image.open(io.BytesIO(base64.b64decode(re.fullmatch(SOURCE, sheet["source"])[1])))
    assert image.size == (2 * TILE[0], 3 * TILE[1])  # the root of 5 / 2 is 1.6
    assert sheet["offsets"] == [(0, 0), (96, 0), (0, 48), (96, 48), (0, 96)]


def test_minimal_terrains_are_shown_where_there_are_some(reported, run):
    (first, second), _ = minimal_of(run, 2)
    row = "rise 1 of 2 0 0 to 9 % 12.0 failing"
    text = text_of(reported()[0].read_bytes())
    assert "2 minimal terrains" in text and f"{first} {row}" in text and f"{second} {row}" in text


@pytest.mark.parametrize("sizes", [(1, 0, 0), (11, 0, 0), (0, 0, 3)])
def test_archives_of_any_size_alone_and_without_fresh_values(reported, run, sizes):
    (run / "metrics.jsonl").unlink()
    (run / "config.json").unlink()
    write_archive(run / "archive.npz", dataclasses.replace(grouped_archive(sizes), iterations=4))
    text = text_of(reported()[0].read_bytes())
    assert "metrics.jsonl" in text and "config.json" in text
    assert text.count("Not judged yet") == 1 and "confirmed" not in text
    assert ("Why it fails" in text) == (sizes[2] == 0)


def test_what_cannot_be_crossed_is_left_out(reported, run):
    config = json.loads((run / "config.json").read_text())
    code = "tests.sim.policies:stand"
    config["settings"]["policy"] = code
    (run / "config.json").write_bytes(to_json(config))
    out, crossed = reported()  # code that only the run names is not run
    assert crossed == [] and code in text_of(out.read_bytes())
    out, crossed = reported(policy=code)
    assert crossed and "than was searched" not in (text := text_of(out.read_bytes()))
    assert re.search(f"faultline film --robot anymal --run .* --policy {code} films it", text)
    out, crossed = reported(policy=str(open_run(None, run).robot.policy_file))
    assert crossed and "another controller than was searched: anymal.pt" in text_of(out.read_bytes())


def test_an_archive_alone_of_another_controller_is_not_crossed_by_the_robots_own(reported, run):
    (run / "config.json").unlink()
    write_archive(run / "archive.npz", dataclasses.replace(read_archive(run), policy_sha256="f" * 64))
    out, crossed = reported()
    assert not crossed and "with a controller that is not at hand" in text_of(out.read_bytes())


def test_bad_input_is_refused_and_the_page_stays_as_it_was(reported, run, tmp_path):
    before = reported()[0].read_bytes()
    (run / "metrics.jsonl").write_text((run / "metrics.jsonl").read_text().splitlines()[0])
    for field, changes in (
        ("cassie", {"robot": "cassie"}), ("out", {"out": tmp_path / "folder"}), ("metrics.jsonl", {}),
        ("lost.json", {"tables": tmp_path / "lost.json"}), ("empty", {"run": tmp_path / "empty"}),
    ):  # fmt: skip
        with pytest.raises((ValueError, OSError), match=field):
            reported(**changes)
    write_archive(run / "archive.npz", dataclasses.replace(grouped_archive((0, 0, 0)), iterations=4))
    with pytest.raises(ValueError, match="elites"):
        reported()
    assert [file.read_bytes() for file in tmp_path.rglob("*.html")] == [before]


def test_a_share_is_none_or_all_only_if_it_is():
    texts = [percent(share) for share in (0.0, 1.0, 0.051, 0.9996, 0.0002, 0.998)]
    assert texts == ["0 %", "100 %", "5.1 %", "over 99.9 %", "less than 0.1 %", "99.8 %"]


MEASURES = ("success", "goal", "reward")


def tables():
    """Two controllers on four elites, of which the second mends one and breaks another."""
    made = make_report({"generated": {"base": [4, 4, 0, 0], "C-G": [4, 0, 4, 0]}})
    values, limits = {"base": 0.5, "C-G": None}, {"base": [0.1, 0.9], "C-G": None}
    made |= {measure: {"generated": values} for measure in (*MEASURES, "certified_goal")}
    made["intervals"] |= {measure: {"generated": limits} for measure in (*MEASURES, "certified_goal")}
    about = {"terrains": 2, "certifiers": {"C-G": 2}, "chosen_by": {"base": "searched"}}
    return made | {"certified": {"generated": about}}


@pytest.mark.slow
def test_tables_are_shown_where_they_are_asked_for(reported, run, anymal):
    assert "Controllers compared" not in text_of(reported()[0].read_bytes())
    file = run.parent / "tables.json"
    file.write_bytes(to_json({**robot_identity(anymal), **tables()}))
    text = text_of(reported(tables=file)[0].read_bytes())
    assert "Controllers compared From tables.json." in text
    assert "generated, held out (4) base 50 % (10 to 90) C-G -" in text
    assert "generated, held out: base -> C-G 1 1 1 1 4" in text  # mended, still failing, newly broken, fine, compared
    assert "generated, held out (2) base 50 % (10 to 90), searched C-G -" in text
    assert "None of these controllers" not in text
    write_archive(run / "archive.npz", dataclasses.replace(read_archive(run), policy_sha256="f" * 64))
    assert "None of these controllers" in text_of(reported(tables=file)[0].read_bytes())


def test_of_several_trainings_each_is_shown_and_the_mean_over_their_seeds():
    values, limits = {"base": 0.5, "C-G": 0.6, "C-G@1": 0.8}, {"base": [0.4, 0.6], "C-G": [0.5, 0.7], "C-G@1": None}
    over = {"mean": 0.7, "interval": None, "values": [0.6, 0.8]}
    several = {
        "controllers": {name: {"policy": name, "sha256": "0"} for name in values}, "terrains": {"near": 4},
        **{measure: {"near": values} for measure in MEASURES}, "episodes": 20, "differences": {},
        "intervals": {measure: {"near": limits} for measure in MEASURES},
        "over_seeds": {measure: {"near": {"C-G": over}} for measure in MEASURES},
    }  # fmt: skip
    macros = open_pages().get_template("macros.html").module
    text = text_of(macros.compared_tables(several).encode())
    rows = "base 50 % (40 to 60) C-G 60 % (50 to 70) C-G@1 80 % C-G, mean of 2 70 %"
    assert f"Goal reached controller near (4) {rows}" in text and "What became of" not in text


SETS = ("hand_crafted", "search-0")


def round_of(controller, faults):
    counts = {"elites": 40, "failing": 20, "confirmed": 18, "certified": 15}
    counts |= {"episodes": 1000, "faults": faults}
    return {"controller": controller, "search": f"search-{controller}", "certifiers": ["C-G"], **counts}


def hardening():
    # Of 13 terrains base crosses 4 and round-1 10: 7 are mended, 2 still failing, 1 newly broken, 3 fine.
    goals = {"base": [0] * 9 + [4] * 4, "round-1": [4] * 7 + [0] * 3 + [4] * 3}
    tables = make_report(dict.fromkeys(SETS, goals))
    rounds = [round_of("base", 12), round_of("round-1", 3)]
    return {"command": "faultline harden <b>", "robot": "anymal", "rounds": rounds, "tables": tables}


def written(run, **changes):
    """The run with its file."""
    (run / "rounds.json").write_bytes(to_json(hardening() | changes))
    return run


def test_the_page_has_the_numbers_of_the_rounds(tmp_path):
    choices = {"tune-1": {"kept": True, "why": "better"}, "tune-2": {"kept": False, "why": "<i>worse"}}
    run = written(tmp_path, choices=choices)
    text = text_of(write_report(run).read_bytes())
    for part in (
        "1 round of search and training: searches find 12 faults of anymal's controller before and 3 after",
        "base 1,000 40 20 18 15 12 C-G round-1 1,000 40 20 18 15 3 C-G", "hand-crafted base 31 % round-1 77 %",
        "base 31 % (8 to 62)", "search-0: base -> round-1 7 2 1 3 13",
        "tune-1 kept better tune-2 not kept <i>worse", "faultline harden <b>",
    ):  # fmt: skip
        assert part in text
    assert f"faultline report --run {tmp_path}/search-base " in text  # a command that works, wherever the run lies
    assert f"Made from {tmp_path.name}:" in text
    assert "report --robot anymal --run" in text_of(write_report(run, robot="anymal").read_bytes())
    one_search = {"rounds": [round_of("base", None)], "tables": {**hardening()["tables"], "differences": {}}}
    written(run, **one_search)
    assert "search-0: base" not in text_of(write_report(run).read_bytes())


def test_what_is_no_hardening_is_refused(tmp_path):
    with pytest.raises(ValueError, match="cassie"):
        write_report(written(tmp_path), robot="cassie")
    for changes in ({"rounds": []}, {"rounds": [{"controller": 3}]}, {"tables": {"episodes": 20}}):
        with pytest.raises(ValueError, match="rounds"):
            write_report(written(tmp_path, **changes))


def test_curves_show_what_the_metrics_say():
    figure = draw_curves(small_archive(), rows(4))
    left, middle, right, *_ = figure.axes
    assert left.lines[0].get_xydata().tolist() == [[1, 20], [2, 40], [3, 60], [4, 80]]
    assert middle.lines[0].get_ydata().tolist() == [5, 10, 15, 20]
    assert right.lines[0].get_ydata().tolist() == [2, 3, 4, 5]
    # two ratios have 10 reachable cells, so the right-hand scale is ten times the left-hand one
    figure.draw_without_rendering()
    (coverage,) = middle.child_axes
    assert coverage.get_ylim()[1] == pytest.approx(10 * middle.get_ylim()[1])


def test_archive_figure_has_a_line_an_elite_and_the_worst_on_top():
    archive = small_archive(4)
    (lines,) = draw_archive(archive).axes[0].collections
    np.testing.assert_array_equal([line[:, 1] for line in lines.get_segments()], archive.ratios[::-1])
    assert lines.get_array().tolist() == archive.fitness[::-1].tolist()
    # with fresh values those that are valid, in their order
    ratios = np.array([[0.1, 0.9], [0.2, 0.8], [0.3, 0.7], [0.4, 0.6]])
    fresh = dataclasses.replace(fresh_values(archive), ratios=ratios, invalid_episodes=np.array([0, 40, 0, 0]))
    (lines,) = draw_archive(dataclasses.replace(archive, fresh=fresh)).axes[0].collections
    assert np.allclose(lines.get_array(), archive.fitness[[3, 2, 0]] / 2)
    assert np.allclose([line[:, 1] for line in lines.get_segments()], ratios[[3, 2, 0]])


@pytest.mark.parametrize("num_elites", [0, 1])
def test_figures_are_files_for_archives_of_any_size(tmp_path, num_elites):
    files = write_figures(tmp_path, small_archive(num_elites), rows(1))
    assert [file.name for file in files] == ["curves.png", "archive.png"]
    assert all(matplotlib.image.imread(file).std() > 0.01 for file in files)  # something is drawn


@pytest.mark.parametrize("every", [1, 2])
def test_a_relief_is_blue_below_the_start_and_brown_above_with_start_and_goal(every):
    heights = np.zeros((161, 321), np.float32)
    heights[:, 100:160], heights[:, 160:220] = -0.4, 0.4
    pixels = relief(heights[::every, ::every])
    low, high = (pixels[40 // every, column // every].astype(int) for column in (130, 190))
    assert low[2] > low[0] and high[0] > high[2]
    # start at (2, 4) m and goal at (14, 4) m, nodes 0.05 m apart
    assert pixels[80 // every, 40 // every].tolist() == [240, 200, 60]
    assert pixels[80 // every, 280 // every].tolist() == [0, 158, 115]
