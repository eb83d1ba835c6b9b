"""Marks of the elites that a controller was trained on."""

import json

import numpy as np
import pytest
import torch

from qd.evaluate.sets import TRAINED_ON, hash_elites, read_trained_on
from tests.builders import make_archive
from tests.train.conftest import write_actor, write_trained

GENES = make_archive(20).genes


def test_the_records_of_all_files_of_a_controller_are_read(tmp_path):
    path = write_trained(tmp_path, GENES[:3])
    marks = hash_elites(GENES[:3])
    assert len(set(marks)) == 3 and hash_elites(GENES[2::-1].astype(np.float64)) == marks[::-1]
    for policy in (str(path), str(tmp_path / "tuned.onnx"), f"some.module:adapter@{path}"):
        assert read_trained_on(policy) == set(marks)
    assert read_trained_on("some.module:walk") == set() == read_trained_on(str(tmp_path / "other.pt"))
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: 5}))
    with pytest.raises(ValueError, match=TRAINED_ON):
        read_trained_on(str(path))


def test_marks_in_the_file_itself_count_where_no_record_lies_beside_it(tmp_path):
    path = write_actor(tmp_path / "policy.pt")
    torch.save(torch.load(path, weights_only=True) | {TRAINED_ON: hash_elites(GENES)}, path)
    assert read_trained_on(str(path)) == read_trained_on(f"some.module:adapter@{path}") == set(hash_elites(GENES))
