"""Figures as PNG, and lengths of error bars."""

import io

import numpy as np
import pytest
from PIL import Image

from sim.files.figures import as_png, bar_lengths, new_figure


@pytest.mark.parametrize("colours_of_map", [None, "gray", "viridis"])
def test_lines_and_grey_maps_have_few_colours_and_other_maps_all(colours_of_map):
    figure = new_figure(3.0, 2.0)
    axes = figure.subplots()
    heights = np.random.default_rng(0).random((20, 20))
    if colours_of_map:
        axes.imshow(heights, cmap=colours_of_map)
    else:
        axes.plot(heights, color="tab:orange", alpha=0.5)
    image = Image.open(io.BytesIO(as_png(figure)))
    assert image.size == (450, 300) and image.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
    colours = image.convert("RGB").getcolors(10**6)
    assert colours is not None and (len(colours) <= 256) == (colours_of_map != "viridis")
    if colours_of_map == "gray":  # no shade is lost
        shades = {colour for _, colour in colours if colour[0] == colour[1] == colour[2]}
        assert len(shades) > 200


def test_bars_reach_from_the_value_to_its_limits():
    lengths = bar_lengths([0.5, 0.2, 1.0], [(0.3, 0.9), None, (1.0, 1.0 - 1e-17)])
    assert np.allclose(lengths[:, 0], [0.2, 0.4])
    assert np.isnan(lengths[:, 1]).all()  # nothing is drawn
    assert (lengths[:, 2] == 0.0).all()  # not below zero, which is refused by who draws them


def test_there_may_be_none():
    assert bar_lengths([], []).shape == (2, 0)
