"""Figures are written small, and look as they were drawn."""

import io

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from sim.figure_png import figure_as_png


def test_colours_are_rounded_by_what_nobody_sees_and_the_file_is_much_smaller() -> None:
    figure = Figure(figsize=(4, 3))
    axes = figure.add_subplot()
    rng = np.random.default_rng(0)
    axes.plot(rng.random((6, 200)), alpha=0.4, linewidth=0.7)
    plain = io.BytesIO()
    figure.savefig(plain, format="png", dpi=150)

    written = figure_as_png(figure)

    drawn = np.asarray(Image.open(plain).convert("RGB"), dtype=np.int64)
    kept = np.asarray(Image.open(io.BytesIO(written)), dtype=np.int64)
    assert len(written) < 0.7 * len(plain.getvalue())
    assert kept.shape == (450, 600, 3)
    assert np.abs(kept - drawn).max() <= 4
    for colour in (0, 255):
        assert (kept[(drawn == colour).all(axis=2)] == colour).all()
