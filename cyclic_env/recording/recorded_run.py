"""The player of robots' logs: an environment whose robot drives as the recorded one did."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from cyclic_env.config import ActionType, ClosureConfig, EnvConfig, RobotConfig
from cyclic_env.engine.actions import check_actions, decode_actions
from cyclic_env.engine.building import INFO
from cyclic_env.envs.spaces import action_space, observation_space
from cyclic_env.errors import RecordingError, UsageError
from cyclic_env.floor_plans import FloorPlan, load_floor_plan
from cyclic_env.jit import compiled
from cyclic_env.recording.readers import read_robot_log
from cyclic_env.recording.robot_log import RobotLog
from cyclic_env.task.loop_closure import (
    advance_along,
    begin,
    closure_rules,
    judge_claim,
    precision_of,
    recall_of,
    settle_event,
)
from cyclic_env.task.path_history import building_view, robot_view
from cyclic_env.task.rewards import REWARD_TERMS, reward_weights
from cyclic_env.task.trajectory_truth import closure_config_for, memory_for
from cyclic_env.trajectory.poses import compose
from cyclic_env.validation import from_mapping


class RecordedRun(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A robot's log as an environment. It gives an agent the log's observations and judges the agent's claims.

    The wheels' part of an action is ignored: each step leads to the log's next scan. The observations have the form of
    `CyclicLoopEnv`; see `RobotLog.observations`. No sensor measures sideways motion.

    The log's reference poses are the truth by which claims are judged, as `cyclic_env.task.loop_closure` defines it.
    Sight and cycles come from the floor plan, on which the log's `map_transform` places the reference; without a plan
    nothing blocks the sight, and there are no cycles.

    The infos have the keys of `CyclicLoopEnv`. `coverage` and `collisions` are 0, since they are not measured.
    `is_success` says that all cycles have been closed. The episode is truncated at the end of the log.

    Parameters
    ----------
    log : RobotLog, str or path
        A log with reference poses, its file, or the name of a log in ``maps/recorded``.
    plan : FloorPlan, optional
        The building. Default: the shipped one that the log names.
    closure : ClosureConfig or mapping, optional
        Default: the environment's, with as much tolerance of walls as the reference needs
        (`cyclic_env.task.trajectory_truth.closure_config_for`).
    action_type : {"wheels", "twist", "discrete"}

    Attributes
    ----------
    log : RobotLog
    config : EnvConfig
        The settings of an environment with such observations: the log's laser, and a robot that can drive as far in a
        step as the log does.
    floor_plan : FloorPlan or None
    step_budget : int
        Number of steps from the log's first scan to its last.

    Raises
    ------
    RecordingError
        If the log can't be read, has no reference poses, or has a plan but no `map_transform`.
    UsageError
        If its reference doesn't lie on the plan.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own)

    def __init__(
        self,
        log: RobotLog | str | Path = "killian_run",
        *,
        plan: FloorPlan | None = None,
        closure: ClosureConfig | Mapping[str, Any] | None = None,
        action_type: ActionType = "wheels",
    ) -> None:
        self.log = log = log if isinstance(log, RobotLog) else read_robot_log(log)
        self.floor_plan = load_floor_plan(log.map_name) if plan is None and log.map_name is not None else plan
        if log.reference is None:
            raise RecordingError(f"the log {log.name!r} has no reference poses; they are needed to judge claims.")
        if self.floor_plan is not None and log.map_transform is None:
            raise RecordingError(f"the log {log.name!r} has no map_transform, which places it on the floor plan.")
        transform = (0.0, 0.0, 0.0) if self.floor_plan is None else log.map_transform
        self._poses = compose(transform, log.reference)
        if closure is None:
            closure = closure_config_for(self.floor_plan, self._poses)
        self.step_budget = len(log) - 1
        self.config = EnvConfig(
            map_name=log.map_name or log.name,
            action_type=action_type,
            step_budget=self.step_budget,
            robot=_robot_of(log),
            laser=log.laser,
            closure=from_mapping(ClosureConfig, closure),
        )
        self.action_space = action_space(action_type)
        self.observation_space = observation_space(log.laser)
        self._observations = log.observations()
        steps = np.diff(self._poses[:, :2], axis=0)
        self._path_lengths = np.append(0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1])))
        track = np.column_stack([self._poses[:, :2], self._path_lengths])
        self._memory = memory_for(self.floor_plan, track, self.config.closure)
        self._rules = closure_rules(self.config.closure)
        budget = np.array([self.step_budget])
        self._weights = reward_weights(self.config.reward, self._memory.cycles_total, budget)[0]
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Go back to the log's first scan; the seed changes nothing."""
        super().reset(seed=seed)
        _begin(self._memory, self._poses[0, 0], self._poses[0, 1])
        self._running = True
        return self._observation(), self._info(np.zeros(len(REWARD_TERMS)))

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Go to the log's next scan, and judge the action's claim, if it makes one."""
        if not self._running:
            raise UsageError("there is no running episode: call reset() first, and again after each episode.")
        actions = check_actions([action], self.config.action_type, 1)
        commands, claimed = np.empty((1, 2)), np.empty(1, np.int64)
        decode_actions(actions, self.config.action_type, self.config.robot, self._memory.status, commands, claimed)
        status = self._memory.status[0]
        step, false_claims = int(status["steps"]) + 1, int(status["false_claims"])
        ends = step == self.step_budget
        x, y, _ = self._poses[step]
        _take_step(self._memory, self._rules, x, y, self._path_lengths[step], claimed[0], ends)
        counts = {
            "new_cycle": status["new_cycle"],
            "false_claim": status["false_claims"] - false_claims,
            "missed_revisit": status["missed_now"],
            "time": 1,
        }
        terms = self._weights * np.array([float(counts.get(term, 0)) for term in REWARD_TERMS]) + 0.0
        self._running = not ends
        return self._observation(), float(terms.sum()), False, ends, self._info(terms)

    def _observation(self) -> dict[str, np.ndarray]:
        step = int(self._memory.status[0]["steps"])
        return {name: values[step].copy() for name, values in self._observations.items()}

    def _info(self, terms: np.ndarray) -> dict[str, Any]:
        status = self._memory.status[0]
        x, y, heading = self._poses[int(status["steps"])].tolist()
        closed, total = int(status["cycles_closed"]), int(self._memory.cycles_total[0])
        values = {
            "is_success": total > 0 and closed == total,
            "cycles_closed": closed,
            "cycles_total": total,
            "revisit": bool(status["revisit"]),
            "claim_judged": bool(status["claim_judged"]),
            "claim_correct": bool(status["claim_correct"]),
            "claim_error_m": float(status["claim_error"]),
            "claims": int(status["claims"]),
            "false_claims": int(status["false_claims"]),
            "revisits": int(status["revisits"]),
            "revisits_recognised": int(status["recognised"]),
            "precision": float(precision_of(status)),
            "recall": float(recall_of(status)),
            "new_cycle": bool(status["new_cycle"]),
            "path_length_m": float(status["path_length"]),
            "x": x,
            "y": y,
            "heading": heading,
        }
        info = {name: values.get(name, np.zeros((), INFO[name]).item()) for name in INFO.names or ()}
        return info | {"reward_terms": dict(zip(REWARD_TERMS, terms.tolist(), strict=True))}

    @property
    def poses(self) -> np.ndarray:
        """The reference's pose at every scan of the log, on the floor plan if there is one, `(n, 3)`."""
        return self._poses.copy()

    def trajectory(self) -> np.ndarray:
        """Return the true path so far, `(t + 1, 3)`: x, y on the floor plan and path length, metres."""
        return self._memory.track[0, : int(self._memory.status[0]["steps"]) + 1].copy()

    def claims(self) -> np.ndarray:
        """Return the judged claims so far: `(n,)` records of `cyclic_env.task.path_history.CLAIM`."""
        return self._memory.claims[0, : int(self._memory.status[0]["claims"])].copy()


def _robot_of(log: RobotLog) -> RobotConfig:
    """Return the configuration of a robot that can drive as far in a step as the log does."""
    default = RobotConfig()
    dt = max(float(np.median(np.diff(log.times))), 1e-3)
    steps = np.diff(log.odometry[:, :2], axis=0)
    advance = max(float(np.hypot(steps[:, 0], steps[:, 1]).max()), default.wheel_speed_max * dt)
    substeps = math.ceil(2.001 * advance / default.radius)
    return RobotConfig(dt=dt, wheel_speed_max=advance / dt, substeps=min(max(substeps, default.substeps), 1000))


@compiled
def _begin(memory, x, y):
    """Forget the robot's path and begin a new one at (x, y)."""
    begin(robot_view(memory, 0), building_view(memory, 0), x, y)


@compiled
def _take_step(memory, rules, x, y, path_length, claimed, ends):
    """Go to (x, y), judge the claim, and settle the open revisit event if the episode `ends`."""
    robot, building = robot_view(memory, 0), building_view(memory, 0)
    advance_along(robot, building, rules, x, y, path_length)
    judge_claim(robot, building, rules, claimed)
    if ends:
        settle_event(robot, building, rules)
