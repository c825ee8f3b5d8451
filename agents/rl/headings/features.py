"""What the agent is told of each heading and of the robot as a whole, and how the robot holds a heading."""

from __future__ import annotations

import math

from agents.exploration.visibility import clear_beam, clear_lengths
from agents.rl.headings.candidates import FRESH
from agents.rl.headings.grid import UNREACHED
from agents.rl.headings.memory import HEADINGS
from agents.rl.headings.tracking import wrap
from cyclic_env.jit import compiled


@compiled
def describe_headings(memory, i, limits, ahead):
    """Write the features of each heading."""
    clear = memory.clear[i]
    clear_lengths(memory.scans[i], limits.half_width, clear)
    n = clear.shape[0]
    nearest_undriven, nearest_unseen = UNREACHED, UNREACHED
    for h in range(HEADINGS):
        nearest_undriven = min(nearest_undriven, ahead.undriven[h])
        nearest_unseen = min(nearest_unseen, ahead.unseen[h])
    for h in range(HEADINGS):
        features = memory.headings[i, h]
        longest = 0.0
        for b in range(-(n // 90), n // 90 + 1):
            longest = max(longest, clear[(round(h * n / HEADINGS) + b) % n])
        features[0] = longest / limits.range_max
        features[1] = math.exp(-ahead.undriven[h] / 20)
        features[2] = math.exp(-ahead.unseen[h] / 20)
        features[3] = math.log1p(ahead.undriven_mass[h]) / 5
        features[4] = math.log1p(ahead.unseen_mass[h]) / 3
        features[5] = ahead.recent[h]
        # The nearest of all stands out.
        if ahead.undriven[h] < UNREACHED and ahead.undriven[h] == nearest_undriven:
            features[1] += 0.5
        if ahead.unseen[h] < UNREACHED and ahead.unseen[h] == nearest_unseen:
            features[2] += 0.5


@compiled
def describe_robot(memory, i, limits, ahead):
    """Write the features of the robot as a whole."""
    robot, features = memory.robots[i], memory.robot[i]
    undriven, unseen = UNREACHED, UNREACHED
    for h in range(HEADINGS):
        undriven, unseen = min(undriven, ahead.undriven[h]), min(unseen, ahead.unseen[h])
    since_claim, off = robot.path - robot.claim_path, wrap(robot.target - robot.heading)
    features[0] = math.exp(-undriven / 20)
    features[1] = math.exp(-unseen / 20)
    features[2] = 1.0 if undriven < UNREACHED else 0.0
    features[3] = 1.0 if unseen < UNREACHED else 0.0
    features[4] = 1.0 if since_claim >= limits.claim_spacing else 0.0
    features[5] = min(since_claim / 20, 1.0)
    features[6] = robot.advance / limits.advance_max
    features[7] = math.cos(off)
    features[8] = math.sin(off)
    features[9] = robot.inlier_ratio
    features[10] = math.tanh(robot.agreed / 5) if robot.path - robot.shift_path <= FRESH else 0.0
    features[11] = min(20 * math.sqrt(robot.compass_variance), 2.0)


@compiled
def steer_rows(memory, limits, scratch, rows, actions):
    """Write the drive of the robots `rows` towards their targets, or the nearest bearing that is clear."""
    scan, clear, stride = scratch.steering, scratch.steering_clear, limits.stride
    for i in rows:
        ranges, robot = memory.laser[i], memory.robots[i]
        n = ranges.shape[0]
        for k in range(scan.shape[0]):
            scan[k] = math.inf
            for b in range(k * stride - stride // 2, k * stride + stride // 2 + 1):
                # A range far below those beside it is noise.
                beside = 0.5 * (ranges[(b - 1) % n] + ranges[(b + 1) % n]) - 0.5
                scan[k] = min(scan[k], max(ranges[b % n], beside))
        clear_lengths(scan, limits.half_width, clear)
        bearing = wrap(robot.target - robot.heading)
        for needed in (1.0, 0.5):
            free = clear_beam(clear, bearing, needed)
            if abs(free - bearing) < 1.2:
                bearing = wrap(free)
                break
        # Turn on the spot when the way is off to the side or behind, and slow down for what is ahead.
        speed = math.cos(bearing) ** 4 if abs(bearing) < 1.2 else 0.0
        actions[i, 0] = speed * min(1.0, max(0.15, (clear[0] - limits.half_width) / 0.8))
        actions[i, 1] = 0.8 * max(-1.0, min(1.0, 1.6 * bearing))
