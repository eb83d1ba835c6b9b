import hashlib
import pickle

import pytest

from qd.search.checkpoint import load_checkpoint


def wrap(payload: bytes) -> bytes:
    """A file with a right magic and hash around any payload, as an attacker would make it."""
    return b"faultline search checkpoint 6\n" + hashlib.sha256(payload).digest() + payload


@pytest.mark.parametrize(
    "name",
    [  # protocol 4 names may have dots: numpy.dtype is admitted, what hangs on it is not
        "posix system", "builtins eval", "pickle loads", "numpy.testing measure", "numpy dtype.__init__",
        "numpy dtype.mro", "numpy ndarray.tofile", "numpy os",
    ],
)  # fmt: skip
def test_what_is_no_part_of_a_search_is_never_looked_up(tmp_path, name):
    names = b"".join(b"\x8c" + bytes([len(part)]) + part.encode() for part in name.split())
    (tmp_path / "checkpoint.bin").write_bytes(wrap(b"\x80\x04" + names + b"\x93."))
    with pytest.raises(ValueError, match=name.replace(" ", ".")):
        load_checkpoint(tmp_path / "checkpoint.bin")


@pytest.mark.parametrize("content", [b"", wrap(b"junk"), wrap(pickle.dumps([1, 2]))])
def test_foreign_files(tmp_path, content):
    path = tmp_path / "checkpoint.bin"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.bin"):
        load_checkpoint(path)


@pytest.mark.parametrize("version", [b"5\n", b"55\n", b""])
def test_of_another_version_a_new_run_is_the_remedy_not_a_copy(tmp_path, version):
    path = tmp_path / "checkpoint.bin"
    path.write_bytes(b"faultline search checkpoint " + version + bytes(40))
    with pytest.raises(ValueError, match=r"another version of faultline: start a new run$"):
        load_checkpoint(path)
