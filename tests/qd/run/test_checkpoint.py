import hashlib
import os
import pickle
import zlib

import numpy as np
import pytest

from qd.run import checkpoint
from qd.run.checkpoint import load_checkpoint


def wrap(payload: bytes) -> bytes:
    """A file with a right magic and hash around any payload, as an attacker would make it."""
    return b"faultline search checkpoint 1\n" + hashlib.sha256(payload).digest() + payload


class Bomb:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


BOMBS = [
    Bomb(os.system, "touch {}"),
    {"archive": Bomb(eval, "open('{}', 'w')")},
    Bomb(np.testing.measure, "open('{}', 'w')"),
    Bomb(pickle.loads, b"cos\nsystem\n"),
]


@pytest.mark.parametrize("content", BOMBS)
def test_a_pickle_that_would_run_code_is_refused(tmp_path, content):
    target, path = tmp_path / "ran", tmp_path / "checkpoint.bin"
    path.write_bytes(wrap(zlib.compress(pickle.dumps(content, protocol=4).replace(b"{}", str(target).encode()))))
    with pytest.raises(ValueError, match="is no checkpoint of a search"):
        load_checkpoint(path)
    assert not target.exists()


def test_admitted_modules_are_no_way_to_their_neighbours(tmp_path):
    # Protocol 4 names may have dots: numpy.dtype is admitted, what hangs on it is not.
    path = tmp_path / "checkpoint.bin"
    for name in (b"dtype.__init__", b"dtype.mro", b"ndarray.tofile", b"os"):
        path.write_bytes(wrap(zlib.compress(b"\x80\x04\x8c\x05numpy\x8c" + bytes([len(name)]) + name + b"\x93.")))
        with pytest.raises(ValueError, match="is no part of a search"):
            load_checkpoint(path)


def test_a_bomb_of_zeros_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "_MAX_STATE_BYTES", 1 << 20)
    path = tmp_path / "checkpoint.bin"
    path.write_bytes(wrap(zlib.compress(bytes(8 << 20))))
    with pytest.raises(ValueError, match="larger than 1 MB"):
        load_checkpoint(path)


@pytest.mark.parametrize("content", [b"", wrap(b"junk"), wrap(zlib.compress(pickle.dumps([1, 2])))])
def test_foreign_files(tmp_path, content):
    path = tmp_path / "checkpoint.bin"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.bin"):
        load_checkpoint(path)
