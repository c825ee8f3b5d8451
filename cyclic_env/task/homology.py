"""Which cycles a loop goes around: signed crossings of cuts, winding numbers, and the rank of the windings.

From an anchor in the hole of every cycle, a cut runs due north. A closed loop winds around a hole as often as it
crosses that cut westwards more than eastwards. The windings of a loop about all holes are an integer vector, and the
rank of such vectors is the number of independent cycles that the loops have closed.

Crossings are summed from the start of the path on and kept every `CHECKPOINT_STEPS` steps, so that the windings of a
loop of any length take few operations.
"""

from __future__ import annotations

from cyclic_env.jit import compiled

CHECKPOINT_STEPS = 64
"""Steps from one checkpoint of the crossings to the next."""

PRIME = 2147483647
"""Ranks are taken modulo this prime: exact in 64 bits, never too large, and too small only if it divides a minor."""


@compiled
def crossing(anchor, ax, ay, bx, by):
    """Return +1 if the line from a to b crosses the cut due north of the anchor to the west, -1 to the east, else 0."""
    if (ax < anchor[0]) == (bx < anchor[0]):
        return 0
    y = ay + (anchor[0] - ax) * (by - ay) / (bx - ax)
    if y <= anchor[1]:
        return 0
    return 1 if bx < ax else -1


@compiled
def count_crossings(anchors, track, step, checkpoints):
    """Add the crossings of the path's last step to the running checkpoint, and begin the next one when it is due.

    Parameters
    ----------
    anchors : (C, 2) float64
        A point inside the hole of each cycle.
    track : (T + 1, 3) float64
        x, y and path length of every step so far.
    step : int
        The last step.
    checkpoints : (T // CHECKPOINT_STEPS + 2, C) int64
        Output: crossings from the start to step ``CHECKPOINT_STEPS * i``; the one after the last step's is running.
    """
    running = checkpoints[(step - 1) // CHECKPOINT_STEPS + 1]
    ax, ay, bx, by = track[step - 1, 0], track[step - 1, 1], track[step, 0], track[step, 1]
    for cycle in range(anchors.shape[0]):
        running[cycle] += crossing(anchors[cycle], ax, ay, bx, by)
        if step % CHECKPOINT_STEPS == 0:
            checkpoints[step // CHECKPOINT_STEPS + 1, cycle] = running[cycle]


@compiled
def loop_windings(anchors, track, checkpoints, k, t, windings):
    """Write how often the path from step k to the last step t, closed by a straight line, winds around each cycle.

    `windings` is `(C,)` int64; for the other arrays see `count_crossings`.
    """
    total, mark = checkpoints[t // CHECKPOINT_STEPS + 1], checkpoints[k // CHECKPOINT_STEPS]
    for cycle in range(anchors.shape[0]):
        anchor = anchors[cycle]
        count = total[cycle] - mark[cycle]
        for j in range(k - k % CHECKPOINT_STEPS, k):
            count -= crossing(anchor, track[j, 0], track[j, 1], track[j + 1, 0], track[j + 1, 1])
        windings[cycle] = count + crossing(anchor, track[t, 0], track[t, 1], track[k, 0], track[k, 1])


@compiled
def is_independent(basis, rank, vector):
    """Tell whether `vector` (C,) is independent of the first `rank` rows of `basis`, and reduce it by them in place.

    An independent vector is left reduced modulo `PRIME` with a leading 1, fit to be the next row of the basis.
    """
    size = vector.shape[0]
    for j in range(size):
        vector[j] %= PRIME
    for i in range(rank):
        pivot = 0
        while basis[i, pivot] == 0:
            pivot += 1
        factor = vector[pivot]
        for j in range(size):
            vector[j] = (vector[j] - factor * basis[i, j]) % PRIME
    for pivot in range(size):
        if vector[pivot] != 0:
            inverse = _inverse(vector[pivot])
            for j in range(size):
                vector[j] = vector[j] * inverse % PRIME
            return True
    return False


@compiled
def _inverse(number):
    """Return the inverse of a number modulo `PRIME`: its power to ``PRIME - 2``, by Fermat's little theorem."""
    result, power, exponent = 1, number, PRIME - 2
    while exponent > 0:
        if exponent & 1:
            result = result * power % PRIME
        power = power * power % PRIME
        exponent >>= 1
    return result
