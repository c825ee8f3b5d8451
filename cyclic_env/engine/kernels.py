"""The compiled half of a step and of a reset: scan, mark, judge and reward, robot by robot."""

from __future__ import annotations

import math

from cyclic_env.jit import compiled
from cyclic_env.simulation.lidar import scan_row
from cyclic_env.task.coverage import mark_scan
from cyclic_env.task.loop_closure import advance, begin, judge_claim, precision_of, recall_of, settle_event
from cyclic_env.task.path_history import building_view, robot_view
from cyclic_env.task.rewards import reward_row


@compiled
def wrap_angle(angle):
    """Return the angle in (-pi, pi] that differs from `angle` by whole turns."""
    wrapped = angle - 2 * math.pi * math.ceil((angle - math.pi) / (2 * math.pi))
    return min(max(wrapped, -math.pi), math.pi)


@compiled
def begin_episode(buildings, episodes, row, pose):
    """Clear the robot's last episode, scan from the start, and mark the cells that the scan sees."""
    plan, ranges, grid = episodes.plan_of[row], episodes.true_ranges[row], episodes.grid
    robot = robot_view(episodes.memory, row)
    begin(robot, building_view(episodes.memory, plan), pose[0], pose[1])
    scan_row(buildings.walls, plan, pose, buildings.beams, episodes.scratch[row], ranges)
    grid.seen[row] = False
    outcome = episodes.outcome[row]
    outcome.reward, outcome.terminated, outcome.truncated, outcome.contact = 0.0, False, False, False
    outcome.cells_paid, outcome.episode_return = 0, 0.0
    outcome.cells_seen = mark_scan(grid, plan, row, pose, buildings.beams, ranges)
    episodes.terms[row] = 0.0
    info = episodes.info[row]
    info.collisions = 0
    info.cycles_total = episodes.memory.cycles_total[plan]
    report(info, robot.status, outcome.cells_seen / grid.cells_total[plan], buildings.coverage_complete, pose)


@compiled
def judge_rows(buildings, episodes, rows, claimed):
    """Scan, mark, judge and reward the step that the robots `rows` have just driven."""
    grid, rules, beams = episodes.grid, buildings.rules, buildings.beams
    scratch = episodes.scratch[rows[0] if len(rows) else 0]  # for all rows; no other thread has the same first row
    for row in rows:
        plan, drive, ranges = episodes.plan_of[row], episodes.drive[row], episodes.true_ranges[row]
        if episodes.memory.status[row].steps >= buildings.step_budget[plan]:
            continue  # the arrays have no room for another step
        outcome, info = episodes.outcome[row], episodes.info[row]
        robot, building = robot_view(episodes.memory, row), building_view(episodes.memory, plan)
        status = robot.status
        pose = (drive.x, drive.y, wrap_angle(drive.angle))
        scan_row(buildings.walls, plan, pose, beams, scratch, ranges)

        path_before, false_before = status.path_length, status.false_claims
        advance(robot, building, rules, drive.x, drive.y)
        if passed_multiple(path_before, status.path_length, buildings.scan_spacing):
            outcome.cells_seen += mark_scan(grid, plan, row, pose, beams, ranges)
        judge_claim(robot, building, rules, claimed[row])
        if drive.contact and not outcome.contact:
            info.collisions += 1
        outcome.contact = drive.contact

        cells_total = grid.cells_total[plan]
        report(info, status, outcome.cells_seen / cells_total, buildings.coverage_complete, pose)
        outcome.terminated = info.is_success or (buildings.terminate_on_collision and drive.contact)
        outcome.truncated = status.steps >= buildings.step_budget[plan] and not outcome.terminated
        if outcome.terminated or outcome.truncated:
            settle_event(robot, building, rules)
            report(info, status, outcome.cells_seen / cells_total, buildings.coverage_complete, pose)
        newly_seen = (outcome.cells_seen - outcome.cells_paid) / cells_total
        crashed = outcome.terminated and not info.is_success
        charged_steps = 1 + (buildings.step_budget[plan] - status.steps if crashed else 0)
        false_claims = status.false_claims - false_before
        units = (newly_seen, status.new_cycle, false_claims, status.missed_now, drive.contact, charged_steps)
        outcome.reward = reward_row(buildings.weights[plan], units, episodes.terms[row])
        outcome.cells_paid = outcome.cells_seen
        outcome.episode_return += outcome.reward


@compiled
def passed_multiple(before, after, spacing):
    """Tell whether a path growing from `before` to `after` passes a multiple of `spacing`; always if `spacing` is 0."""
    return spacing == 0 or math.floor(after / spacing) > math.floor(before / spacing)


@compiled
def report(info, status, share_seen, share_complete, pose):
    """Fill the robot's info, except for the number of cycles and the count of collisions."""
    info.is_success = share_seen >= share_complete and status.cycles_closed == info.cycles_total
    info.coverage = share_seen
    info.cycles_closed = status.cycles_closed
    info.revisit = status.revisit
    info.claim_judged = status.claim_judged
    info.claim_correct = status.claim_correct
    info.claim_error_m = status.claim_error
    info.claims = status.claims
    info.false_claims = status.false_claims
    info.revisits = status.revisits
    info.revisits_recognised = status.recognised
    info.precision = precision_of(status)
    info.recall = recall_of(status)
    info.new_cycle = status.new_cycle
    info.path_length_m = status.path_length
    info.x, info.y, info.heading = pose
