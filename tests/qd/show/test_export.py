"""Terrains as files for other programs: what is in them, and what is refused."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from qd.show.elites import open_run
from qd.show.export import export_controller, export_elites, export_pack
from sim.terrains.bank import make_heights
from sim.terrains.maps.heightmap import as_terrain, read_heightmap
from tests.builders import fresh_values, small_archive, write_run


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The newest run: three elites, with what fresh episodes say."""
    monkeypatch.chdir(tmp_path)
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
        assert (about["cause"] is None) == (about["ending"] == "crossed") == (elite == 2)
        assert about["in_words"].startswith("crossed, 36 of 40" if elite == 2 else f"{about['cause']}: ")
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
    assert content["verdict"] == "fault" and content["start"][:2] == [2, 4] and content["pack"] == "pack"


def test_a_controller_is_not_replaced_silently(anymal, tmp_path):
    out = tmp_path / "mine.onnx"
    out.write_bytes(b"mine")
    with pytest.raises(ValueError, match="overwrite"):
        export_controller(None, anymal, out)
    assert out.read_bytes() == b"mine"
