"""Searches killed at random moments by the system: nothing saved is lost, and all come to the same bits."""

from pathlib import Path

import pytest

from tests.kills import searches
from tests.kills.campaign import RealSearch, kill_and_resume
from tests.kills.children import Child, run_child

KILLS = 100
ITERATIONS = 28
LONGEST_S = 0.3


@pytest.mark.parametrize("number_of_kills", [3, pytest.param(KILLS, marks=pytest.mark.kills)])
def test_kills_at_random_moments(folder, number_of_kills):
    def start(path: Path, number: int) -> Child:
        log = folder / "log"
        log.unlink(missing_ok=True)
        return Child(log, searches.search, path, iterations=ITERATIONS)

    code, output = run_child(folder / "log", searches.search, folder / "whole", iterations=ITERATIONS)
    assert code == 0, output
    whole = searches.outcome(folder / "whole")
    kills = kill_and_resume(start, folder, lambda: whole, kills=number_of_kills, longest_s=LONGEST_S, seed=20251121)
    assert len(kills) == number_of_kills
    # Had all moments come before the first save or after the last, nothing would have been tested.
    between = [kill for kill in kills if 0 < kill.saved < ITERATIONS]
    assert number_of_kills < KILLS or len(between) > KILLS / 4, kills


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes left behind in /proc")
@pytest.mark.kills
def test_kills_of_the_real_search_and_its_workers(tmp_path):
    fast = {"NUMBA_DISABLE_JIT": "1"}  # spares compiling

    def start(path: Path, number: int) -> RealSearch:
        return RealSearch(path, iterations=2, workers=2, whole_group=number % 3 == 2, **fast)

    def whole() -> tuple:
        assert undisturbed.wait() == 0, undisturbed.output
        return searches.outcome(tmp_path / "whole")

    undisturbed = RealSearch(tmp_path / "whole", iterations=2, workers=1, **fast)  # on the other core meanwhile
    kills = kill_and_resume(start, tmp_path, whole, kills=3, longest_s=11.0, seed=9)
    assert len(kills) == 3
