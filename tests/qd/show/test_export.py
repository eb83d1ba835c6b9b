"""Terrains as files for other programs: what is in them, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from qd.archive import write_archive
from qd.show.elites import find_archive
from qd.show.export import export_controller, export_terrains, source_of_archive
from sim.bank import heights_of
from sim.maps.heightmap import as_terrain, read_heightmap
from sim.robots.find import get_robot
from tests.builders import fresh_values, small_archive


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The newest run: three elites, with what fresh episodes say."""
    monkeypatch.chdir(tmp_path)
    folder = Path("runs/anymal-small-0")
    folder.mkdir(parents=True)
    archive = small_archive(3)
    write_archive(folder / "archive.npz", archive.corrected_by(fresh_values(archive)))
    return folder


def export(elite, **options):
    return export_terrains(source_of_archive(find_archive("anymal"), elite), **options)


def test_elites_are_exported_as_the_simulation_has_them(run):
    archive = find_archive("anymal", run).archive
    files = export("2 1")
    folder = run / "terrains"
    endings = ("npz", "png", "xml", "stl", "json")
    expected = [*(f"elite-{k}.{ending}" for k in (2, 1) for ending in endings), "index.json"]
    assert [path.name for path in files] == expected and sorted(expected) == sorted(p.name for p in folder.iterdir())
    for elite in (1, 2):
        heights = heights_of(archive.genes[elite : elite + 1])[0]
        np.testing.assert_array_equal(as_terrain(read_heightmap(folder / f"elite-{elite}.npz")), heights)
        about = json.loads((folder / f"elite-{elite}.json").read_text())
        read = as_terrain(read_heightmap(folder / f"elite-{elite}.png"))
        np.testing.assert_allclose(read, heights, rtol=0, atol=0.51 * about["scale_m"] + 1e-7)
        assert (about["elite"], about["robot"]) == (elite, "anymal")
        assert about["fitness"] == archive.fitness[elite] and about["fresh"]["episodes"] == 40
        assert about["ratios"] == dict(zip(archive.penalties, archive.ratios[elite].tolist(), strict=True))
        assert {"command", "commit", "versions", "date", "run"} <= about.keys() and "seed" not in about
    index = json.loads((folder / "index.json").read_text())
    assert [(row["elite"], row["files"]) for row in index["elites"]] == [(2, "elite-2"), (1, "elite-1")]


def test_a_whole_archive_in_some_formats_elsewhere(run, monkeypatch):
    monkeypatch.setattr("qd.show.export._AT_ONCE", 4)
    write_archive(run / "archive.npz", small_archive(10))
    export("all", formats=("npz", "png"), out=Path("out"))
    assert len(list(Path("out").glob("*.npz"))) == len(list(Path("out").glob("*.png"))) == 10
    assert not list(Path("out").glob("*.stl"))
    heights = heights_of(small_archive(10).genes[9:])[0]
    np.testing.assert_array_equal(as_terrain(read_heightmap("out/elite-9.npz")), heights)
    about = json.loads(Path("out/elite-9.json").read_text())
    assert about["elite"] == 9 and about["fresh"] is None
    with np.load("out/elite-9.npz") as content:
        np.testing.assert_array_equal(content["genes"], small_archive(10).genes[9])


def test_mistakes_are_refused_before_anything_is_written(run, monkeypatch):
    with pytest.raises(ValueError, match="formats"):
        export("0", formats=("obj",))
    with pytest.raises(ValueError, match="cannot write"):
        export("0", out=run / "archive.npz" / "x")
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 1000})())
    with pytest.raises(ValueError, match="room"):
        export("all")
    assert not list(run.rglob("elite-*"))


def test_files_of_an_earlier_export_are_replaced_only_if_that_is_asked_for(run):
    (file, _, index) = export("0", formats=("npz",))
    file.write_bytes(b"mine")
    index.unlink()
    with pytest.raises(ValueError, match="overwrite"):
        export("0", formats=("npz",))
    assert file.read_bytes() == b"mine"
    export("0", formats=("npz",), overwrite=True)
    assert file.read_bytes() != b"mine"


def test_a_controller_is_exported_as_onnx(tmp_path):
    export_controller(None, get_robot("anymal"), tmp_path / "a.onnx")
    assert (tmp_path / "a.onnx").stat().st_size > 100_000
    with pytest.raises(ValueError, match="onnx"):
        export_controller(None, get_robot("anymal"), tmp_path / "a.pt")
