"""Where each robot is and where it has been: dead reckoning, held by matching each keyframe with the last one.

It matches with the kernels of `agents.slam`; in place of a pose graph, the error of a match is spread over the loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.component_config import ComponentConfig, kernel_tuple, pack
from agents.slam.scan_matching import (
    Estimate,
    MatcherConfig,
    MatcherValues,
    Prior,
    Reference,
    align,
    compare_endpoints,
)
from agents.slam.wall_lines import fit_wall_lines, measure_gaps, place_endpoints
from cyclic_env.jit import compiled

MATCHER = pack(MatcherValues, MatcherConfig())
KEYFRAME_SPACING = 1.0
"""Metres between two keyframes."""
CAPACITY = 128
"""Keyframes of each robot that there is room for at first."""
SECTORS = 16
"""Directions over each of which the ranges of a scan are averaged, to find keyframes that look like it."""
STEP_SPREAD = (0.05, 0.05, math.radians(4))
"""Standard deviations of dead reckoning from one keyframe to the next, metres, metres and radians."""
RATIO_MIN, INLIERS_MIN, ERROR_MAX = 0.75, 0.22, 1.0
"""A match with the last keyframe counts from this inlier ratio and share of all beams on, up to so many metres."""
MEMORY = 30
"""Keyframes over which the mean inlier ratio and the compass's variance are taken."""
REGULAR = 1e-6
"""Added to a hessian's diagonal, so that it has an inverse."""
REDRAW = 0.5
"""Metres by which mends have moved the track before the map is drawn anew."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerConfig(ComponentConfig):
    """What is expected of the sensors."""

    heading_std: float = math.radians(0.1)
    """Of the heading that matching two scans a metre apart gives; in simulation 0.03 to 0.12 degrees."""
    position_std: float = 0.01
    """Of the position that it gives."""
    bias_gain: float = 0.3
    """Share of the compass's error at a keyframe that lasts until the next: the field in a building changes slowly."""
    drift_share: float = 0.6
    """Share of the compass's error from keyframe to keyframe that may be left in the headings of a long way."""
    scale_std: float = 0.03
    """Of the distance meter's scale, before anything is known of it."""
    slip_std: float = 0.03
    """Of the way driven, metres per square root of a metre."""
    scale_endpoints: float = 2.0
    scale_distance: float = 0.5
    scale_turn: float = 0.2
    """A match tells the scale if so many endpoints tell the way driven, over so many metres, turning less than this."""
    scale_step: float = 0.02
    """By how much one match may change the scale, beyond its uncertainty: a few find the way far too short."""


TrackerValues = kernel_tuple("TrackerValues", TrackerConfig, __name__)
TRACKER = pack(TrackerValues, TrackerConfig())

ROBOT = np.dtype(
    [
        ("x", "f8"),  # in the frame of the track, which begins at (0, 0) with the compass's heading
        ("y", "f8"),
        ("heading", "f8"),
        ("compass", "f8"),  # last readings, and of the compass the bias, as the scans have it
        ("distance", "f8"),
        ("bias", "f8"),
        ("compass_variance", "f8"),  # of its turns from keyframe to keyframe
        ("inlier_ratio", "f8"),  # mean of the matches with the last keyframe
        ("scale", "f8"),  # metres driven for each metre that the distance meter shows
        ("scale_information", "f8"),
        ("path", "f8"),
        ("advance", "f8"),  # metres driven in the last decision
        ("claim_path", "f8"),  # path at the last claim
        ("target", "f8"),  # heading to drive to, in the frame of the track
        ("shift_x", "f8"),  # correction that the last good match called for, and at which path
        ("shift_y", "f8"),
        ("shift_path", "f8"),
        ("agreed", "f8"),  # metres over which all good matches have called for the same correction
        ("strain", "f8"),  # metres by which the track was mended since the map was drawn anew
        ("steps", "i8"),
        ("decisions", "i8"),
        ("keyframes", "i8"),
        ("anchor", "i8"),  # keyframe at which the track was mended last, and at which it was mended in all directions
        ("fixed", "i8"),
        ("begun", "?"),
    ]
)
"""What is known of one robot."""


class Keyframes(NamedTuple):
    """The keyframes of N robots, with room for K each; scans have the B beams that are matched."""

    pose: np.ndarray  # (N, K, 3)
    path: np.ndarray  # (N, K)
    compass: np.ndarray  # (N, K)
    step: np.ndarray  # (N, K)
    decision: np.ndarray  # (N, K)
    scan: np.ndarray  # (N, K, B) float32
    lines: np.ndarray  # (N, K, B, 3) float32
    ranges: np.ndarray  # (N, K, SECTORS) float32, means of the scan by direction in the frame of the track


class MatchScratch(NamedTuple):
    """Working memory of one thread: a scan and its reliable endpoints, the reference, and the equations."""

    scan: np.ndarray
    ranges: np.ndarray
    endpoints: np.ndarray
    reference: np.ndarray
    points: np.ndarray
    lines: np.ndarray
    prior: np.ndarray
    spread: np.ndarray
    pose: np.ndarray
    inverse: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray


def allocate_keyframes(robots: int, beams: int) -> Keyframes:
    """Return room for the first keyframes of N robots."""
    return Keyframes(
        pose=np.zeros((robots, CAPACITY, 3)),
        path=np.zeros((robots, CAPACITY)),
        compass=np.zeros((robots, CAPACITY)),
        step=np.zeros((robots, CAPACITY), np.int64),
        decision=np.zeros((robots, CAPACITY), np.int64),
        scan=np.zeros((robots, CAPACITY, beams), np.float32),
        lines=np.zeros((robots, CAPACITY, beams, 3), np.float32),
        ranges=np.zeros((robots, CAPACITY, SECTORS), np.float32),
    )


def enlarged(keyframes: Keyframes) -> Keyframes:
    """Return the keyframes with twice the room."""
    return Keyframes(*(np.concatenate([column, np.zeros_like(column)], axis=1) for column in keyframes))


def allocate_match_scratch(beams: int) -> MatchScratch:
    """Return the working memory of one thread."""
    return MatchScratch(
        scan=np.zeros(beams),
        ranges=np.zeros(SECTORS),
        endpoints=np.zeros(beams),
        reference=np.zeros(beams),
        points=np.zeros((beams, 3)),
        lines=np.zeros((beams, 3)),
        prior=np.zeros(3),
        spread=np.zeros(3),
        pose=np.zeros(3),
        inverse=np.zeros(3),
        hessian=np.zeros((3, 3)),
        gradient=np.zeros(3),
    )


@compiled
def wrap(angle):
    """Return the angle in [-pi, pi) that differs from `angle` by whole turns."""
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@compiled
def dead_reckon(robot, distance, east, north):
    """Move a robot by a reading of the distance meter and the compass; the first one begins its track."""
    heading = math.atan2(north, east)
    if robot.begun:
        driven = robot.scale * (distance - robot.distance)
        # An arc's chord points midway between the headings of its ends.
        chord = robot.compass + 0.5 * wrap(heading - robot.compass) + robot.bias
        robot.x += driven * math.cos(chord)
        robot.y += driven * math.sin(chord)
        robot.path += abs(driven)
        robot.advance += driven
        robot.steps += 1
    robot.begun = True
    robot.distance = distance
    robot.compass = heading
    robot.heading = wrap(heading + robot.bias)


@compiled
def average_ranges(robot, scratch):
    """Average the scan in `scratch` by direction in the frame of the track."""
    scan, ranges = scratch.scan, scratch.ranges
    n = scan.shape[0]
    ranges[:] = 0.0
    for b in range(n):
        ranges[math.floor((robot.heading / (2 * math.pi) + b / n) * SECTORS) % SECTORS] += scan[b] * SECTORS / n


@compiled
def match_keyframe(keyframes, i, k, scratch, range_max):
    """Match the scan in `scratch` with keyframe k of robot i, from the prior there, in the keyframe's frame.

    Returns
    -------
    inlier_ratio : float
        The less of both ways round.
    inliers : float
        Share of all beams.
    eigenvalue : float
        How many endpoints, as a share of all beams, speak for the position in the direction that is known least.
    """
    n = scratch.scan.shape[0]
    for b in range(n):
        scratch.reference[b] = keyframes.scan[i, k, b]
        for c in range(3):
            scratch.lines[b, c] = keyframes.lines[i, k, b, c]
    pose, hessian = scratch.pose, scratch.hessian
    place_endpoints(scratch.reference, scratch.points)
    measure_gaps(scratch.reference, scratch.lines, scratch.points, MATCHER)
    reference, prior = Reference(scratch.reference, scratch.points, scratch.lines), Prior(scratch.prior, scratch.spread)
    align(reference, scratch.endpoints, range_max, prior, Estimate(pose, hessian, scratch.gradient), MATCHER)
    there, seen_there = compare_endpoints(scratch.reference, scratch.scan, range_max, pose, MATCHER.tolerance)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    scratch.inverse[0] = -cos * pose[0] - sin * pose[1]
    scratch.inverse[1] = sin * pose[0] - cos * pose[1]
    scratch.inverse[2] = -pose[2]
    back, seen_back = compare_endpoints(scratch.scan, scratch.reference, range_max, scratch.inverse, MATCHER.tolerance)
    middle = 0.5 * (hessian[0, 0] + hessian[1, 1])
    eigenvalue = middle - math.sqrt(0.25 * (hessian[0, 0] - hessian[1, 1]) ** 2 + hessian[0, 1] ** 2)
    return min(there, back), min(seen_there, seen_back) / n, eigenvalue / n


@compiled
def set_prior(robot, x, y, heading, scratch):
    """Take, as the prior of a match, the robot's pose in the frame of the pose (x, y, heading)."""
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = robot.x - x, robot.y - y
    scratch.prior[0] = cos * dx + sin * dy
    scratch.prior[1] = cos * dy - sin * dx
    scratch.prior[2] = wrap(robot.heading - heading)


@compiled
def localize(robot, keyframes, i, scratch, range_max):
    """Correct the robot's pose by a match of its scan with the last keyframe."""
    k = robot.keyframes - 1
    x, y, heading = keyframes.pose[i, k, 0], keyframes.pose[i, k, 1], keyframes.pose[i, k, 2]
    set_prior(robot, x, y, heading, scratch)
    for c in range(3):
        scratch.spread[c] = STEP_SPREAD[c]
    ratio, inliers, _ = match_keyframe(keyframes, i, k, scratch, range_max)
    pose, prior = scratch.pose, scratch.prior
    robot.inlier_ratio += (ratio - robot.inlier_ratio) / min(MEMORY, k + 1)
    error = math.sqrt((pose[0] - prior[0]) ** 2 + (pose[1] - prior[1]) ** 2)
    if ratio <= RATIO_MIN or inliers <= INLIERS_MIN or error >= ERROR_MAX:
        return
    turn_error = wrap(robot.compass - keyframes.compass[i, k] - pose[2])
    robot.compass_variance += (turn_error**2 - robot.compass_variance) / min(MEMORY, k + 1)
    learn_scale(robot, scratch)
    cos, sin = math.cos(heading), math.sin(heading)
    robot.x, robot.y = x + cos * pose[0] - sin * pose[1], y + sin * pose[0] + cos * pose[1]
    # The compass has no drift, the scans' headings drift but little: a Kalman gain holds them together.
    gain = TRACKER.heading_std**2 / (TRACKER.heading_std**2 + robot.compass_variance)
    matched = heading + pose[2]
    matched += gain * wrap(robot.compass - matched)
    robot.bias = wrap(robot.bias + TRACKER.bias_gain * wrap(matched - robot.heading))
    robot.heading = wrap(matched)


@compiled
def solve_symmetric(matrix, x, y):
    """Return the solution of a symmetric `matrix` `(3, 3)` for the right side (x, y, 0)."""
    a, b, c = matrix[0, 0] + REGULAR, matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1] + REGULAR, matrix[1, 2], matrix[2, 2] + REGULAR
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    first, mixed, second = d * f - e * e, c * e - b * f, a * f - c * c
    return (
        (first * x + mixed * y) / determinant,
        (mixed * x + second * y) / determinant,
        ((b * e - c * d) * x + (b * c - a * e) * y) / determinant,
    )


@compiled
def learn_scale(robot, scratch):
    """Let a match with the last keyframe correct the distance meter's scale, as `ScanMatchingTracker` does."""
    pose, prior = scratch.pose, scratch.prior
    driven = math.sqrt(prior[0] ** 2 + prior[1] ** 2)
    if driven < TRACKER.scale_distance or abs(pose[2]) > TRACKER.scale_turn:
        return
    along_x, along_y = prior[0] / driven, prior[1] / driven
    # The covariance of the pose with its position along the way, in units of an endpoint's variance.
    x, y, turn = solve_symmetric(scratch.hessian, along_x, along_y)
    variance = MATCHER.endpoint_std**2 * (along_x * x + along_y * y)
    if variance > MATCHER.endpoint_std**2 / TRACKER.scale_endpoints:
        return
    # Without the prior, which has pulled at the match by as much as the endpoints did the other way.
    free = along_x * pose[0] + along_y * pose[1]
    for c, share in enumerate((x, y, turn)):
        free += MATCHER.endpoint_std**2 * share * (pose[c] - prior[c]) / scratch.spread[c] ** 2
    noise = variance + TRACKER.position_std**2 + TRACKER.slip_std**2 * driven
    information = (driven / robot.scale) ** 2 / noise
    error = robot.scale * free / driven - robot.scale
    most = math.sqrt(TRACKER.scale_step**2 + 1 / robot.scale_information)
    robot.scale_information += information
    robot.scale += information / robot.scale_information * max(-most, min(most, error))


@compiled
def add_keyframe(robot, keyframes, i, scratch, range_max):
    """Add a keyframe with the scan in `scratch` at the robot's pose."""
    k = robot.keyframes
    keyframes.pose[i, k, 0], keyframes.pose[i, k, 1], keyframes.pose[i, k, 2] = robot.x, robot.y, robot.heading
    keyframes.path[i, k] = robot.path
    keyframes.compass[i, k] = robot.compass
    keyframes.step[i, k] = robot.steps
    keyframes.decision[i, k] = robot.decisions
    for c in range(SECTORS):
        keyframes.ranges[i, k, c] = scratch.ranges[c]
    place_endpoints(scratch.endpoints, scratch.points)
    fit_wall_lines(scratch.endpoints, range_max, scratch.points, scratch.lines, MATCHER)
    for b in range(scratch.scan.shape[0]):
        keyframes.scan[i, k, b] = scratch.scan[b]
        for c in range(3):
            keyframes.lines[i, k, b, c] = scratch.lines[b, c]
    robot.keyframes += 1


@compiled
def mend(robot, keyframes, i, first, x, y, heading):
    """Move the robot to a pose, and spread its error over the way since the keyframe `first`."""
    dx, dy, turn, begin = x - robot.x, y - robot.y, wrap(heading - robot.heading), keyframes.path[i, first]
    length = max(robot.path - begin, 1e-6)
    for j in range(first + 1, robot.keyframes):
        share = (keyframes.path[i, j] - begin) / length
        keyframes.pose[i, j, 0] += share * dx
        keyframes.pose[i, j, 1] += share * dy
        keyframes.pose[i, j, 2] = wrap(keyframes.pose[i, j, 2] + share * turn)
    robot.x, robot.y, robot.heading = x, y, wrap(heading)
    robot.bias = wrap(robot.bias + turn)
    robot.anchor = robot.keyframes - 1
    robot.strain += math.sqrt(dx * dx + dy * dy)
