"""Calibrate the threshold of each similarity measure on generated training plans; write agents/knn/thresholds.json."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import itertools
import json
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.knn.config import THRESHOLDS, preset
from agents.knn.loop_detector import AppearanceDetector, CombinedDetector
from agents.knn.policy import KnnPolicy
from agents.knn.similarity import MEASURES
from agents.slam.keyframes import Keyframes
from cyclic_env import CyclicLoopEnv
from cyclic_env.atomic_write import check_writable, write_text_atomically
from cyclic_env.config import ClosureConfig, RewardConfig
from cyclic_env.errors import ConfigError
from cyclic_env.floor_plans.generator.spec import SPLITS
from cyclic_env.task.loop_closure import ELSEWHERE, RETURNS
from cyclic_env.task.trajectory_truth import true_returns
from scripts._cli import command, progress_bar

PROCESSES_MAX = 64
NOISES = ("ideal", "calibrated")
DETECTORS = {"both": CombinedDetector, "knn": AppearanceDetector}
REWARD = RewardConfig()
DIGITS = 9
"""Number of decimals kept: rounding errors of a cosine are far smaller, differences between places far larger."""


@dataclass(frozen=True, slots=True)
class TrainingRun:
    """The keyframes of a run, and which of them are the same place."""

    columns: dict[str, np.ndarray]
    """By the attributes of `Keyframes`, each `(n, ...)`."""
    truth: np.ndarray
    """`(n, n)`, as returned by `true_returns`."""


def training_run(index: int, noise: str) -> TrainingRun:
    """Let the extended explorer drive a training plan; no threshold has an effect on where it drives."""
    env, policy = CyclicLoopEnv(f"generated:train,index={index}", noise=noise), KnnPolicy()
    observation, _ = env.reset(seed=index)
    state, ended = None, False
    while not ended:
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated or state[0].done
    assert state is not None
    keyframes, trajectory = state[0].keyframes, env.trajectory()
    names = ("features", "direction", "group", "step", "path", "odometry")
    columns = {name: getattr(keyframes, name).copy() for name in names}
    truth = true_returns(env.floor_plan, trajectory, keyframes.step, ClosureConfig())
    env.close()
    return TrainingRun(columns, truth)


def revisits(run: TrainingRun) -> int:
    """Return how many keyframes of a run return to an earlier one."""
    return int((run.truth == RETURNS).any(axis=1).sum())


def answers(run: TrainingRun, detector: AppearanceDetector) -> tuple[np.ndarray, np.ndarray]:
    """Return the similarity of the vote's answer at each keyframe that has one, and the truth about it."""
    keyframes = Keyframes(1, run.columns["features"].shape[2])
    similarities, outcomes = [], []
    for i in range(len(run.truth)):
        keyframes.add(**{name: column[i] for name, column in run.columns.items()})
        rows, likeness = detector.vote.nearest(keyframes, detector.candidates(keyframes))
        if len(rows):
            similarities.append(float(likeness[0]))
            outcomes.append(int(run.truth[i, rows[0]]))
    return np.array(similarities), np.array(outcomes, np.int64)


def best_threshold(similarity: np.ndarray, outcome: np.ndarray, total: int) -> dict[str, float]:
    """Return the threshold that earns most by the environment's reward, and the scores at this threshold.

    A correct answer saves the penalty of a missed revisit, and a wrong one costs that of a false claim. If no threshold
    earns anything, the one with the best F1 score is returned.

    Parameters
    ----------
    similarity, outcome : (q,)
        Those of all answers. Answers whose claims would be ignored don't count.
    total : int
        Number of keyframes that return anywhere, by which the recall is divided.
    """
    certain = outcome >= ELSEWHERE
    order = np.argsort(-similarity[certain], kind="stable")
    similarity, right = similarity[certain][order], outcome[certain][order] == RETURNS
    last = np.flatnonzero(np.append(np.diff(similarity) < 0, True))
    taken = similarity[last]
    precision, recall = np.cumsum(right)[last] / (last + 1), np.cumsum(right)[last] / total
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
    rights = np.cumsum(right)[last]
    worth = -REWARD.missed_revisit * rights + REWARD.false_claim * (last + 1 - rights)
    best, surest = int(np.argmax(worth if worth.max(initial=0.0) > 0 else f1)), int(np.argmax(precision))
    # Answers above the threshold are taken, so it lies between the last one to take and the next.
    beyond = taken[best + 1] if best + 1 < len(taken) else taken[best] - 10.0**-DIGITS
    entry = {"threshold": (taken[best] + beyond) / 2, "f1": f1[best], "precision": precision[best]}
    entry |= {"recall": recall[best], "highest_precision": precision[surest], "recall_there": recall[surest]}
    return {name: round(float(value), DIGITS) for name, value in entry.items()}


def calibrate(runs: Sequence[TrainingRun]) -> dict[str, dict[str, dict[str, float]]]:
    """Return for each detector and measure the best threshold over all runs, and its scores."""
    total = sum(revisits(run) for run in runs)
    result: dict[str, dict[str, dict[str, float]]] = {}
    for detector, kind in DETECTORS.items():
        for measure in MEASURES:
            config = preset("paper", detector=detector, measure=measure, threshold=-1.0)
            pairs = [answers(run, kind(config)) for run in runs]
            similarity, outcome = (np.concatenate(columns) for columns in zip(*pairs, strict=True))
            result.setdefault(detector, {})[measure] = best_threshold(similarity, outcome, total)
    return result


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    plans: int = 20
    """number of plans of the train split"""
    out: Path = THRESHOLDS
    """file to write; by default the explorer's own"""
    processes: int = 2
    """number of runs at once"""


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
    most = SPLITS["train"].plans
    if not 1 <= args.plans <= most:
        raise ConfigError(f"--plans is {args.plans}; expected 1 to {most}, the plans of the train split.")
    if not 1 <= args.processes <= PROCESSES_MAX:
        raise ConfigError(f"--processes is {args.processes}; expected 1 to {PROCESSES_MAX}.")
    check_writable(args.out)
    jobs = [(index, noise) for index in range(args.plans) for noise in NOISES]
    with progress_bar(unit="run", total=len(jobs)) as progress:
        runs = []
        for run in each_run(jobs, args.processes):
            runs.append(run)
            progress.update()
    result: dict[str, Any] = {
        "command": f"python scripts/calibrate_thresholds.py --plans {args.plans}",
        "plans": f"generated:train, index 0 to {args.plans - 1}; noise {' and '.join(NOISES)}; preset extended",
        "rule": "vote of 4 among earlier tables of the same direction; most worth by the reward, else best F1",
        "rows": sum(len(run.truth) for run in runs),
        "revisits": sum(revisits(run) for run in runs),
        "detectors": calibrate(runs),
    }
    write_text_atomically(args.out, json.dumps(result, indent=1) + "\n")
    for detector, measures in result["detectors"].items():
        for name, entry in measures.items():
            print(f"{detector:>5} {name:>12}  " + "  ".join(f"{key} {value:.4f}" for key, value in entry.items()))
    print(f"\nwritten: {args.out}")


def each_run(jobs: Sequence[tuple[int, str]], processes: int) -> Iterator[TrainingRun]:
    """Yield the training runs in the order of the jobs."""
    if processes == 1:
        yield from itertools.starmap(training_run, jobs)
        return
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(training_run, *zip(*jobs, strict=True))
