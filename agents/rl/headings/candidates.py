"""Where a robot may be back: old keyframes near its track, and how well its scan matches theirs."""

from __future__ import annotations

import math

from agents.rl.headings.memory import CANDIDATES
from agents.rl.headings.tracking import TRACKER, match_keyframe, mend, set_prior
from cyclic_env.jit import compiled

GATE, GATE_MIN, GATE_MAX = 2.0, 3.0, 15.0
"""Keyframes are candidates within so many times the expected error, at least and at most so many metres."""
CANDIDATE_SPACING = 2.5
"""Metres between two candidates."""
PRIOR_DISTANCE = 2.0
"""Metres from a candidate at which its match begins, at most."""
PRIOR_SPREAD = (2.0, 2.0, 0.1)
"""Standard deviations of the robot's pose about a candidate, metres, metres and radians."""
RIVAL_DISTANCE, RIVAL_BELOW = 1.5, 0.08
"""A match that calls for a pose so many metres away rivals one whose inlier ratio is better by less than that."""
FRESH = 3.0
"""Metres driven after which a match that has not been confirmed is forgotten."""
MENDS_BELOW, MENDS_INLIERS, MENDS_EIGENVALUE = 0.05, 0.28, 0.022
"""A match mends the track if its inlier ratio is less than the mean by at most so much, and from this share of all
beams on, that agree and that speak for each direction."""
AT_KEYFRAME = 2.5
"""Metres from the old keyframe within which the robot must be, then."""
SAME_SHIFT = 0.8
"""Metres between the corrections that two matches in a row call for, if both are right."""
LATERAL_MAX, LATERAL_MIN = 1.5, 0.1
"""Metres across a corridor by which a match that leaves the way along it open mends the track, at most and at least."""
OLD_ERROR = 0.25
"""Share of the path gap that still tells in the error of a track that was mended since: of the keyframes between."""
RATIO_DRIFT = 0.3
"""Metres by which the track may err for every metre of way, if scans of neighbouring keyframes agree in nothing."""
NONE, LATERAL, FULL = 0.0, 1.0, 2.0
"""What a match is good for: nothing, mending across a corridor, mending in all directions."""


@compiled
def expected_error(robot, keyframes, i, k):
    """Return by how many metres the track may err between keyframe k and the robot."""
    gap = robot.path - keyframes.path[i, k]
    since = robot.path - keyframes.path[i, robot.fixed]
    share = TRACKER.drift_share * math.sqrt(robot.compass_variance) + RATIO_DRIFT * (1 - robot.inlier_ratio)
    return share * min(gap, since + OLD_ERROR * gap)


@compiled
def find_candidates(memory, i, limits, scratch):
    """Choose keyframes near the track, of those that the robot would be back at by the rules.

    The nearest ones come first; the last one is that which looks most like the scan.
    """
    robot, keyframes, chosen = memory.robots[i], memory.keyframes, memory.candidate_keyframes[i]
    ranges = scratch.match.ranges
    for c in range(CANDIDATES):
        chosen[c] = -1
        best, farthest = math.inf, 0.0
        for k in range(robot.keyframes - 1, -1, -1):
            x, y = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1]
            distance = math.sqrt((x - robot.x) ** 2 + (y - robot.y) ** 2)
            farthest = max(farthest, distance)
            if farthest < limits.leave or robot.path - keyframes.path[i, k] < limits.gap:
                continue
            if distance > min(max(GATE * expected_error(robot, keyframes, i, k), GATE_MIN), GATE_MAX):
                continue
            cost = distance
            if c == CANDIDATES - 1:
                cost = 0.0
                for b in range(ranges.shape[0]):
                    cost += abs(ranges[b] - keyframes.ranges[i, k, b])
            if cost >= best:
                continue
            apart = True
            for other in range(c):
                dx, dy = x - keyframes.pose[i, chosen[other], 0], y - keyframes.pose[i, chosen[other], 1]
                apart = apart and math.sqrt(dx * dx + dy * dy) >= CANDIDATE_SPACING
            if apart:
                best, chosen[c] = cost, k
        if chosen[c] < 0:
            for other in range(c + 1, CANDIDATES):
                chosen[other] = -1
            return


@compiled
def match_candidates(memory, i, limits, scratch):
    """Match the scan with each candidate's, and write what came out as its features and, for the track, `matched`."""
    for c in range(CANDIDATES):
        memory.candidates[i, c] = 0.0
        scratch.matched[c] = 0.0
        if memory.candidate_keyframes[i, c] >= 0:
            match_candidate(memory, i, c, limits, scratch)
    compare_candidates(memory, i, scratch)


@compiled
def match_candidate(memory, i, c, limits, scratch):
    """Match the scan with that of candidate c."""
    robot, keyframes, match = memory.robots[i], memory.keyframes, scratch.match
    features, k, scan = memory.candidates[i, c], memory.candidate_keyframes[i, c], memory.scans[i]
    x, y, heading = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1], keyframes.pose[i, k, 2]
    set_prior(robot, x, y, heading, match)
    distance = math.sqrt(match.prior[0] ** 2 + match.prior[1] ** 2)
    match.prior[0] /= max(1.0, distance / PRIOR_DISTANCE)
    match.prior[1] /= max(1.0, distance / PRIOR_DISTANCE)
    for b in range(3):
        match.spread[b] = PRIOR_SPREAD[b]
    ratio, inliers, eigenvalue = match_keyframe(keyframes, i, k, match, limits.range_max)
    pose, matched = match.pose, scratch.matched[c]
    matched_distance = math.sqrt(pose[0] ** 2 + pose[1] ** 2)
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = x + cos * pose[0] - sin * pose[1] - robot.x, y + sin * pose[0] + cos * pose[1] - robot.y
    shift, expected = math.sqrt(dx * dx + dy * dy), expected_error(robot, keyframes, i, k)
    n = scan.shape[0]
    beam = round(math.atan2(match.inverse[1], match.inverse[0]) * n / (2 * math.pi)) % n
    features[0] = 1.0
    features[1] = distance / 4
    features[2] = ratio
    features[3] = min(max(4 * (ratio - robot.inlier_ratio), -1.0), 1.0)
    features[4] = inliers
    features[5] = min(10 * eigenvalue, 1.0)
    features[6] = min(matched_distance / 3, 2.0)
    features[7] = min(shift / 4, 2.0)
    features[8] = math.tanh((robot.path - keyframes.path[i, k]) / 200)
    features[9] = 1.0 if scan[beam] > matched_distance - 0.2 else 0.0
    features[10] = min(expected / 4, 2.0)
    features[11] = min(shift / (3 * expected + 0.5), 2.0)
    matched[0], matched[1], matched[2], matched[3], matched[4] = dx, dy, heading + pose[2], ratio, NONE
    if ratio < robot.inlier_ratio - MENDS_BELOW or inliers < MENDS_INLIERS:
        return
    if eigenvalue >= MENDS_EIGENVALUE:
        matched[4] = FULL if matched_distance < AT_KEYFRAME else NONE
        return
    # What the walls of a corridor say, they say across it.
    angle = heading + 0.5 * math.atan2(2 * match.hessian[0, 1], match.hessian[0, 0] - match.hessian[1, 1])
    across = dx * math.cos(angle) + dy * math.sin(angle)
    if abs(across) < LATERAL_MAX:
        matched[0], matched[1], matched[4] = across * math.cos(angle), across * math.sin(angle), LATERAL


@compiled
def compare_candidates(memory, i, scratch):
    """Write how each candidate's match does beside the others, and beside the last good match."""
    robot, matched = memory.robots[i], scratch.matched
    fresh = robot.path - robot.shift_path <= FRESH
    for c in range(CANDIDATES):
        if memory.candidate_keyframes[i, c] < 0:
            continue
        features = memory.candidates[i, c]
        rival = matched[c, 3] - 0.25
        for other in range(CANDIDATES):
            apart = math.sqrt((matched[c, 0] - matched[other, 0]) ** 2 + (matched[c, 1] - matched[other, 1]) ** 2)
            if apart > RIVAL_DISTANCE:
                rival = max(rival, matched[other, 3])
        features[12] = max(4 * (matched[c, 3] - rival), -1.0)
        off = math.sqrt((matched[c, 0] - robot.shift_x) ** 2 + (matched[c, 1] - robot.shift_y) ** 2)
        features[13] = math.exp(-off / SAME_SHIFT) if fresh else 0.0


@compiled
def mend_track(memory, i, scratch):
    """Mend the track of robot i by its best match, if none rivals it and the last good match called for the same."""
    robot, keyframes, matched = memory.robots[i], memory.keyframes, scratch.matched
    best = 0
    for c in range(1, CANDIDATES):
        if (matched[c, 4], matched[c, 3]) > (matched[best, 4], matched[best, 3]):
            best = c
    kind = matched[best, 4]
    if kind == NONE:
        return
    dx, dy = matched[best, 0], matched[best, 1]
    for c in range(CANDIDATES):
        far = math.sqrt((matched[c, 0] - dx) ** 2 + (matched[c, 1] - dy) ** 2) > RIVAL_DISTANCE
        if far and matched[c, 4] == kind and matched[c, 3] > matched[best, 3] - RIVAL_BELOW:
            return
    since = robot.path - robot.shift_path
    confirmed = since <= FRESH and abs(dx - robot.shift_x) < SAME_SHIFT and abs(dy - robot.shift_y) < SAME_SHIFT
    robot.agreed = robot.agreed + since if confirmed else 0.0
    robot.shift_x, robot.shift_y, robot.shift_path = dx, dy, robot.path
    if not confirmed or (kind == LATERAL and math.sqrt(dx * dx + dy * dy) < LATERAL_MIN):
        return
    k = memory.candidate_keyframes[i, best]
    first = max(k, robot.fixed if kind == FULL else robot.anchor)
    mend(robot, keyframes, i, first, robot.x + dx, robot.y + dy, matched[best, 2])
    if kind == FULL:
        robot.fixed = robot.keyframes - 1
    robot.shift_x, robot.shift_y = 0.0, 0.0
