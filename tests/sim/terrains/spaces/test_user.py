"""Spaces of a user's own: what they may leave out, what is refused, and that no record runs one."""

from pathlib import Path

import numpy as np
import pytest

from sim.terrains.bank import make_heights
from sim.terrains.spaces import registry
from sim.terrains.spaces.registry import get_space, is_user_space, load_space
from tests.sim.terrains.spaces.spaces import write_ridges

LEAST = """
class Space:
    num_genes = 2

    def rasterise(self, genes, x, y):
        return genes[:, 0, None, None] * x
"""


@pytest.fixture(autouse=True)
def none_named(monkeypatch):
    """As in a program that has just begun."""
    monkeypatch.setattr(registry, "LOADED", [])


@pytest.fixture
def ridges(tmp_path):
    return write_ridges(tmp_path / "mine")


@pytest.fixture
def write(tmp_path):
    """Writes a file; returns the name of the space in it."""

    def write_space(text):
        (tmp_path / "space.py").write_text(text)
        return f"{tmp_path / 'space.py'}:Space"

    return write_space


def test_a_space_from_a_file(ridges):
    space = load_space(ridges)
    assert (space.name, space.num_genes, space.sigma0) == (ridges, 3, 0.4)
    assert is_user_space(ridges) and not is_user_space("course")
    # Height .3 m, ridges 0.9 m apart, not turned: a crest at x = 8 m, the next at 8.9 m; a hollow half way is flat.
    heights = make_heights(np.array([[1.0, 0.0, 0.0]]), space)[0]
    assert heights[[0, 80, 160], 160] == pytest.approx(0.3) and heights[80, 178] == pytest.approx(0.3, abs=1e-6)
    assert heights[80, 169] == 0.0 and not heights[:, :80].any()
    assert make_heights(np.array([[5.0, 0.0, 0.0]]), space).max() == pytest.approx(0.3)  # genes are clipped
    assert (space.hard_random(4, 0)[:, 0] == 1).all()
    assert space.describe([0.0, 0.0, 0.0]) == "ridges of 0.15 m, 0.90 m apart"
    assert not make_heights(space.without(space.hard_random(2, 0), [0]), space).any()


def test_what_a_space_may_leave_out(write):
    space = load_space(write(LEAST))
    assert space.hard_random(3, 0).shape == (3, 2)
    assert space.describe([0.5, -1.0]) == "genes 0.50, -1.00" and space.parts([0.5, -1.0]) == ()
    assert space.sigma0 == 2.0
    with pytest.raises(ValueError, match="parts"):
        space.without(np.zeros((1, 2)), [0])


def test_numpy_will_do(write):
    name = write("import numpy as np\n" + LEAST.replace("return", "return np.ones((len(genes), *x.shape)) #"))
    assert (make_heights(np.zeros((2, 2)), load_space(name)) == 1.0).all()


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("num_genes = 2", "num_genes = 0", "num_genes"),
        ("    def", "    sigma0 = -1\n    def", "sigma0"),
        ("    def", "    genes_per_part = 3\n    def", "genes_per_part"),
        ("def rasterise", "def draw", "rasterise"),
        ("    def", "    def parts(self, genes):\n        return []\n    def", "without"),
        ("* x", "", "rasterise"),
        ("* x", "/ 0 * x", "rasterise"),
        ("return", "return None #", "rasterise"),
        ("genes[:, 0,", "genes[:, 7,", "IndexError.*line 6"),
        ("class", "1 / 0\nclass", "ZeroDivisionError"),
        ("class Space", "class Other", "Other"),
        (
            "    def",
            "    def hard_random(self, count, rng):\n        return rng.uniform(-1, 1, (count, 5))\n    def",
            "hard_random",
        ),
    ],
)
def test_a_space_that_does_not_work_says_so_before_any_work(write, old, new, field):
    assert old in LEAST
    name = write(LEAST.replace(old, new, 1))
    with pytest.raises(ValueError, match=field) as error:
        load_space(name)
    assert "space.py" in str(error.value)


def test_no_record_runs_code(ridges):
    with pytest.raises(ValueError, match="--space"):
        get_space(ridges, "0" * 64)
    load_space(ridges)
    with pytest.raises(ValueError, match="changed"):
        get_space(ridges, "0" * 64)


def test_a_space_is_known_by_the_hash_of_its_code(ridges, tmp_path):
    digest = load_space(ridges).sha256
    elsewhere = write_ridges(tmp_path / "elsewhere")
    moved = load_space(elsewhere)
    assert moved.sha256 == digest and get_space(ridges, digest) is moved  # the one named last
    file = Path(elsewhere.rpartition(":")[0])
    file.write_text(file.read_text().replace("0.9", "1.9"))
    changed = load_space(elsewhere)
    assert changed.sha256 != digest and get_space(elsewhere, changed.sha256) is changed
    assert get_space(elsewhere) is changed


@pytest.mark.parametrize("name", ["nowhere", "nowhere.py:Space"])
def test_what_is_no_space(name):
    with pytest.raises(ValueError, match="nowhere"):
        load_space(name)
