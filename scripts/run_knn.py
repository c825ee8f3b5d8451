"""Let the KNN explorer drive a building once, by default Killian Court; write a figure, an animation and the scores."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # agents are not installed, but run from the checkout
if __name__ == "__main__":  # Ctrl-C while the packages load
    signal.signal(signal.SIGINT, lambda *_: (print("\nrun_knn.py: nothing done yet", file=sys.stderr), os._exit(130)))

import argparse
import json
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import event

from agents.knn.config import DETECTORS, PRESETS, preset
from agents.knn.explorer import KnnExplorer
from agents.knn.policy import KnnPolicy
from agents.knn.similarity import MEASURES
from cyclic_env import CyclicLoopEnv, CyclicLoopError, Recorder, Recording, __version__, map_names
from cyclic_env.atomic_write import atomic_write, check_outputs, write_text_atomically
from cyclic_env.console import ProgressLine, say
from cyclic_env.evaluation.rollout import format_rows, score_rows
from cyclic_env.recording.format import write_recording
from cyclic_env.trajectory.io import write_g2o, write_tum
from cyclic_env.trajectory.metrics import ate

if TYPE_CHECKING:
    from cyclic_env.rendering.gif import GifWriter

FIGURE_DPI = 150

EXPORTS = ("episode.npz", "true.tum", "dead_reckoned.tum", "corrected.tum", "pose_graph.g2o")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 2 for bad input, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--map",
        default="killian_court",
        help=f"{', '.join(map_names())}, a file, or a building such as generated:seed=7 (default killian_court)",
    )
    parser.add_argument("--preset", default="extended", help=f"{' or '.join(PRESETS)} (default extended)")
    parser.add_argument("--detector", help=f"{', '.join(DETECTORS)} (default: both; with paper: knn)")
    parser.add_argument(
        "--measure",
        help=f"of similarity: {', '.join(MEASURES)} (default cosine); it changes little where the position leaves few "
        "places to compare: see it with paper or --detector knn",
    )
    parser.add_argument("--noise", default="ideal", help="ideal, calibrated, typical or poor (default ideal)")
    parser.add_argument("--seed", type=int, default=0, help="of noise and random start (default 0)")
    parser.add_argument("--random-start", action="store_true", help="draw the start (default: the plan's own)")
    parser.add_argument("--out", type=Path, default=Path("out/knn"), help="folder for the files (default out/knn)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="for the metrics (default: metrics.json in --out)")
    parser.add_argument("--human", action="store_true", help="show the run in a window, in real time: 5 steps a second")
    parser.add_argument("--no-gif", action="store_true", help="write no animation, which takes half of the time")
    parser.add_argument(
        "--export", type=Path, metavar="FOLDER", help="write the recording, the trajectories (TUM) and the graph (g2o)"
    )
    args = parser.parse_args(arguments)
    picture, metrics_file = args.out / "run.png", args.json or args.out / "metrics.json"
    animation = None if args.no_gif else args.out / "run.gif"
    try:
        import cyclic_env.rendering.figures  # noqa: F401 (before the run: it says what to do where matplotlib is missing)
        from cyclic_env.rendering.gif import GifWriter

        changes = {name: value for name in ("detector", "measure") if (value := getattr(args, name)) is not None}
        explorer = KnnPolicy(preset(args.preset, **changes))
        render_mode = "human" if args.human else None
        env = CyclicLoopEnv(args.map, noise=args.noise, random_start=args.random_start, render_mode=render_mode)
        exports = [] if args.export is None else [args.export / name for name in EXPORTS]
        check_outputs(filter(None, (picture, animation, metrics_file, *exports)))
        run = Run(Recorder(env), GifWriter(env) if animation else None)
        run.drive(explorer, args.seed)
        if not run.steps:
            print("\nrun_knn.py: stopped before the first step, so there is nothing to keep.", file=sys.stderr)
            return 130
        settings = {"preset": args.preset, "detector": explorer.config.detector, "measure": explorer.config.measure}
        settings |= {"noise": args.noise, "seed": args.seed, "random_start": args.random_start}
        metrics = run.metrics() | settings | {"explorer": asdict(explorer.config), "cyclic_env": __version__}
        say(score_table(metrics))
        write_text_atomically(metrics_file, json.dumps(metrics, indent=1) + "\n")
        if args.export is not None:
            export(run, args.export)
        draw_run(run, metrics, picture)
        if run.film is not None and animation is not None:
            run.film.write(animation)
    except (CyclicLoopError, OSError) as error:
        print(f"run_knn.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nrun_knn.py: stopped; not all files were written.", file=sys.stderr)
        return 130
    kept = ", ".join(str(path) for path in (picture, animation, metrics_file, *exports) if path)
    if run.ending == "Ctrl-C":
        print(f"run_knn.py: stopped after {run.steps:,} steps; what was run is in {kept}.", file=sys.stderr)
        return 130
    say(f"\nwritten: {kept}")
    return 0


class Run:
    """One episode of an explorer, as far as it has come.

    Parameters
    ----------
    recorder : Recorder
        Around a `CyclicLoopEnv`.
    film : GifWriter, optional
        That is made of it.

    Attributes
    ----------
    info : dict
        The last one.
    memory : KnnExplorer or None
        The explorer, with all that it remembers; None before the first step.
    total : float
        Of the rewards.
    terms : dict
        Of the rewards, their sums by name.
    steps : int
        Taken so far.
    ending : str
        Why it ended.
    stopped_at : int or None
        The step at which the explorer had nothing left to explore; it stands from there on.
    env_s, agent_s : list of float
        Seconds of each step, in the environment and in the agent, up to there, but for those that had to wait for
        numba to compile or load a kernel.
    """

    def __init__(self, recorder: Recorder, film: GifWriter | None = None) -> None:
        self.recorder = recorder
        self.film = film
        self.info: dict[str, Any] = {}
        self.memory: KnnExplorer | None = None
        self.total = 0.0
        self.terms: dict[str, float] = {}
        self.steps = 0
        self.ending = ""
        self.stopped_at: int | None = None
        self.env_s: list[float] = []
        self.agent_s: list[float] = []

    @property
    def env(self) -> CyclicLoopEnv:
        """The environment."""
        env = self.recorder.unwrapped
        assert isinstance(env, CyclicLoopEnv)
        return env

    def drive(self, explorer: KnnPolicy, seed: int) -> None:
        """Run the episode to its end, or up to Ctrl-C."""
        progress = ProgressLine()
        compiled = event.RecordingListener()
        event.register("numba:compiler_lock", compiled)
        try:
            observation, self.info = self.recorder.reset(seed=seed)
            state = None
            while not self.ending:
                if self.film is not None and self.stopped_at is None:
                    self.film.take(self.steps)
                before, began = len(compiled.buffer), time.perf_counter()
                action, state = explorer.predict(observation, state)
                decided = time.perf_counter()
                observation, reward, terminated, truncated, self.info = self.recorder.step(action)
                ended = time.perf_counter()
                if self.stopped_at is None and len(compiled.buffer) == before:
                    self.env_s.append(ended - decided)
                    self.agent_s.append(decided - began)
                self.steps += 1
                self.total += float(reward)
                for name, value in self.info["reward_terms"].items():
                    self.terms[name] = self.terms.get(name, 0.0) + value
                (self.memory,) = state
                if terminated:
                    self.ending = "success"
                elif truncated:
                    self.ending = "step budget spent"
                elif state[0].done and self.stopped_at is None:
                    self.stopped_at = self.steps
                progress.show(
                    f"step {self.steps:,}: {self.info['coverage']:.0%} seen, {self.info['cycles_closed']} of "
                    f"{self.info['cycles_total']} cycles closed, {self.info['false_claims']} false claims"
                )
        except KeyboardInterrupt:
            self.ending = "Ctrl-C"
        finally:
            event.unregister("numba:compiler_lock", compiled)
        progress.clear()
        if self.film is not None and self.steps:
            self.film.take(self.steps, last=True)

    def recording(self) -> Recording:
        """Return the recording, with the explorer's corrected track: its places as they are after all corrections."""
        assert self.memory is not None
        keyframes, start = self.memory.keyframes, self.env.trajectory()[0, :2]
        corrected = np.column_stack([keyframes.step, keyframes.pose[:, :2] + start, keyframes.pose[:, 2]])
        return self.recorder.recording({"corrected": corrected})

    def metrics(self) -> dict[str, Any]:
        """Return the last info's scalars and what else there is to say of the run, as plain values."""
        assert self.memory is not None
        plan = self.env.floor_plan
        tour = plan.closed_tour()
        watched = self.env.render_mode == "human"  # then a step of the environment waits for the window
        return {
            "map": plan.name,
            **{name: value for name, value in self.info.items() if name != "reward_terms"},
            "steps": self.steps,
            "return": self.total,
            "reward_terms": self.terms,
            "ending": self.ending,
            "stopped_at": self.stopped_at,
            "path_over_tour": None if math.isnan(tour) else self.info["path_length_m"] / tour,
            "groups": len(self.memory.groups),
            "rows": self.memory.keyframes.count,
            "rows_compared": self.memory.detector.vote.compared,
            "open_areas": len(self.memory.frontiers.listed),
            **track_errors(self.recording()),
            "seconds_per_step_env": None if watched else mean(self.env_s),
            "seconds_per_step_agent": mean(self.agent_s),
            "seconds_per_step_agent_median": statistics.median(self.agent_s) if self.agent_s else None,
        }


def mean(values: Sequence[float]) -> float | None:
    """Return the mean; None of nothing."""
    return statistics.fmean(values) if values else None


def track_errors(recording: Recording) -> dict[str, float | None]:
    """Return the errors of dead reckoning, at every step, and of the corrected track, at its places; metres.

    ``ate`` is the absolute trajectory error in the true frame, ``aligned`` after a rigid alignment, ``end`` the error
    of the last position. None where there is no place yet.
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
    assert run.memory is not None
    recording, tracker = run.recording(), run.memory.tracker
    corrected = recording.tracks["corrected"]
    write_recording(recording, folder / "episode.npz")
    write_tum(folder / "true.tum", recording.times, recording.poses)
    write_tum(folder / "dead_reckoned.tum", recording.times, recording.dead_reckoned)
    write_tum(folder / "corrected.tum", recording.dt * corrected[:, 0], corrected[:, 1:])
    write_g2o(
        folder / "pose_graph.g2o",
        corrected[:, 1:],
        tracker.edges,
        tracker.heading_information,
        run.memory.keyframes.compass,
    )


def score_table(metrics: dict[str, Any]) -> str:
    """Return the scores, one a line."""
    scores = score_rows(metrics)
    if metrics["path_over_tour"] is not None:
        scores["path"] += f", {metrics['path_over_tour']:.2f} times the shortest tour of all corridors"
    tracks = [
        f"{title} {metrics[f'ate_{name}_m']:.2f} m ({metrics[f'ate_{name}_aligned_m']:.2f} m aligned)"
        for title, name in (("dead reckoning", "dead_reckoning"), ("corrected track", "corrected"))
        if metrics[f"ate_{name}_m"] is not None
    ]
    times = [
        f"{title} {1000 * seconds:.{digits}f} ms"
        for title, name, digits in (("env", "env", 2), ("agent", "agent", 2), ("the agent's median", "agent_median", 3))
        if (seconds := metrics[f"seconds_per_step_{name}"]) is not None
    ]
    since = metrics["stopped_at"]
    stopped = "" if since is None else f"; nothing left to explore from step {since:,} on"
    rows = {
        "run": f"{metrics['map']}, {metrics['noise']} sensors, seed {metrics['seed']}, {metrics['preset']}, "
        f"{metrics['detector']}, {metrics['measure']}",
        **scores,
        "off, rms": ", ".join(tracks),
        "return": f"{metrics['return']:.1f}",
        "collisions": f"{metrics['collisions']}",
        "steps": f"{metrics['steps']:,}, ended by: {metrics['ending']}{stopped}",
        "groups": f"{metrics['groups']} of {metrics['rows']:,} rows, {metrics['rows_compared']:,} comparisons of rows",
        "open areas": f"{metrics['open_areas']}",
        "a step takes": ", ".join(times) or "-",
    }
    return format_rows(rows)


def draw_run(run: Run, metrics: dict[str, Any], path: Path) -> None:
    """Write the figure of a run: true path, groups, open areas and claims, all where they truly were."""
    from agents.knn.plotting import draw_groups, draw_open_areas
    from cyclic_env.rendering.figures import add_legend, draw_claims, draw_path, plan_figure

    assert run.memory is not None
    plan, way, memory = run.env.floor_plan, run.env.trajectory(), run.memory
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
    rows = way[memory.keyframes.step, :2]
    draw_path(axes, way)
    draw_groups(axes, [(group.name, group.direction, rows[group.rows]) for group in memory.groups])
    areas = memory.frontiers.listed
    positions = np.array([rows[area.keyframe] + area.offset for area in areas]).reshape(-1, 2)
    draw_open_areas(axes, positions, [area.number for area in areas], [area.state for area in areas])
    draw_claims(axes, way, run.env.claims())
    add_legend(axes)
    with atomic_write(path) as part:
        figure.savefig(part, dpi=FIGURE_DPI)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.stdout.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue] (names of any bytes)
    sys.exit(main())
