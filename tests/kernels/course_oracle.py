"""Courses in NumPy, element after element as a builder would lay them; numbers of the ranges are written out again."""

import numpy as np

NODES = 20  # a metre
RANGES = {
    "flat": [(0, 0), {"whole": (0, 60)}, (0, 0), (0, 0)],
    "ramp": [(1 / 12, 1 / 3), {"whole": (16, 48)}, (0, 0), (-1, 1)],
    "cross_slope": [(1 / 48, 1 / 3), {"whole": (30, 60)}, (0, 0), (-1, 1)],
    "sill": [(0.013, 0.15), {"whole": (1, 3)}, (0, 0), (0, 0)],
    "rail": [(0.02, 0.172), {"whole": (0, 1)}, (0, 0), (0, 0)],
    "kerb": [(0.03, 0.25), (0, 0), (0, 0), (-1, 1)],
    "step": [(0.1, 0.4), (0, 0), (0, 0), (-1, 1)],
    "stairs": [(0.12, 0.22), (0.22, 0.35), {"whole": (2, 8)}, (-1, 1)],
    "pallet": [(0.1, 0.16), {"whole": (16, 24)}, {"whole": (1, 2)}, (0, 0)],
    "ditch": [(0.05, 0.8), {"whole": (2, 16)}, (0, 0), (0, 0)],
    "bridge": [(0.2, 0.8), {"whole": (16, 40)}, {"whole": (6, 20)}, {"whole": (-10, 10)}],
    "stones": [(0.2, 0.6), {"whole": (20, 48)}, {"whole": (4, 8)}, {"whole": (2, 6)}],
    "rubble": [(0.03, 0.2), {"whole": (16, 48)}, {"whole": (2, 8)}, (-0.5, 0.5)],
}
KINDS = tuple(RANGES)


def value(gene, span):
    share = (min(max(float(gene), -1.0), 1.0) + 1.0) / 2.0
    if isinstance(span, dict):
        low, high = span["whole"]
        return min(low + int(share * (high - low + 1)), high)
    return span[0] + share * (span[1] - span[0])


def gene(wanted, span):
    """The gene of a value; of a whole number the middle of its share."""
    if isinstance(span, dict):
        low, high = span["whole"]
        return 2 * (wanted - low + 0.5) / (high - low + 1) - 1
    return 2 * (wanted - span[0]) / (span[1] - span[0]) - 1 if span[1] > span[0] else 0.0


def element(kind, *, lead=4, size=None, length=None, detail=None, turn=None):
    """Six genes of one element; what is not given is at the low end of its range."""
    given = [size, length, detail, turn]
    parameters = [
        -1.0 if number is None else gene(number, span) for number, span in zip(given, RANGES[kind], strict=True)
    ]
    place = {"whole": (0, len(KINDS) - 1)}
    return [gene(KINDS.index(kind), place), gene(lead, {"whole": (4, 16)}), *parameters]


def course(*elements):
    """Genes of a course: these elements, then flat ground."""
    flat = element("flat", length=0)
    return np.float32([*elements, *[flat] * (6 - len(elements))]).reshape(1, 36)


def heights(genes):
    """Heights of one course [m], shape (161, 321)."""
    grid, ground = np.zeros((161, 321)), 0.0
    for _, col, patch in patches(genes):
        end = col + patch.shape[1]
        grid[:, col:end] = ground + patch
        ground += patch[80, -1]
        grid[:, end:] = ground
    return grid


def patches(genes):
    """Each element that fits: its number, the node before it, and its heights over the ground there."""
    col = 80
    for number, own in enumerate(np.asarray(genes, float).reshape(6, 6)):
        kind = KINDS[value(own[0], {"whole": (0, 12)})]
        size, length, detail, turn = (value(g, span) for g, span in zip(own[2:], RANGES[kind], strict=True))
        col = min(col + value(own[1], {"whole": (4, 16)}), 240)
        patch = patch_of(kind, size, length, detail, turn, 240 - col)
        if patch is not None:
            yield number, col, patch
            col += patch.shape[1] - 1


def patch_of(kind, size, length, detail, turn, room):
    """Heights of an element over the ground before it, from its last node to the first behind; None: no room."""
    sign = 1 if turn >= 0 else -1
    if kind == "flat":
        return np.zeros((161, min(length, room) + 1))
    if kind in ("kerb", "step"):
        return None if room < 1 else np.tile([0, sign * size], (161, 1))
    if kind == "stairs":
        for steps in range(detail, 1, -1):
            risers = [int(np.floor(k * length * NODES + 0.501)) for k in range(steps)]
            if risers[-1] + 1 <= room:
                nodes = np.arange(risers[-1] + 2)
                return np.tile(sign * size * sum((nodes > riser).astype(float) for riser in risers), (161, 1))
        return None
    faces = 2 if kind in ("sill", "rail", "pallet") else 0
    length = min(length, room - faces)
    if length < RANGES[kind][1]["whole"][0]:
        return None
    patch = np.zeros((161, length + faces + 1))
    inside, y = patch[:, 1:-1], np.arange(161) / NODES - 4
    if kind == "ramp":
        patch[:] = sign * size * np.arange(length + 1) / NODES
    elif kind == "cross_slope":
        along = np.arange(length + 1)
        patch[:] = (
            sign * size * np.clip(y, -2, 2)[:, None] * np.minimum(1, 3 * np.minimum(along, length - along) / length)
        )
    elif kind in ("sill", "rail"):
        inside[:] = size
    elif kind == "pallet":
        inside[:] = size * detail
    elif kind == "ditch":
        inside[:] = -size
    elif kind == "bridge":
        inside[:] = -size
        left = 80 + turn - detail // 2
        inside[left : left + detail + 1] = 0
    elif kind == "stones":
        inside[:] = -size
        pitch = detail + turn
        for number, first in enumerate(range(turn, length, pitch)):
            shift = number % 2 * (pitch // 2)
            for row in range(80 - detail // 2 - shift - 40 * pitch, 161, pitch):
                patch[max(row, 0) : max(row + detail + 1, 0), first : min(first + detail, length - 1) + 1] = 0
    elif kind == "rubble":
        for s in range(1, length):
            for row in range(161):
                phase = scattered((s - 1) // detail, row // detail) + turn
                patch[row, s] = size * abs(2 * (phase % 1) - 1)
    return patch


def scattered(i, j):
    h = (i * 73856093 ^ j * 19349663) & 0xFFFFFFFF
    h = ((h ^ h >> 13) * 1540483477) & 0xFFFFFFFF
    return ((h ^ h >> 15) & 0xFFFFFF) / 2**24
