"""Terrains as files for other programs: what is in them, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from qd.archive import write_archive
from qd.show.elites import open_run
from qd.show.export import export_terrains, source_of_archive
from sim.bank import heights_of
from sim.maps.heightmap import as_terrain, read_heightmap
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
    return export_terrains(source_of_archive(open_run("anymal"), elite), **options)


def test_elites_are_exported_as_the_simulation_has_them(run):
    archive = open_run("anymal", run).archive
    files, folder, elites = export("2 1 0"), run / "terrains", (2, 1, 0)
    endings = ("npz", "png", "xml", "stl", "json")
    expected = [*(f"elite-{k}.{ending}" for k in elites for ending in endings), "index.json"]
    assert [path.name for path in files] == expected and sorted(expected) == sorted(p.name for p in folder.iterdir())
    for elite in elites:
        heights = heights_of(archive.genes[elite : elite + 1])[0]
        np.testing.assert_array_equal(as_terrain(read_heightmap(folder / f"elite-{elite}.npz")), heights)
        np.testing.assert_array_equal(np.load(folder / f"elite-{elite}.npz")["genes"], archive.genes[elite])
        about = json.loads((folder / f"elite-{elite}.json").read_text())
        read = as_terrain(read_heightmap(folder / f"elite-{elite}.png"))
        np.testing.assert_allclose(read, heights, rtol=0, atol=0.51 * about["scale_m"] + 1e-7)
        assert (about["elite"], about["robot"]) == (elite, "anymal")
        assert about["fitness"] == archive.fitness[elite] and about["fresh"]["episodes"] == 40
        assert about["ratios"] == dict(zip(archive.penalties, archive.ratios[elite].tolist(), strict=True))
        assert {"command", "commit", "versions", "date", "run"} <= about.keys() and "seed" not in about
    index = json.loads((folder / "index.json").read_text())
    assert [(row["elite"], row["files"]) for row in index["elites"]] == [(k, f"elite-{k}") for k in elites]


def test_mistakes_are_refused_before_anything_is_written(run):
    with pytest.raises(ValueError, match="formats"):
        export("0", formats=("obj",))
    assert not list(run.rglob("elite-*"))


def test_files_of_an_earlier_export_are_replaced_only_if_that_is_asked_for(run):
    (file, _, index) = export("0", formats=("npz",), out=Path("out"))
    assert file == Path("out/elite-0.npz")
    file.write_bytes(b"mine")
    index.unlink()
    with pytest.raises(ValueError, match="overwrite"):
        export("0", formats=("npz",), out=Path("out"))
    assert file.read_bytes() == b"mine"
    export("0", formats=("npz",), out=Path("out"), overwrite=True)
    assert file.read_bytes() != b"mine"
