"""Where a robot may be back: old keyframes near its track, and how well its scan matches theirs."""

from __future__ import annotations

import math

from agents.rl.headings.memory import CANDIDATES
from agents.rl.headings.tracking import match_keyframe, mend, set_prior
from cyclic_env.jit import compiled

DRIFT = 0.6
"""Share of the compass's error from keyframe to keyframe that may be left in the headings of a long way."""
GATE_MIN, GATE_MAX = 3.0, 12.0
"""Metres from the track within which keyframes are candidates, at least and at most."""
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


@compiled
def find_candidates(memory, i, limits, scratch):
    """Choose the keyframes nearest to the track of those that the robot would be back at by the rules."""
    robot, keyframes, chosen = memory.robots[i], memory.keyframes, memory.candidate_keyframes[i]
    drift = DRIFT * math.sqrt(robot.compass_variance)
    for c in range(CANDIDATES):
        chosen[c] = -1
        nearest, farthest = math.inf, 0.0
        for k in range(robot.keyframes - 1, -1, -1):
            x, y = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1]
            distance = math.sqrt((x - robot.x) ** 2 + (y - robot.y) ** 2)
            farthest = max(farthest, distance)
            gap = robot.path - keyframes.path[i, k]
            gate = min(max(drift * gap, GATE_MIN), GATE_MAX)
            if distance >= nearest or distance > gate or farthest < limits.leave or gap < limits.gap:
                continue
            apart = True
            for other in range(c):
                dx, dy = x - keyframes.pose[i, chosen[other], 0], y - keyframes.pose[i, chosen[other], 1]
                apart = apart and math.sqrt(dx * dx + dy * dy) >= CANDIDATE_SPACING
            if apart:
                nearest, chosen[c] = distance, k
        if chosen[c] < 0:
            for other in range(c + 1, CANDIDATES):
                chosen[other] = -1
            return


@compiled
def match_candidates(memory, i, limits, scratch):
    """Match the scan with each candidate's, and write what came out as its features and, in the track, `matched`."""
    robot, keyframes, match = memory.robots[i], memory.keyframes, scratch.match
    scan = memory.scans[i]
    n = scan.shape[0]
    for c in range(CANDIDATES):
        features, k = memory.candidates[i, c], memory.candidate_keyframes[i, c]
        features[:] = 0.0
        scratch.matched[c, 3] = -1.0
        if k < 0:
            continue
        x, y, heading = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1], keyframes.pose[i, k, 2]
        set_prior(robot, x, y, heading, match)
        distance = math.sqrt(match.prior[0] ** 2 + match.prior[1] ** 2)
        match.prior[0] /= max(1.0, distance / PRIOR_DISTANCE)
        match.prior[1] /= max(1.0, distance / PRIOR_DISTANCE)
        for b in range(3):
            match.spread[b] = PRIOR_SPREAD[b]
        ratio, inliers, eigenvalue = match_keyframe(keyframes, i, k, match, limits.range_max)
        pose = match.pose
        matched_distance = math.sqrt(pose[0] ** 2 + pose[1] ** 2)
        cos, sin = math.cos(heading), math.sin(heading)
        matched_x, matched_y = x + cos * pose[0] - sin * pose[1], y + sin * pose[0] + cos * pose[1]
        shift = math.sqrt((matched_x - robot.x) ** 2 + (matched_y - robot.y) ** 2)
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
        if (
            ratio >= robot.inlier_ratio - MENDS_BELOW
            and inliers >= MENDS_INLIERS
            and eigenvalue >= MENDS_EIGENVALUE
            and matched_distance < AT_KEYFRAME
        ):
            scratch.matched[c, 0], scratch.matched[c, 1] = matched_x, matched_y
            scratch.matched[c, 2], scratch.matched[c, 3] = heading + pose[2], ratio


@compiled
def mend_track(memory, i, scratch):
    """Mend the track of robot i by its best match, if none rivals it and the last good match called for the same."""
    robot, matched = memory.robots[i], scratch.matched
    best = 0
    for c in range(1, CANDIDATES):
        if matched[c, 3] > matched[best, 3]:
            best = c
    if matched[best, 3] < 0.0:
        return
    x, y = matched[best, 0], matched[best, 1]
    for c in range(CANDIDATES):
        far = math.sqrt((matched[c, 0] - x) ** 2 + (matched[c, 1] - y) ** 2) > RIVAL_DISTANCE
        if far and matched[c, 3] > matched[best, 3] - RIVAL_BELOW:
            return
    dx, dy = x - robot.x, y - robot.y
    confirmed = (
        robot.path - robot.shift_path <= FRESH
        and abs(dx - robot.shift_x) < SAME_SHIFT
        and abs(dy - robot.shift_y) < SAME_SHIFT
    )
    robot.shift_x, robot.shift_y, robot.shift_path = dx, dy, robot.path
    if confirmed:
        mend(robot, memory.keyframes, i, memory.candidate_keyframes[i, best], x, y, matched[best, 2])
        robot.shift_x, robot.shift_y = 0.0, 0.0
