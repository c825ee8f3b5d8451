"""Which matches bear each other out: the largest sets in which every two tell of the same place.

After J. G. Mangelson et al., "Pairwise Consistent Measurement Set Maximization", ICRA 2018, with a greedy search.
"""

from __future__ import annotations

import math

from cyclic_env.jit import compiled


@compiled
def find_consistent(now, rows, paths, limits, agrees):
    """Set `agrees` `(m, m)` where two matches put the robot at the same place.

    Parameters
    ----------
    now : (m, 3)
        Where each match would put the robot now.
    rows, paths : (m,)
        At which row and at which metre of the way each one was found; two of one row don't bear each other out.
    limits : (4,)
        Metres and radians by which two may differ, and how much more of each for every metre driven between them.
    agrees : (m, m) bool
        Written to.
    """
    for a in range(now.shape[0]):
        for b in range(now.shape[0]):
            driven = abs(paths[a] - paths[b])
            dx, dy = now[a, 0] - now[b, 0], now[a, 1] - now[b, 1]
            turn = now[a, 2] - now[b, 2]
            turn -= 2 * math.pi * math.floor((turn + math.pi) / (2 * math.pi))
            agrees[a, b] = (
                rows[a] != rows[b]
                and math.sqrt(dx * dx + dy * dy) < limits[0] + limits[2] * driven
                and abs(turn) < limits[1] + limits[3] * driven
            )


@compiled
def grow_set(agrees, start, members, candidates):
    """Write into `members` `(m,)` a large set of matches with `start` that all agree; return how many.

    Greedy: of the matches that agree with all members, the one that agrees with most others joins. `candidates` `(m,)`
    is scratch.
    """
    count, n = 1, agrees.shape[0]
    members[0] = start
    for a in range(n):
        candidates[a] = agrees[start, a]
    while True:
        best, most = -1, -1
        for a in range(n):
            if candidates[a]:
                support = 0
                for b in range(n):
                    support += candidates[b] and agrees[a, b]
                if support > most:
                    best, most = a, support
        if best < 0:
            return count
        members[count] = best
        count += 1
        for a in range(n):
            candidates[a] = candidates[a] and agrees[best, a]
