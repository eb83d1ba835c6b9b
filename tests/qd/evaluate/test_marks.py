"""Marks of the elites that a controller was trained on."""

import json

import numpy as np
import pytest
import torch

from qd.evaluate.marks import TRAINED_ON, marks_of, recorded_marks
from tests.builders import make_archive
from tests.train.starts import write_actor, write_trained

GENES = make_archive(20).genes


def test_the_records_of_all_files_of_a_controller_are_read(tmp_path):
    path = write_trained(tmp_path, GENES[:3])
    marks = marks_of(GENES[:3])
    assert len(set(marks)) == 3 and marks_of(GENES[2::-1].astype(np.float64)) == marks[::-1]
    for policy in (str(path), str(tmp_path / "tuned.onnx"), f"some.module:adapter@{path}"):
        assert recorded_marks(policy) == set(marks)
    assert recorded_marks("some.module:walk") == set() == recorded_marks(str(tmp_path / "other.pt"))
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: 5}))
    with pytest.raises(ValueError, match=TRAINED_ON):
        recorded_marks(str(path))


def test_marks_in_the_file_itself_count_where_no_record_lies_beside_it(tmp_path):
    path = write_actor(tmp_path / "policy.pt")
    torch.save(torch.load(path, weights_only=True) | {TRAINED_ON: marks_of(GENES)}, path)
    assert recorded_marks(str(path)) == recorded_marks(f"some.module:adapter@{path}") == set(marks_of(GENES))
