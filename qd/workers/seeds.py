"""Streams of seeds, so that what must not share its episodes does not."""

from enum import IntEnum


class Stream(IntEnum):
    """What seeds are drawn for: the spawn key of their sequence, on which stored crossings and results depend."""

    SEARCH = 0
    FRESH = 1
    RECORDED_ELITE = 2
    ABLATED_ELITES = 3
    """Which elites ``results/make/ablation.py`` draws."""
    RECORDED_USER_TERRAIN = 4
    RESOLVED = 5
    OTHERS = 6
    OTHERS_RESOLVED = 7
    VARIED = 8
    MINIMISED = 11
    MINIMISED_FRESH = 12
    FRESH_AGAIN = 1001
    """Of ``results/make/search_noise.py``."""
    ABOUT_CONDITIONS = 2000
    """Of ``results/make/conditions.py``."""
