"""Compiled loops over saddle points: which lead to which, and what hangs together."""

from __future__ import annotations

import math

import numpy as np

from core.arrays import BoolArray, FloatArray, IntArray
from core.compiled import compiled, inner_loop

_PARALLEL = 0.94
"""Cosine between an arm and an edge of the saddle that it leads to: 20 degrees, for edges that
distortion bends and noise turns."""
_STRAIGHT = 0.22
"""Tangent of the angle between an arm and the way to the next saddle: 12 degrees. The corner across
the square lies 45 degrees off, or 15 where a board is tilted by 70."""
MOST_WIDE = 500
"""Corners from a seed to the end of a lattice; boards have some tens."""


@compiled
def link_arms(
    points: FloatArray, near: IntArray, arms: FloatArray, polarity: FloatArray, links: IntArray
) -> None:
    """For each arm the nearest saddle that it leads to, or -1.

    points (n, 2); near (n, k) neighbours, the nearest first; arms (n, 4, 2) unit vectors,
    clockwise, the third and fourth opposite to the first two; polarity (n,). links (n, 4) out.
    A neighbour lies along the arm, has an edge parallel to it, and, as corners alternate along
    an edge, the other colour on its side.
    """
    for k in range(len(points)):
        for arm in range(4):
            x, y = arms[k, arm, 0], arms[k, arm, 1]
            side = polarity[k] if arm % 2 == 0 else -polarity[k]
            best, choice = math.inf, -1
            for to in near[k]:
                du, dv = points[to, 0] - points[k, 0], points[to, 1] - points[k, 1]
                along = du * x + dv * y
                if not 0.0 < along < best or abs(du * y - dv * x) >= _STRAIGHT * along:
                    continue
                first = abs(x * arms[to, 0, 0] + y * arms[to, 0, 1])
                second = abs(x * arms[to, 1, 0] + y * arms[to, 1, 1])
                if max(first, second) <= _PARALLEL:
                    continue
                other_side = polarity[to] if first >= second else -polarity[to]
                if other_side == -side:
                    best, choice = along, to
            links[k, arm] = choice


@compiled
def keep_mutual(links: IntArray, mutual: IntArray) -> None:
    """Copy the links (n, 4) whose saddle leads back by one of its arms; the others are -1."""
    for k in range(len(links)):
        for arm in range(4):
            mutual[k, arm] = -1
            to = links[k, arm]
            if to >= 0:
                for back in range(4):
                    if links[to, back] == k:
                        mutual[k, arm] = to


@compiled
def grow(
    seed: int,
    arms: FloatArray,
    links: IntArray,
    labels: IntArray,
    labelled: BoolArray,
    taken: BoolArray,
    queue: IntArray,
) -> int:
    """Label what hangs together with a seed; give how many saddles that is.

    labels (n, 3) out: i, j and the arm that points along +i; labelled (n,) out; taken (m, m),
    all False, is room for the spots, and False again at the end: a lattice is at most m // 2
    wide from its seed. queue (n,) out: the labelled saddles in the order in which they came.
    """
    middle = taken.shape[0] // 2
    labels[seed, 0], labels[seed, 1], labels[seed, 2] = 0, 0, 0
    labelled[seed], taken[middle, middle], queue[0] = True, True, seed
    count, done = 1, 0
    while done < count:
        at = queue[done]
        done += 1
        turn = labels[at, 2]
        for step in range(4):
            to = links[at, (step + turn) % 4]
            if to < 0 or labelled[to]:
                continue
            i = labels[at, 0] + (1 if step == 0 else -1 if step == 2 else 0)
            j = labels[at, 1] + (1 if step == 1 else -1 if step == 3 else 0)
            if max(abs(i), abs(j)) > middle or taken[middle + j, middle + i]:
                continue
            labels[to, 0], labels[to, 1] = i, j
            labels[to, 2] = _same_way(arms, to, arms[at, turn, 0], arms[at, turn, 1])
            labelled[to], taken[middle + j, middle + i] = True, True
            queue[count] = to
            count += 1
    for k in range(count):
        taken[middle + labels[queue[k], 1], middle + labels[queue[k], 0]] = False
    return count


@inner_loop
def _same_way(arms: FloatArray, k: int, x: float, y: float) -> int:
    """The arm of saddle k that points most like (x, y)."""
    best, choice = -math.inf, 0
    for arm in range(4):
        along = arms[k, arm, 0] * x + arms[k, arm, 1] * y
        if along > best:
            best, choice = along, arm
    return choice


def largest_component(arms: FloatArray, links: IntArray) -> tuple[IntArray, IntArray]:
    """The largest lattice that the links hold together: its saddles (m,), and labels (m, 3)."""
    n, reach = len(links), min(len(links), MOST_WIDE)
    labels, labelled = np.zeros((n, 3), dtype=np.int64), np.zeros(n, dtype=bool)
    taken = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=bool)
    queue = np.zeros(n, dtype=np.int64)
    unseen = (links >= 0).sum(axis=1) >= 2
    best = (np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.int64))
    for seed in range(n):
        if not unseen[seed]:
            continue
        count = grow(seed, arms, links, labels, labelled, taken, queue)
        index = queue[:count].copy()
        unseen[index] = labelled[index] = False
        if count > len(best[0]):
            best = index, labels[index].copy()
    return best
