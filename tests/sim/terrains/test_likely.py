"""How likely conditions are: tails of distributions by hand and by scipy, and files that are refused."""

import numpy as np
import pytest
from scipy import stats

from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.conditions.likely import Disturbance, choose_likely, find_log_likelihood, read_likely
from sim.terrains.spaces.registry import get_space

PAYLOAD = '[payload]\nnumbers = {payload = 0.1}\ndistribution = "uniform"\nsource = "assumed"\n'


def likelihoods(space_name, entries, **values):
    """Of terrains whose only condition has some values."""
    space = get_space(f"super_gaussian+{space_name}")
    own = CONDITIONS[space_name].to_genes({name: np.array(each) for name, each in values.items()})
    genes = np.concatenate([np.zeros((len(own), 64)), own], axis=1).astype(np.float32)
    return find_log_likelihood(space.condition_rows(genes), {space_name: Disturbance(source="assumed", **entries)})


def test_tails_are_those_of_scipy():
    half = likelihoods("payload", {"numbers": {"payload": 0.1}, "distribution": "half_normal"}, payload=[0.1, 0.3])
    np.testing.assert_allclose(half, stats.halfnorm.logsf([1.0, 3.0]), rtol=1e-5)
    late = likelihoods("delay", {"numbers": {"delay": 0.01}, "distribution": "exponential"}, delay=[0.01, 0.05])
    np.testing.assert_allclose(late, stats.expon.logsf([1.0, 5.0]), rtol=1e-5)
    even = likelihoods("grip", {"numbers": {"friction": 0.5}, "distribution": "uniform"}, friction=[0.9, 0.6, 0.4])
    np.testing.assert_allclose(even, stats.uniform.logsf([0.2, 0.8, 1.2]), rtol=1e-5)
    assert even[2] == -np.inf
    sizes = {"numbers": {"push_x": 0.5, "push_y": 1.0}, "distribution": "half_normal"}
    joint = likelihoods("push", sizes, push_x=[1.5, -1.5], push_y=[-2.0, 2.0], push_time=[1.0, 9.0])
    np.testing.assert_allclose(joint, stats.halfnorm.logsf(np.sqrt(13.0)), rtol=1e-5)  # 3^2 + 2^2, at any time


def test_what_is_absent_adds_nothing_and_kinds_add_up():
    entries = read_likely()
    space = get_space("+".join(["course", *entries]))
    assert choose_likely(space) == entries
    genes = space.hard_random(4, 0)
    genes[0] = space.without(genes[:1], range(len(space.parts(genes[0]))))[0]
    rows = space.condition_rows(genes)
    total = find_log_likelihood(rows, entries)
    assert total[0] == 0.0 and (total[1:] < -10.0).all()
    np.testing.assert_allclose(total, sum(find_log_likelihood(rows, {name: entries[name]}) for name in entries))


def test_a_file_of_a_user_is_checked_and_a_condition_without_an_entry_is_named(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(PAYLOAD)
    assert choose_likely(get_space("super_gaussian+payload"), file)["payload"].distribution == "uniform"
    with pytest.raises(ValueError, match=r"course.*--likely"):
        choose_likely(get_space("course"), file)
    with pytest.raises(ValueError, match=f"{file}.*none for push"):
        choose_likely(get_space("super_gaussian+payload+push"), file)
    assert choose_likely(get_space("course")) == {}
    wrong = {"0.1": "0", "uniform": "normal", "payload = 0": "mass = 0", "[payload]": "[load]", '"assumed"': '""'}
    wrong |= {'source = "assumed"': "", 'source = "assumed"\n': 'source = "assumed"\nscale = 1\n'}
    for before, after in wrong.items():
        file.write_text(PAYLOAD.replace(before, after))
        with pytest.raises(ValueError, match=str(file)):
            read_likely(file)


def test_a_condition_without_an_entry_leaves_the_likelihood_unknown_until_it_is_asked_for(monkeypatch):
    space = get_space("super_gaussian+grip")
    monkeypatch.setattr("sim.terrains.conditions.likely.read_likely", lambda file: {})
    assert choose_likely(space) == {}
    with pytest.raises(ValueError, match="none for grip"):
        choose_likely(space, needed=True)
