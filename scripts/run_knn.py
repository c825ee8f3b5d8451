"""Let the KNN explorer drive a building once, by default Killian Court; write a figure, an animation and the scores."""

from __future__ import annotations

if __name__ == "__main__":
    from _cli import run_script

    run_script(__file__)

import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core.event import RecordingListener, install_listener

from agents.knn.config import preset
from agents.knn.explorer import KnnExplorer
from agents.knn.policy import KnnPolicy
from cyclic_env import CyclicLoopEnv, Recorder, Recording, __version__
from cyclic_env.atomic_write import atomic_write, check_outputs, write_text_atomically
from cyclic_env.recording.format import write_recording
from cyclic_env.trajectory.io import write_g2o, write_tum
from cyclic_env.trajectory.metrics import ate
from scripts._arguments import EnvArguments, EnvOptions, Flag, OptionalFile, OptionalFolder, OptionalText, noise_presets
from scripts._cli import command, interruptible, progress_bar
from scripts._tables import format_rows, score_rows

if TYPE_CHECKING:
    from cyclic_env.rendering.gif import GifWriter

FIGURE_DPI = 150

INTERRUPTED = "interrupted"
EXPORTS = ("episode.npz", "true.tum", "dead_reckoned.tum", "corrected.tum", "pose_graph.g2o")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    map: str = "killian_court"
    """a shipped plan, a file, or a building such as generated:seed=7"""
    preset: str = "extended"
    """extended or paper"""
    detector: OptionalText = None
    """both, knn or position (default: both)"""
    measure: OptionalText = None
    """measure of similarity (default: cosine); it matters little where the position leaves few places to compare,
    so try it with --preset paper or --detector knn"""
    noise: str = "ideal"
    """ideal, calibrated, typical, poor or hard, or several with commas between, of which each reset draws one"""
    seed: int = 0
    """seed of the noise and the random start"""
    out: Path = Path("out/knn")
    """folder for the files"""
    json: OptionalFile = None
    """file for the metrics (default: metrics.json in --out)"""
    human: Flag = False
    """show the run in a window, in real time: 5 steps a second"""
    no_gif: Flag = False
    """write no animation, which would take half of the time"""
    export: OptionalFolder = None
    """write the recording, the trajectories (TUM) and the pose graph (g2o)"""
    env: EnvOptions = field(default_factory=EnvArguments)


@command(Options)
def main(args: Options) -> None:
    """Run the command."""
    import cyclic_env.rendering.figures  # noqa: F401 (before the run: it says what to do where matplotlib is missing)
    from cyclic_env.rendering.gif import GifWriter

    picture, metrics_file = args.out / "run.png", args.json or args.out / "metrics.json"
    animation = None if args.no_gif else args.out / "run.gif"
    exports = [] if args.export is None else [args.export / name for name in EXPORTS]
    files = [path for path in (picture, animation, metrics_file, *exports) if path]
    changes = {name: value for name in ("detector", "measure") if (value := getattr(args, name)) is not None}
    explorer = KnnPolicy(preset(args.preset, **changes).fitted(args.env.laser, args.env.robot))
    conditions = {"noise": noise_presets(args.noise), **args.env.settings()}
    env = CyclicLoopEnv(args.map, **conditions, render_mode="human" if args.human else None)
    check_outputs(files)
    run = Run(Recorder(env), GifWriter(env) if animation else None)
    with interruptible() as interruption:
        run.drive(explorer, args.seed)
    if interruption and not run.steps:
        raise interruption.stopped("there was no step yet, so there is nothing to keep.")
    settings = {"preset": args.preset, "detector": explorer.config.detector, "measure": explorer.config.measure}
    settings |= {"noise": args.noise, "seed": args.seed, "random_start": args.env.random_start}
    metrics = run.metrics() | settings | {"explorer": asdict(explorer.config), "cyclic_env": __version__}
    print(score_table(metrics))
    write_text_atomically(metrics_file, json.dumps(metrics, indent=1) + "\n")
    if args.export is not None:
        export(run, args.export)
    draw_run(run, metrics, picture)
    if run.animation is not None and animation is not None:
        run.animation.take(run.steps, last=True)
        run.animation.write(animation)
    written = ", ".join(map(str, files))
    if interruption:
        raise interruption.stopped(f"the {run.steps:,} steps up to here are in {written}.")
    print(f"\nwritten: {written}")


class Run:
    """One episode of the explorer, as far as it has come.

    Parameters
    ----------
    recorder : Recorder
        Around a `CyclicLoopEnv`.
    animation : GifWriter, optional

    Attributes
    ----------
    info : dict
        The last info.
    explorer : KnnExplorer or None
        The explorer with its memory; None before the first step.
    episode_return : float
    reward_terms : dict
        The return, by terms of the reward.
    steps : int
    ending : str
        Why the episode ended; `INTERRUPTED` until it has.
    stopped_at : int or None
        The step at which the explorer had nothing left to explore and stopped, to stand still from then on.
    env_s, agent_s : list of float
        Seconds that each step up to then took in the environment and in the agent. Steps in which numba compiled or
        loaded a kernel are left out.
    """

    def __init__(self, recorder: Recorder, animation: GifWriter | None = None) -> None:
        self.recorder = recorder
        self.animation = animation
        self.info: dict[str, Any] = {}
        self.explorer: KnnExplorer | None = None
        self.episode_return = 0.0
        self.reward_terms: dict[str, float] = {}
        self.steps = 0
        self.ending = INTERRUPTED
        self.stopped_at: int | None = None
        self.env_s: list[float] = []
        self.agent_s: list[float] = []

    @property
    def env(self) -> CyclicLoopEnv:
        """The environment."""
        env = self.recorder.unwrapped
        assert isinstance(env, CyclicLoopEnv)
        return env

    def drive(self, policy: KnnPolicy, seed: int) -> None:
        """Run the episode to its end."""
        compiling = RecordingListener()
        with install_listener("numba:compiler_lock", compiling), progress_bar(unit="step") as progress:
            observation, self.info = self.recorder.reset(seed=seed)
            progress.reset(total=self.env.step_budget)
            state = None
            while self.ending == INTERRUPTED:
                if self.animation is not None and self.stopped_at is None:
                    self.animation.take(self.steps)
                before = len(compiling.buffer)
                observation, state, seconds = self._step(policy, observation, state)
                if self.stopped_at is None and len(compiling.buffer) == before:
                    self.agent_s.append(seconds[0])
                    self.env_s.append(seconds[1])
                progress.set_postfix_str(
                    f"{self.info['coverage']:.0%} seen, {self.info['cycles_closed']} of "
                    f"{self.info['cycles_total']} cycles closed, {self.info['false_claims']} false claims",
                    refresh=False,
                )
                progress.update()

    def _step(self, policy: KnnPolicy, observation: Any, state: Any) -> tuple[Any, Any, tuple[float, float]]:
        """Decide and drive; return the observation, the policy's state, and the seconds that either took."""
        began = time.perf_counter()
        action, state = policy.predict(observation, state)
        decided = time.perf_counter()
        observation, reward, terminated, truncated, self.info = self.recorder.step(action)
        ended = time.perf_counter()
        (explorer,) = state
        self.explorer = explorer
        self.steps += 1
        self.episode_return += float(reward)
        for name, value in self.info["reward_terms"].items():
            self.reward_terms[name] = self.reward_terms.get(name, 0.0) + value
        if terminated or truncated:
            self.ending = "success" if terminated else "step budget spent"
        elif explorer.stopped and self.stopped_at is None:
            self.stopped_at = self.steps
        return observation, state, (decided - began, ended - decided)

    def recording(self) -> Recording:
        """Return the recording, with the explorer's corrected track: its keyframes after all corrections."""
        assert self.explorer is not None
        keyframes, start = self.explorer.keyframes, self.env.trajectory()[0, :2]
        corrected = np.column_stack([keyframes.step, keyframes.pose[:, :2] + start, keyframes.pose[:, 2]])
        return self.recorder.recording({"corrected": corrected})

    def metrics(self) -> dict[str, Any]:
        """Return the last info's scalars and the other measures of the run, as plain values."""
        assert self.explorer is not None
        plan = self.env.floor_plan
        tour = plan.closed_tour()
        watched = self.env.render_mode == "human"  # then a step of the environment waits for the window
        return {
            "map": plan.name,
            **{name: value for name, value in self.info.items() if name != "reward_terms"},
            "steps": self.steps,
            "return": self.episode_return,
            "reward_terms": self.reward_terms,
            "ending": self.ending,
            "stopped_at": self.stopped_at,
            "stop_reason": self.explorer.stop_reason,
            "path_over_tour": None if math.isnan(tour) else self.info["path_length_m"] / tour,
            "groups": len(self.explorer.groups),
            "rows": self.explorer.keyframes.count,
            "rows_compared": self.explorer.detector.compared,
            "open_areas": len(self.explorer.frontiers.listed),
            **track_errors(self.recording()),
            "seconds_per_step_env": None if watched else mean(self.env_s),
            "seconds_per_step_agent": mean(self.agent_s),
            "seconds_per_step_agent_median": statistics.median(self.agent_s) if self.agent_s else None,
        }


def mean(values: Sequence[float]) -> float | None:
    """Return the mean of the values, or None if there are none."""
    return statistics.fmean(values) if values else None


def track_errors(recording: Recording) -> dict[str, float | None]:
    """Return the errors of dead reckoning, at every step, and of the corrected track, at its keyframes; metres.

    ``ate`` is the absolute trajectory error in the true frame, ``aligned`` the one after a rigid alignment, and ``end``
    the error of the last position. The values are None if there is no keyframe yet.
    """
    true, errors = recording.poses[:, :2], dict[str, float | None]()
    corrected = recording.tracks["corrected"]
    estimates = {
        "dead_reckoning": (recording.dead_reckoned[:, :2], true),
        "corrected": (corrected[:, 1:3], true[corrected[:, 0].astype(int)]),
    }
    for name, (estimated, truth) in estimates.items():
        some = len(estimated) > 0
        errors[f"ate_{name}_m"] = ate(estimated, truth) if some else None
        errors[f"ate_{name}_aligned_m"] = ate(estimated, truth, align=True) if some else None
        errors[f"end_error_{name}_m"] = ate(estimated[-1:], truth[-1:]) if some else None
    return errors


def export(run: Run, folder: Path) -> None:
    """Write the files of `EXPORTS` into a folder."""
    assert run.explorer is not None
    recording = run.recording()
    corrected = recording.tracks["corrected"]
    write_recording(recording, folder / "episode.npz")
    write_tum(folder / "true.tum", recording.times, recording.poses)
    write_tum(folder / "dead_reckoned.tum", recording.times, recording.dead_reckoned)
    write_tum(folder / "corrected.tum", recording.dt * corrected[:, 0], corrected[:, 1:])
    poses, edges = run.explorer.tracker.graph(run.explorer.keyframes)
    start = np.array([*run.env.trajectory()[0, :2], 0.0])
    write_g2o(folder / "pose_graph.g2o", poses + start, edges)


def score_table(metrics: dict[str, Any]) -> str:
    """Return the scores, one per line."""
    scores = score_rows(metrics)
    if metrics["path_over_tour"] is not None:
        scores["path"] += f", {metrics['path_over_tour']:.2f} times the shortest tour of all corridors"
    tracks = [
        f"{title} {metrics[f'ate_{name}_m']:.2f} ({metrics[f'ate_{name}_aligned_m']:.2f} aligned)"
        for title, name in (("dead reckoning", "dead_reckoning"), ("corrected track", "corrected"))
        if metrics[f"ate_{name}_m"] is not None
    ]
    times = [
        f"{title} {1000 * seconds:.{digits}f} ms"
        for title, name, digits in (("env", "env", 2), ("agent", "agent", 2), ("the agent's median", "agent_median", 3))
        if (seconds := metrics[f"seconds_per_step_{name}"]) is not None
    ]
    since = metrics["stopped_at"]
    stopped = "" if since is None else f"; nothing left to explore from step {since:,} on ({metrics['stop_reason']})"
    rows = {
        "run": f"{metrics['map']}, {metrics['noise']} sensors, seed {metrics['seed']}, {metrics['preset']}, "
        f"{metrics['detector']}, {metrics['measure']}",
        **scores,
        "ATE RMSE (m)": ", ".join(tracks),
        "return": f"{metrics['return']:.1f}",
        "collisions": f"{metrics['collisions']}",
        "steps": f"{metrics['steps']:,}, ended by: {metrics['ending']}{stopped}",
        "groups": f"{metrics['groups']} of {metrics['rows']:,} rows, {metrics['rows_compared']:,} comparisons of rows",
        "open areas": f"{metrics['open_areas']}",
        "a step takes": ", ".join(times) or "-",
    }
    return format_rows(rows)


def draw_run(run: Run, metrics: dict[str, Any], file: Path) -> None:
    """Write the figure of a run: true path, groups, open areas and claims, all at their true positions."""
    from agents.knn.plotting import draw_groups, draw_open_areas
    from cyclic_env.rendering.figures import add_legend, draw_claims, draw_path, plan_figure

    assert run.explorer is not None
    plan, path, explorer = run.env.floor_plan, run.env.trajectory(), run.explorer
    scores = [
        f"{metrics['cycles_closed']} of {metrics['cycles_total']} cycles closed",
        f"{metrics['false_claims']} false claims",
        f"{metrics['revisits_recognised']} of {metrics['revisits']} revisits recognised",
        f"{metrics['coverage']:.1%} seen",
        f"{metrics['path_length_m']:,.0f} m driven",
    ]
    if metrics["path_over_tour"] is not None:
        scores[-1] += f" ({metrics['path_over_tour']:.2f} tours)"
    scores.append(f"{metrics['noise']} sensors, {metrics['preset']}, {metrics['detector']}")
    figure, axes = plan_figure(plan, plan.title or plan.name, "   ".join(scores))
    rows = path[explorer.keyframes.step, :2]
    draw_path(axes, path)
    draw_groups(axes, [(group.name, group.direction, rows[group.rows]) for group in explorer.groups])
    areas = explorer.frontiers.listed
    positions = np.array([rows[area.keyframe] + area.offset for area in areas]).reshape(-1, 2)
    draw_open_areas(axes, positions, [area.number for area in areas], [area.state for area in areas])
    draw_claims(axes, path, run.env.claims())
    add_legend(axes)
    with atomic_write(file) as part:
        figure.savefig(part, dpi=FIGURE_DPI)
