"""Terrains again: numbers, drawings, recordings and files of them, and which terrains a command line names."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from kernels.episode import Invalidity, Outcome
from qd.faults.families import rank
from qd.search.archive import write_archive
from qd.search.descriptors import Cells
from qd.search.directory import RunDirectory
from qd.show.commands import ExportCommand, ReplayCommand
from qd.show.crossed import draw_crossing
from qd.show.elites import OpenedRun, open_run
from qd.show.export import export_controller, export_elites, export_pack
from qd.show.recordings import Recordings, request_elite
from qd.show.replay import compute_numbers, describe, replay, source_from_map, source_from_run
from qd.show.view.viewed import open_viewed_run
from sim.controllers.spec import controller_hash, controller_identity
from sim.files.command import run_command
from sim.robots.robot import robot_identity
from sim.terrains.bank import make_heights
from sim.terrains.maps.heightmap import as_terrain, read_heightmap
from sim.terrains.spaces.registry import get_space
from sim.terrains.terrains import GroundMaps, Terrains
from tests.builders import fresh_values, small_archive, steered_archive, write_run
from tests.qd.recordings import FRAMES, make_run, minimal_of, recording_of, stand_in_cross
from tests.qd.searches import CFG

STAND = "tests.sim.policies:stand"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def opened_run(tmp_path, anymal):
    ratios = np.array([[0.35, 0.65]])
    archive = dataclasses.replace(
        small_archive(1), ratios=ratios, cell=Cells(2).find_cells(ratios), penalty_mean=np.array([[2.0, 3.0]]),
        penalty_std=np.array([[1.0, 0.5]]), fitness=np.array([3.25]), collision_rate=np.array([0.25]),
        goal_rate=np.array([0.75]), fallen_rate=np.array([0.0]),
    )  # fmt: skip
    return OpenedRun(path=tmp_path, archive=archive, robot=anymal)


@pytest.fixture
def recording(anymal):
    """Raw sums of four episodes; scales .5 and 2 make them (4, 8), a ratio of 1/3."""
    sums = np.tile([2.0, 16.0, 0.0, 0.0, 0.0, 0.0], (4, 1))
    outcomes = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.GOAL, Outcome.GOAL]
    made = recording_of(outcomes, [5.0, 14.0, 14.0, 14.0], penalties=sums)
    return dataclasses.replace(made, origin=controller_identity(anymal, "shipped") | {"space": "super_gaussian"})


def test_a_command_about_a_run_keeps_its_paths_and_names_code(opened_run, tmp_path, monkeypatch):
    dog = dataclasses.replace(opened_run.robot, settings_file=Path("/mine/dog/robot.toml"))
    run = dataclasses.replace(opened_run, path=tmp_path / "runs" / "a", robot=dog)
    assert run.command("film", elite=3) == "faultline film --robot /mine/dog/robot.toml --run runs/a --elite 3"
    space = SimpleNamespace(name="/mine/hills.py:Hills", sha256="a" * 64)
    monkeypatch.setattr("qd.search.archive.get_space", lambda name, sha256: space)
    assert run.command("judge").endswith("--run runs/a --space /mine/hills.py:Hills")


def lines_of(opened_run, recording, policy=None):
    source = source_from_run(opened_run, policy=policy)
    lines = describe(source, source.terrains[0], recording).splitlines()
    assert max(map(len, lines)) <= 80
    return [" ".join(line.split()) for line in lines]


def test_an_elites_numbers_are_raw_with_units_beside_the_fresh_ones(opened_run, recording, anymal):
    lines = lines_of(opened_run, recording)
    assert lines[0] == "ANYmal C, made up: reaches the goal, 3 of 4"
    assert "yaw-rate error 1.00±0.50, 35% 2.00±0.00, 33%" in lines
    assert "forward-velocity error 6.00±1.00, 65% 16.00±0.00, 67%" in lines
    # Wilson, z^2 = 3.8415, of 1 of 4: (.25 + .4802 +- 1.96 sqrt(.0469 + .0600)) / 1.9604 = .3725 +- .3269
    assert "base collision 25% (5-70%) 25% (5-70%)" in lines
    assert "reaches the goal 75% (30-95%) 75% (30-95%)" in lines
    assert "fitness 3.25 10.50" in lines  # fresh: 4 + 8 - 0 - 2 * 3/4
    dear = np.tile([16.0, 2.0, 0.0, 0.0, 0.0, 0.0], (4, 1))[None, :, None] * np.linspace(0.0, 1.0, FRAMES)[:, None]
    far = dataclasses.replace(recording, penalties=dear.astype(np.float32))
    cases = (lines, lines_of(opened_run, far), lines_of(opened_run, recording, STAND))
    assert [any("does not land" in line for line in case) for case in cases] == [False, True, False]
    assert any("policies-stand" in line for line in cases[2])


def test_corrected_values_stand_between_the_found_ones_and_those_of_now(opened_run, recording):
    fresh = dataclasses.replace(fresh_values(opened_run.archive), invalid_episodes=np.array([8]))
    archive = dataclasses.replace(opened_run.archive, fresh=fresh)
    lines = lines_of(dataclasses.replace(opened_run, archive=archive), recording)
    assert "as found fresh now" in lines
    assert "fitness 3.25 1.62 10.50" in lines
    # 8 of the 40 are invalid
    assert "base collision 25% (5-70%) 25% (13-42%) 25% (5-70%)" in lines


@pytest.mark.slow
def test_rates_of_ones_own_terrain_with_their_intervals():
    gray = np.zeros((81, 161), np.uint8)
    gray[:, 100:] = 200  # a wall of 2 m before the goal
    Image.fromarray(gray).save("wall.png")
    flags = f"--terrain wall.png --size 16 8 --scale 0.01 --policy {STAND} --device cpu --replicas 4"
    assert run_command(ReplayCommand, flags.split(), name="replay") == 0
    stem = "runs/terrains/wall.png-anymal-tests.sim.policies-stand"
    report = json.loads(Path(f"{stem}.json").read_text())
    # It stands where it starts: no collision, no goal. Wilson of 4 of 4: 1 / (1 + 3.8415 / 4) = .5101
    assert report["rates"]["success"] == {"rate": 1.0, "hits": 4, "interval": [pytest.approx(0.5101, abs=1e-4), 1.0]}
    assert report["rates"]["goal"] == {"rate": 0.0, "hits": 0, "interval": [0.0, pytest.approx(0.4899, abs=1e-4)]}
    assert report["outcomes"] == {"goal": 0, "base_collision": 0, "time_out": 4, "out": 0, "invalid": 0}
    assert report["heights_m"] == [0.0, 2.0] and report["duration_s"] == 20.0
    keys = {"command", "commit", "device", "versions", "seed", "date", "policy_sha256", "terrain_sha256"}
    assert keys <= report.keys()
    assert Path(f"{stem}.png").exists()


def test_invalid_episodes_are_left_out_of_the_rates():
    ends = [Outcome.BASE_COLLISION, Outcome.GOAL, Outcome.INVALID]
    sums = np.repeat([[1.0], [3.0], [np.nan]], 6, axis=1)
    made = recording_of(ends, [4.0, 14.0, 3.0], penalties=sums, fallen=[False, False, True])
    times, invalidity = np.array([[4.0, 16.0, 1.0]]), np.array([[0, 0, Invalidity.SPEED]], np.uint8)
    numbers = compute_numbers(dataclasses.replace(made, duration_s=times, invalidity=invalidity))
    assert {name: rate["hits"] for name, rate in numbers["rates"].items()} == {"success": 1, "goal": 1, "fallen": 0}
    assert numbers["penalties"]["vel_x"] == {"mean": 2.0, "std": 1.0, "unit": "(m/s)^2 s"}  # of 1 and 3
    assert numbers["duration_s"] == 10.0  # of 4 and 16
    assert (numbers["invalid_episodes"], numbers["invalid_reasons"]) == (1, {"speed": 1})


def test_the_drawing_has_all_paths():
    figure = draw_crossing(recording_of([Outcome.GOAL, Outcome.TIME_OUT], [12.0, 2.0]), "a hill")
    axes = figure.axes[0]
    assert sum(len(np.asarray(line.get_xdata())) == FRAMES for line in axes.lines) == 2
    assert axes.images[0].get_array().shape == (161, 321)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:4] == ["reaches the goal (1)", "gets stuck (1)", "start", "goal"]


def test_the_witness_of_an_elite_is_its_walker_steered(tmp_path, anymal):
    file = str(anymal.panel / "C-G.pt")
    hashes = {"certifiers": ("C-G", "S"), "certifier_sha256": (str(controller_hash(file)), "b" * 64)}
    archive = dataclasses.replace(steered_archive(), **hashes, policy_sha256=controller_hash(anymal.policy_file))
    run = OpenedRun(path=tmp_path, archive=archive, robot=anymal)

    def requests(elite, **crossing):
        return source_from_run(run, elite, **crossing).steered_requests()

    # By the searched controller and by C-G, whoever else crosses the elites here.
    for policy in (None, STAND):
        searched, other = requests("1 3", policy=policy, replicas=4)
        assert (searched.policy, other.policy) == (str(anymal.policy_file), file)
        assert np.array_equal(other.terrain.steering, np.tile(archive.witnesses.way[3], (1, 4, 1, 1)))
        assert np.array_equal(other.terrain.genes[0], archive.genes[3])
    with pytest.raises(ValueError, match=r"witness .*elite 0"):
        requests("0")
    lost = dataclasses.replace(archive, certifier_sha256=("a" * 64, "b" * 64))
    with pytest.raises(ValueError, match="C-G, got no file"):
        source_from_run(OpenedRun(path=tmp_path, archive=lost, robot=anymal), "3").steered_requests()


@pytest.mark.slow
def test_a_map_is_never_overwritten(anymal):
    for folder in ("a", "b"):  # two maps of one name have files of their own
        Path(folder).mkdir()
        np.savez(f"{folder}/hill.npz", heights=np.zeros((3, 5)))
        with pytest.raises(ValueError, match="size"):
            source_from_map(Path(folder) / "hill.npz", anymal)
        (terrain,) = source_from_map(Path(folder) / "hill.npz", anymal, size_m=(16.0, 8.0)).terrains
        assert terrain.stem == f"{folder}-hill.npz-anymal"
    Image.fromarray(np.zeros((3, 5), np.uint8)).save("hill.png")
    Path("hill.json").write_text('{"scale_m": 0.01, "size_m": [16, 8]}')
    before = {path.name: path.read_bytes() for path in Path().glob("hill.*")}
    with pytest.raises(ValueError, match="out"):
        replay(source_from_map(Path("hill.png"), anymal), out=Path("hill.png"))
    with pytest.raises(ValueError, match=r"none\.pt"):
        replay(source_from_map(Path("hill.png"), anymal, policy="none.pt"))
    assert {path.name: path.read_bytes() for path in Path().glob("hill.*")} == before


def test_what_one_controller_wrote_another_does_not_overwrite(opened_run):
    for name, content in (("a.pt", b"1"), ("b.pt", b"1"), ("C-G.pt", b"2")):
        Path(name).write_bytes(content)
    archive = dataclasses.replace(opened_run.archive, policy_sha256=controller_hash("a.pt"))
    run = dataclasses.replace(opened_run, archive=archive)
    names = ("a.pt", "b.pt", "C-G.pt", "mine/row.py:adapt@my model.onnx")
    assert list(map(run.suffix, names)) == ["", "", "-C-G", "-row.py-adapt-my-model"]


def test_terrains_and_archives_that_are_not_there_are_refused(tmp_path, cassie):
    archive = tmp_path / "archive.npz"
    write_archive(archive, small_archive())
    opened_run = open_run(None, archive)
    assert [terrain.number for terrain in opened_run.terrains("2 0")] == [2, 0]
    (terrain,) = opened_run.terrains()
    assert terrain.number == rank(opened_run.archive, opened_run.space, half_width=0.4).worst(1)[0] != 0
    assert [terrain.stem for terrain in opened_run.terrains("all")] == ["elite-0", "elite-1", "elite-2"]
    with pytest.raises(FileNotFoundError, match="minimal"):
        opened_run.terrains("0", "all")
    with pytest.raises(ValueError, match="cassie"):
        open_run("cassie", archive)
    with pytest.raises(FileNotFoundError):
        open_run(None, tmp_path / "elsewhere")
    RunDirectory(tmp_path).begin_session(CFG, {"command": "", "commit": "", "device": "cpu"}, 0)
    with pytest.raises(ValueError, match=r"config\.json"):  # which has six penalties
        open_run(None, tmp_path).as_searched()
    robot = {"robot": "cassie", **robot_identity(cassie)}
    write_archive(archive, dataclasses.replace(small_archive(), **robot))
    assert open_run(None, archive).robot.name == "cassie"


def test_minimal_terrains_are_replayed_exported_and_listed_in_the_viewer(tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path)
    minimal_of(run, 2)  # of 20 elites: the elite with its last gene changed
    opened_run = open_run("anymal", run)
    genes = opened_run.minima.genes
    number = next(iter(genes))
    wanted = []

    def record(recordings, asked):
        wanted.extend(asked)
        made = recording_of([Outcome.GOAL, Outcome.TIME_OUT], [14.0, 6.0])
        return [dataclasses.replace(made, genes=genes[number][None])]

    monkeypatch.setattr(Recordings, "record", record)
    source = source_from_run(opened_run, minimal=str(number), replicas=2, seed=3, policy="shipped")
    (report,) = replay(source)
    np.testing.assert_array_equal(wanted[0].terrain.genes[0], genes[number])
    assert (wanted[0].policy, wanted[0].replicas, wanted[0].seed) == (str(opened_run.robot.policy_file), 2, 3)
    assert (run / f"minimal-{number}.png").is_file()
    assert json.loads((run / f"minimal-{number}.json").read_text()) == report and report["elite"] == number
    with pytest.raises(ValueError, match="out"):
        replay(source, out=Path("a.jpg"))
    words = " ".join(capsys.readouterr().out.split())
    assert f"Of the minimal terrain: {opened_run.minima.describe(number)}; failing." in words
    assert words.count("- bump of") == 1 and "- bump of <0.24> m" in words  # those that are left alone
    ExportCommand(run=run, minimal="all", out=tmp_path / "out", formats=("npz",)).execute()
    assert {file.name for file in (tmp_path / "out").glob("*.npz")} == {f"minimal-{k}.npz" for k in genes}
    with np.load(tmp_path / "out" / f"minimal-{number}.npz") as content:
        np.testing.assert_array_equal(content["genes"], genes[number])
    about = json.loads((tmp_path / "out" / f"minimal-{number}.json").read_text())
    assert about["elite"] == number and about["minimal"]["cause"]["kind"] == "rise"
    show = open_viewed_run(run, minimal=str(number), policies=("base=shipped",))
    assert show.elite == number and show.minimal


@pytest.fixture
def request_4(anymal):
    return request_elite(small_archive(5), 4, policy=str(anymal.policy_file), replicas=2)


@pytest.fixture
def crossed(request_4):
    return stand_in_cross([])([request_4], lambda share: None)[0]


def test_only_the_recording_of_an_equal_request_is_read(anymal, request_4, crossed, tmp_path):
    assert Recordings(anymal, folder=tmp_path).read(request_4) is None
    Recordings(anymal, folder=tmp_path).store(request_4, crossed)
    again = Recordings(anymal, folder=tmp_path)
    named = again.read(dataclasses.replace(request_4, label="a hill"))
    np.testing.assert_array_equal(named.base_position, crossed.base_position)
    assert named.labels == ("a hill",)
    terrain = request_4.terrain
    heights = Terrains(heights=np.zeros((1, 161, 321), np.float32), seeds=terrain.seeds)
    terrains = [
        dataclasses.replace(terrain, seeds=terrain.seeds + 1), dataclasses.replace(terrain, genes=-terrain.genes),
        dataclasses.replace(terrain, space=get_space("course")), heights,
        dataclasses.replace(heights, ground=GroundMaps.plain(1)),
    ]  # fmt: skip
    changes = [{"replicas": 1}, {"policy": __file__}, *({"terrain": changed} for changed in terrains)]
    changed = [dataclasses.replace(request_4, **change) for change in changes]
    assert len({request_4, *changed}) == 8  # no two requests are equal
    assert [again.read(request) for request in changed] == [None] * 7
    assert Recordings(anymal, device="cuda:0", folder=tmp_path).read(request_4) is None  # whose last bits are others
    other = dataclasses.replace(anymal, action_scale=anymal.action_scale * 2)
    assert Recordings(other, folder=tmp_path).read(request_4) is None
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-9])  # damaged, it counts as none and is written again
    assert again.read(request_4) is None
    again.store(request_4, crossed)
    assert again.read(request_4) is not None


def test_missing_recordings_are_crossed_in_lots_of_one_controller(anymal, tmp_path, monkeypatch):
    archive = small_archive(5)
    policies = (str(anymal.policy_file), __file__)
    requests = [request_elite(archive, k, policy=policies[k % 2], replicas=4) for k in range(5)]
    lots = []

    def cross(lot, progress):
        lots.append([request.label for request in lot])
        return stand_in_cross([])(lot, progress)

    def record(device, requests):
        recordings = Recordings(anymal, device=device, folder=tmp_path).record(requests)
        return [recording.labels[0] for recording in recordings]

    monkeypatch.setattr("qd.show.recordings.RecordingCrosser", lambda robot, device: cross)
    labels = [f"elite {k} of anymal" for k in range(5)]
    assert record("cuda:0", requests) == labels and lots == [labels[::2], labels[1::2]]
    more = [*requests[3:], request_elite(archive, 0, policy=policies[0], replicas=4, seed=1)]
    assert record("cuda:0", more) == [*labels[3:], labels[0]] and lots[2:] == [labels[:1]]
    record("cpu", requests)  # one at a time, controller by controller
    assert lots[3:] == [[labels[k]] for k in (0, 2, 4, 1, 3)]


@pytest.fixture
def run():
    """The newest run: three elites, with what fresh episodes say."""
    archive = small_archive(3)
    fresh = dataclasses.replace(fresh_values(archive), goal_rate=np.array([0.1, 0.2, 0.9]))
    return write_run(Path("runs/anymal-small-0"), dataclasses.replace(archive, fresh=fresh))


def export(elite, **options):
    return export_elites(open_run("anymal"), elite, **options)


def test_elites_are_exported_as_the_simulation_has_them(run):
    archive = open_run("anymal", run).archive
    files, folder, elites = export("2 1 0"), run / "terrains", (2, 1, 0)
    endings = ("npz", "png", "npy", "xml", "stl", "glb", "sdf", "json")
    expected = [*(f"elite-{k}.{ending}" for k in elites for ending in endings), "README.md", "index.json"]
    assert [path.name for path in files] == expected and sorted(expected) == sorted(p.name for p in folder.iterdir())
    for elite in elites:
        heights = make_heights(archive.genes[elite : elite + 1])[0]
        np.testing.assert_array_equal(as_terrain(read_heightmap(folder / f"elite-{elite}.npz")), heights)
        np.testing.assert_array_equal(np.load(folder / f"elite-{elite}.npz")["genes"], archive.genes[elite])
        about = json.loads((folder / f"elite-{elite}.json").read_text())
        read = as_terrain(read_heightmap(folder / f"elite-{elite}.png"))
        np.testing.assert_allclose(read, heights, rtol=0, atol=0.51 * about["scale_m"] + 1e-7)
        assert (about["elite"], about["robot"]) == (elite, "anymal")
        assert about["fitness"] == archive.fitness[elite] and about["fresh"]["episodes"] == 40
        assert about["ratios"] == dict(zip(archive.penalties, archive.ratios[elite].tolist(), strict=True))
        assert {"command", "commit", "versions", "date", "run", "space"} <= about.keys() and "seed" not in about
        assert about["verdict"] == ("not failing" if elite == 2 else "failing")
        assert (about["cause"] is None) == (about["ending"] == "reaches the goal") == (elite == 2)
        assert about["in_words"].startswith("reaches the goal, 36 of 40" if elite == 2 else f"{about['cause']}: ")
    index = json.loads((folder / "index.json").read_text())
    assert [(row["elite"], row["files"]) for row in index["elites"]] == [(k, f"elite-{k}") for k in elites]


def test_files_of_an_earlier_export_are_replaced_only_if_that_is_asked_for(run):
    (file, _, _, readme, index) = export("0", formats=("npz", "xml"), out=Path("out"))
    assert file == Path("out/elite-0.npz")
    assert "--mjcf=elite-0.xml" in readme.read_text()
    file.write_bytes(b"mine")
    (index.unlink(), readme.unlink())
    with pytest.raises(ValueError, match="overwrite"):
        export("0", formats=("npz",), out=Path("out"))
    assert file.read_bytes() == b"mine"
    export("0", formats=("npz",), out=Path("out"), overwrite=True)
    assert file.read_bytes() != b"mine"


def test_a_pack_is_exported_with_what_it_knows(tmp_path):
    (*_, about, _, _) = export_pack("anymal", "3", formats=("xml",), out=tmp_path)
    content = json.loads(about.read_text())
    assert content["verdict"] == "fault" and content["start"][:2] == [2, 4] and content["pack"] == "anymal@2"


def test_a_controller_is_not_replaced_silently(anymal, tmp_path):
    out = tmp_path / "mine.onnx"
    out.write_bytes(b"mine")
    with pytest.raises(ValueError, match="overwrite"):
        export_controller(None, anymal, out)
    assert out.read_bytes() == b"mine"
