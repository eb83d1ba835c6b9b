"""What a pack takes, in which order, and its files."""

import hashlib
import json

import numpy as np
import pytest

from qd.pack import HEIGHT_UNIT_M, Candidate, choose, pack_folder, read_pack, rounded, write_terrains
from sim.terrain import NUM_COLS, NUM_ROWS


def candidate(elite, *, fault=True, family=0, mode=1, kind="elite", rate=0.0):
    about = {
        "name": f"elite-{elite}", "elite": elite, "kind": kind, "verdict": "fault" if fault else "near-fault",
        "family": family, "mode": mode, "cause": None, "searched": {"goal_rate": rate},
    }  # fmt: skip
    return Candidate(np.full(64, elite / 100, np.float32), about)


def numbers(chosen):
    return [one.about["elite"] for one in chosen]


@pytest.mark.parametrize(
    ("candidates", "expected"),
    [
        ([candidate(0, fault=False, rate=0.0), candidate(1, rate=0.4)], [1, 0]),  # faults first
        ([candidate(0), candidate(1), candidate(2, family=1, rate=0.4)], [0, 2, 1]),  # one family before two
        ([candidate(0), candidate(1, family=1), candidate(2, family=2, mode=2, rate=0.4)], [0, 2, 1]),  # modes
        ([candidate(0), candidate(1, family=1), candidate(2, family=2, kind="minimal", rate=0.4)], [0, 2, 1]),  # kinds
        ([candidate(0, rate=0.4), candidate(1, family=1, rate=0.1)], [1, 0]),  # the lowest goal rate
    ],
)
def test_what_comes_next(candidates, expected):
    assert numbers(choose(candidates, 9)) == expected
    assert numbers(choose(candidates, 1)) == expected[:1]  # each beginning of a pack is one


@pytest.fixture
def pack(tmp_path):
    """Two terrains: random heights of both signs, and flat ground."""
    heights = np.zeros((2, NUM_ROWS, NUM_COLS))
    heights[0] = np.random.default_rng(0).uniform(-4.0, 4.0, heights[0].shape)
    chosen = [candidate(3), candidate(7, fault=False)]
    digest = write_terrains(tmp_path, rounded(heights), chosen, {"more": np.arange(3)})
    content = dict.fromkeys(("robot", "robot_sha256", "penalty_definition", "rates", "seed", "episodes"), "x")
    terrains = [one.about | {"rates": {"base": {}}} for one in chosen]
    content |= {"rates": {"base": {}}, "terrains": terrains, "terrains_sha256": digest}
    (tmp_path / "pack.json").write_text(json.dumps(content))
    return tmp_path, heights


def test_a_pack_is_read_as_it_was_written(pack):
    folder, heights = pack
    found = read_pack(pack_folder(str(folder)))
    assert len(found) == 2 and found.terrains[1]["verdict"] == "near-fault"
    np.testing.assert_array_equal(found.heights, rounded(heights))
    assert np.abs(found.heights - heights).max() <= HEIGHT_UNIT_M / 2 + 1e-6
    assert found.genes[:, 0].tolist() == pytest.approx([0.03, 0.07])
    with np.load(folder / "pack.npz") as content:  # any program may read it
        own = np.cumsum(np.cumsum(content["twists"], axis=1), axis=2) * content["height_unit_m"]
        np.testing.assert_array_equal(own.astype(np.float32), found.heights)
        assert content["name"].tolist() == ["elite-3", "elite-7"] and content["more"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("file", ["pack.json", "pack.npz"])
def test_a_damaged_pack_is_said_to_be_one(pack, file):
    data = (pack[0] / file).read_bytes()
    (pack[0] / file).write_bytes(data[: len(data) // 2] + b"?" + data[len(data) // 2 + 1 :])
    if file == "pack.json":
        (pack[0] / file).write_bytes(data[:-9])
    with pytest.raises(ValueError, match="must be a pack, but it is damaged or unfinished"):
        read_pack(pack[0])


def test_a_pack_of_an_older_version_is_said_to_be_one(pack):
    folder, _ = pack
    with np.load(folder / "pack.npz") as there:
        old = {**{name: there[name] for name in there.files if name != "twists"}, "rises": there["twists"]}
    np.savez(folder / "pack.npz", **old)
    content = json.loads((folder / "pack.json").read_text())
    content["terrains_sha256"] = hashlib.sha256((folder / "pack.npz").read_bytes()).hexdigest()
    (folder / "pack.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"is of an older version.*make it again with `faultline pack`"):
        read_pack(folder)


def test_a_pack_without_rates_is_refused(pack):
    file = pack[0] / "pack.json"
    content = json.loads(file.read_text())
    for changes in ({"rates": []}, {"terrains": [{"name": "a"}] * 2}):
        file.write_text(json.dumps(content | changes))
        with pytest.raises(ValueError, match="must have the rates of each controller, over all terrains and on each"):
            read_pack(pack[0])


def test_a_pack_without_all_that_is_known_is_refused(pack):
    (pack[0] / "pack.json").write_text("{}")
    with pytest.raises(ValueError, match=r"pack.json lacks robot, robot_sha256, .*make it again with `faultline pack`"):
        read_pack(pack[0])


def test_where_there_is_no_pack_it_is_said_how_to_make_one(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no pack at .*nowhere .*pack --robot anymal"):
        pack_folder(str(tmp_path / "nowhere"))
