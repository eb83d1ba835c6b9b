"""Spaces of a user's own: what they may leave out, what is refused, and that no record runs one."""

from pathlib import Path

import numpy as np
import pytest

from sim import space as spaces
from sim.bank import heights_of
from sim.space import get_space, is_own, load_space, to_be_named
from tests.sim.spaces.spaces import move, write_ridges

LEAST = """
class Space:
    num_genes = 2

    def rasterise(self, genes, x, y):
        return genes[:, 0, None, None] * x
"""


@pytest.fixture(autouse=True)
def none_named(monkeypatch):
    """As in a program that has just begun."""
    monkeypatch.setattr(spaces, "_named", [])


@pytest.fixture
def ridges(tmp_path):
    return write_ridges(tmp_path / "mine")


@pytest.fixture
def written(tmp_path):
    """Writes a file; returns the name of the space in it."""

    def write(text):
        (tmp_path / "space.py").write_text(text)
        return f"{tmp_path / 'space.py'}:Space"

    return write


def test_a_space_from_a_file(ridges):
    space = load_space(ridges)
    assert (space.name, space.num_genes, space.sigma0) == (ridges, 3, 0.4)
    assert is_own(ridges) and to_be_named(ridges) == ridges and to_be_named("course") is None
    # Height .3 m, ridges 0.9 m apart, not turned: a crest at x = 8 m, the next at 8.9 m; a hollow half way is flat.
    heights = heights_of(np.array([[1.0, 0.0, 0.0]]), space)[0]
    assert heights[[0, 80, 160], 160] == pytest.approx(0.3) and heights[80, 178] == pytest.approx(0.3, abs=1e-6)
    assert heights[80, 169] == 0.0 and not heights[:, :80].any()
    assert heights_of(np.array([[5.0, 0.0, 0.0]]), space).max() == pytest.approx(0.3)  # genes are clipped
    assert (space.hard_random(4, 0)[:, 0] == 1).all()
    assert space.describe([0.0, 0.0, 0.0]) == "ridges of 0.15 m"
    assert not heights_of(space.without(space.hard_random(2, 0), [0]), space).any()


def test_what_a_space_may_leave_out(written):
    space = load_space(written(LEAST))
    assert space.hard_random(3, 0).shape == (3, 2)
    assert space.describe([0.5, -1.0]) == "genes 0.50, -1.00" and space.parts([0.5, -1.0]) == ()
    assert space.sigma0 == 2.0
    with pytest.raises(ValueError, match="terrains of this space have no parts"):
        space.without(np.zeros((1, 2)), [0])


def test_numpy_will_do(written):
    name = written("import numpy as np\n" + LEAST.replace("return", "return np.ones((len(genes), *x.shape)) #"))
    assert (heights_of(np.zeros((2, 2)), load_space(name)) == 1.0).all()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("num_genes = 2", "num_genes = 0", "num_genes must be a whole number of 1 to 10000, got 0"),
        ("num_genes = 2", "", "num_genes must be a whole number of 1 to 10000, got None"),
        ("def rasterise", "def draw", "rasterise must be a method, got none"),
        ("* x", "", r"must return heights of shape \(3, 161, 321\) \(terrains, y, x\), got \(3, 1, 1\)"),
        ("* x", "/ 0 * x", r"must return finite heights, got NaN or infinity in terrain 0 of 3"),
        ("return", "return None #", "must return a tensor of heights .m., got NoneType"),
        ("return", "return 'x' #", "must return a tensor of heights .m., got str"),
        ("genes[:, 0,", "genes[:, 7,", r"rasterise fails: IndexError: .*space.py, line 6\); mend it"),
        ("class", "1 / 0\nclass", "cannot be loaded: .*ZeroDivisionError"),
        ("class Space", "class Other", "cannot be loaded: AttributeError: it has no 'Space', only Other"),
        ("    def", "    sigma0 = -1\n    def", "sigma0 must be a positive number, got -1"),
        ("    def", "    def parts(self, genes):\n        return []\n    def", "without must be a method, got none"),
        (
            "    def",
            "    def hard_random(self, count, rng):\n        return rng.uniform(-1, 1, (count, 5))\n    def",
            r"hard_random must return genes: genes must have shape \(num_terrains, 2\), got \(2, 5\)",
        ),
    ],
)
def test_a_space_that_does_not_work_says_so_before_any_work(written, old, new, says):
    assert old in LEAST
    name = written(LEAST.replace(old, new, 1))
    with pytest.raises(ValueError, match=says) as error:
        load_space(name)
    assert "space.py" in str(error.value)


def test_no_record_runs_code(ridges):
    with pytest.raises(ValueError, match=r"which is code: name it again .--space .*space.py:Ridges.") as error:
        get_space(ridges, "0" * 64, file=Path("runs/x"))
    assert str(error.value).startswith("runs/x: ")


def test_a_space_is_known_by_the_hash_of_its_code(ridges, tmp_path):
    digest = load_space(ridges).sha256
    there = move(ridges, tmp_path / "elsewhere")
    moved = load_space(there)
    assert moved.sha256 == digest and get_space(ridges, digest) is moved  # the one named last
    file = Path(there.rpartition(":")[0])
    file.write_text(file.read_text().replace("0.9", "1.9"))
    changed = load_space(there)
    assert changed.sha256 != digest and get_space(there, changed.sha256) is changed


def test_code_that_has_changed_since_is_refused(ridges):
    load_space(ridges)
    with pytest.raises(ValueError, match=r"its code has changed since .expected SHA-256 000000000000, got"):
        get_space(ridges, "0" * 64)


def test_what_is_no_space():
    with pytest.raises(ValueError, match=r"unknown terrain space 'nowhere': expected one of super_gaussian, course"):
        load_space("nowhere")
    with pytest.raises(ValueError, match=r"space 'nowhere.py:Space' cannot be loaded: .*no such file"):
        load_space("nowhere.py:Space")
