"""Commands that the page runs, and how they end."""

import io
import queue
import time
import zipfile

import pytest

from qd.show.view.errands import Errands
from sim.files.command import command_words


@pytest.fixture
def errands():
    errands = Errands()
    yield errands
    errands.stop()


def export(published, **flags):
    run = published / "anymal" / "archive"
    return lambda folder: command_words("export", robot="anymal", run=run, out=folder / "files", **flags)


def test_the_files_of_a_terrain_come_as_one(errands, published):
    made = queue.SimpleQueue()
    words, files = export(published, elite=3, formats=["npz"]), lambda folder: folder / "files"
    assert errands.run(1, words, files, made.put)
    assert not errands.run(1, words, files, made.put)  # one at a time
    content = made.get(timeout=60).content
    assert sorted(zipfile.ZipFile(io.BytesIO(content)).namelist()) == ["elite-3.json", "elite-3.npz", "index.json"]
    assert errands.run(1, export(published, elite=9999), files, made.put)  # and then the next
    failed = made.get(timeout=60)
    assert failed.content == b"" and "has no elite 9999: expected all, or numbers of 0 to" in failed.error


def test_stopping_ends_what_is_made(errands, published):
    made = queue.SimpleQueue()
    assert errands.run(1, export(published, elite="all"), lambda folder: folder / "files", made.put)
    time.sleep(0.2)
    errands.stop()
    time.sleep(0.5)
    assert made.empty() and not errands.run(2, export(published), lambda folder: folder, made.put)
