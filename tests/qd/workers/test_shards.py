"""Results that cannot be true are known, and the files of a controller travel; both without Ray's cluster."""

import dataclasses

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.workers.invalid import find_flaw
from tests.qd import stand_in

RESULT = stand_in.evaluate(np.zeros((3, 64), np.float32), np.arange(3), 4)


CHANGES = [
    {"penalties": np.ones((2, 4, 6))},
    {"penalties": np.ones((3, 4, 5))},
    {"penalties": np.full((3, 4, 6), -1.0)},
    {"penalties": np.full((3, 4, 6), np.inf)},
    {"outcome": np.full((3, 4), Outcome.INVALID, np.uint8)},  # without a reason
    {"duration_s": np.zeros((3, 4), np.float32)},
    {"physics_steps": 0},
    {"reward": np.full((3, 4), np.nan)},
    {"reward": np.zeros((3, 3))},
]


@pytest.mark.parametrize("changes", CHANGES, ids=lambda changes: next(iter(changes)))
def test_a_result_that_cannot_be_true_is_known(changes):
    assert find_flaw(RESULT, 3, 4) is None
    assert find_flaw(dataclasses.replace(RESULT, **changes), 3, 4) and find_flaw("all went well", 3, 4)


@pytest.mark.parametrize("name", ["{}/model.pt", "{}/mine.py:act", "{}/mine.py:adapt@{}/model.pt", "os.path:join"])
def test_the_files_of_a_controller_travel(tmp_path, name):
    pytest.importorskip("ray")
    from qd.workers.ray_workers import PackedCode

    sent_from, sent_to = tmp_path / "sent_from", tmp_path / "sent_to"
    sent_from.mkdir()
    content = {"model.pt": b"weights", "mine.py": b"x = 1"}
    for file, text in content.items():
        (sent_from / file).write_bytes(text)
    assert PackedCode.of(name.format(sent_from, sent_from)).unpacked(sent_to) == name.format(sent_to, sent_to)
    sent = {file.name: file.read_bytes() for file in sent_to.iterdir()}
    assert sent == {file: text for file, text in content.items() if file in name}
