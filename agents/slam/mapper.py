"""A map from any laser, wheels, and a heading that may drift: the track, loop closures and claims."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.slam.consistency import find_consistent, grow_set
from agents.slam.keyframes import connect, shortest_paths
from agents.slam.local_graph import optimize_window
from agents.slam.panorama import (
    SIGNATURE_SECTORS,
    endpoints,
    keep_steady,
    merge_scans,
    signature,
    signature_distances,
)
from agents.slam.registration import Registration, best_starts, register
from agents.slam.robust_graph import optimize_robustly, squared_errors
from agents.slam.scan_filters import despeckle
from agents.slam.scan_matching import fit_wall_lines
from agents.slam.se2 import compose, relative, wrap, wrap_all

GROWN = (
    "pose",
    "scan",
    "panorama",
    "lines",
    "signature",
    "path",
    "step",
    "heading",
    "sources",
    "measured",
    "information",
    "joints",
    "degrees",
    "queue",
    "waiting",
    "held",
    "heading_information",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperConfig:
    """Tuned on simulated logs."""

    range_max: float = 30.0
    keyframe_spacing: float = 0.4
    keyframe_turn: float = math.radians(12)
    panorama_length: float = 12.0
    panorama_keyframes: int = 36
    whole: bool = False
    """Whether the laser sees 360 degrees: then a panorama is the scan."""
    compass_error: float = 0.0
    """Standard deviation of an absolute compass, radians; 0: the heading drifts, and tells its changes only."""
    step_shift: float = 0.05
    step_turn: float = math.radians(4)
    local_rows: tuple[int, ...] = (1, 2, 4, 8)
    local_wide: float = 0.75
    local_seen: int = 40
    window: int = 16
    gap: float = 20.1
    leave: float = 10.1
    around: float = 6.0
    drift: float = 0.06
    gate_min: float = 2.0
    gate_max: float = 40.0
    candidates: int = 8
    close_wide: float = 0.85
    close_tight: float = 0.75
    close_seen: int = 60
    close_offset: float = 2.5
    set_length: float = 15.0
    expected_drift: float = 0.006
    expected_shift: float = 0.5
    surprise_min: float = 0.5
    surprise_max: float = 3.0
    familiar: float = 40.0
    set_size: int = 6
    set_span: float = 2.5
    set_firm: int = 3
    firm: float = 6.0
    rival_margin: int = 2
    rival_share: float = 0.6
    hold_wide: float = 0.70
    hold_tight: float = 0.55
    claim_distance: float = 2.5
    graph_threshold: float = 60.0
    relax: float = 0.3


LIMITS = np.array([0.5, math.radians(4), 0.03, math.radians(0.3)])
NOISE_FLOOR = np.diag([0.01**2, 0.01**2, math.radians(0.1) ** 2])
TURNS = np.radians([0, 6, -6, 12, -12, 18, -18, 25, -25, 32, -32])
SEARCH = np.array([(x, 0.0, math.radians(h)) for x in (0, -1, 1, -2, 2) for h in (0, 7, -7, 14, -14)])
MATCH_SPREAD = np.array([1.0, 1.0, math.radians(10)])
HOLD_SPREAD = np.array([0.3, 0.3, math.radians(5)])
LOCAL_SPREAD = np.array([0.1, 0.1, math.radians(4)])


def inflate(information: np.ndarray) -> np.ndarray:
    """Return the information of a match, with what its noise alone does not tell."""
    return np.linalg.inv(np.linalg.inv(information + 1e-3 * np.eye(3)) + NOISE_FLOOR)


class Mapper:
    """Keeps keyframes, closes loops and claims."""

    def __init__(self, config: MapperConfig, beams: int) -> None:
        self.config, self.beams = config, beams
        self.count = 0
        slots = len(config.local_rows) + 2
        shapes = {
            "pose": (3,),
            "scan": (beams,),
            "panorama": (beams,),
            "lines": (beams, 3),
            "signature": (SIGNATURE_SECTORS,),
            "path": (),
            "heading": (),
            "heading_information": (),
            "measured": (slots, 3),
            "information": (slots, 3, 3),
        }
        whole = {"step": (), "group": (), "sources": (slots,), "joints": (16,), "degrees": (), "queue": ()}
        self._columns = {name: np.zeros((256, *shape)) for name, shape in shapes.items()}
        self._columns |= {name: np.zeros((256, *shape), np.int64) for name, shape in whole.items()}
        self._columns |= {name: np.zeros(256, np.bool_) for name in ("waiting", "held")}
        size = 3 * (config.window + 1)
        self._scratch = (np.zeros((size, size)), np.zeros(size))
        self._scan_lines = np.zeros((16, beams, 3))
        self._nearest = np.zeros((3, beams))
        self.local = np.zeros(3)  # of the robot in the frame of the last keyframe, by the wheels
        self.loops: list[tuple[int, int, np.ndarray, np.ndarray, int]] = []
        self.groups = 0
        self.closures: list[dict] = []
        self.pending: list[dict] = []
        self.fails = 0
        self.drift = config.expected_drift
        self.tension = np.zeros(2)
        self.claim: int | None = None
        self.steps = -1
        self.solves = 0
        self.log: list = []
        self.searches: list = []
        self.holds: dict = {}
        self._distance = self._heading = None
        self.driven = 0.0
        self.icps = 0

    def __getattr__(self, name: str):
        columns = self.__dict__.get("_columns", {})
        if name in columns:
            return columns[name][: self.__dict__["count"]]
        raise AttributeError(name)

    @property
    def now(self) -> np.ndarray:
        return compose(self.pose[-1], self.local) if self.count else self.local

    # --- one scan ---
    def observe(self, scan: np.ndarray, distance: float, heading: float) -> int | None:
        """Take a scan as a panorama `(n,)`, the distance meter and the heading; return the step it is back at."""
        c = self.config
        self.steps += 1
        if self._heading is None:
            self._distance, self._heading, self.start = distance, heading, heading
        d, turn = distance - self._distance, wrap(heading - self._heading)
        self._distance, self._heading = distance, heading
        self.driven += abs(d)
        self.local = compose(self.local, np.array([d * math.cos(0.5 * turn), d * math.sin(0.5 * turn), turn]))
        if self.count and math.hypot(*self.local[:2]) < c.keyframe_spacing and abs(self.local[2]) < c.keyframe_turn:
            if self.held[-1]:
                return self._claim(self.now)
            return None
        self._add(scan)
        self._close()
        if self.held[-1]:
            return self._claim(self.pose[-1])
        return None

    def _add(self, raw: np.ndarray) -> None:
        c = self.config
        scan, smooth = np.where(raw > 0, raw, c.range_max), np.empty(self.beams)
        np.minimum(scan, c.range_max, out=scan)
        despeckle(scan, smooth)
        keep_steady(raw, smooth, c.range_max, 0.3, scan)
        if self.count == len(self._columns["pose"]):
            self._columns = {k: np.concatenate([v, np.zeros_like(v)]) for k, v in self._columns.items()}
        self.count += 1
        i = self.count - 1
        prior = self.local.copy()
        self.local = np.zeros(3)
        self.scan[i] = scan
        self.step[i] = self.steps
        self.path[i] = self.driven
        self.heading[i] = self._heading
        self.heading_information[i] = c.compass_error**-2 if c.compass_error else 0.0
        self.sources[i] = -1
        if i == 0:
            ends = np.empty(self.beams)
            endpoints(scan, c.range_max, ends)
            fit_wall_lines(ends, c.range_max, self._scan_lines[0])
            self.pose[0] = (0.0, 0.0, self._heading if c.compass_error else 0.0)
        else:
            self._track(i, prior)
            connect(self.joints, self.degrees, i - 1, i)
        self._look(i)

    def _track(self, i: int, prior: np.ndarray) -> None:
        c = self.config
        ends = np.empty(self.beams)
        endpoints(self.scan[i], c.range_max, ends)
        fit_wall_lines(ends, c.range_max, self._scan_lines[i % 16])
        spread = np.array([c.step_shift, c.step_shift, c.step_turn])
        self.pose[i] = compose(self.pose[i - 1], prior)
        self.sources[i, 0], self.measured[i, 0], self.information[i, 0] = i - 1, prior, np.diag(spread**-2)
        for slot, back in enumerate(c.local_rows, start=1):
            j = i - back
            if j < 0 or self.path[i] - self.path[j] > 8:
                continue
            expected = relative(self.pose[j], self.pose[i])
            starts = expected[None]
            if not self.sources[i, 1:].max() >= 0:  # nothing has held the heading yet
                starts = expected + np.column_stack([np.zeros((len(TURNS), 2)), TURNS])
            found = self._match_scan(j, i, ends, starts, spread if slot == 1 else LOCAL_SPREAD)
            shift = math.hypot(*(found.pose[:2] - expected[:2]))
            if found.wide > c.local_wide and found.seen > c.local_seen and shift < 0.5:
                self.sources[i, slot], self.measured[i, slot] = j, found.pose
                self.information[i, slot] = inflate(found.information)
                if self.sources[i, 1:].max() == j:
                    self.pose[i] = compose(self.pose[j], found.pose)
        self._fit_window()

    def _fit_window(self) -> None:
        first = max(1, self.count - self.config.window)
        optimize_window(
            self.pose,
            first,
            (self.sources, self.measured, self.information),
            self.heading,
            self.heading_information,
            *self._scratch,
        )

    def _match_scan(self, j, i, ends, starts, spread) -> Registration:
        c = self.config
        return self._register(self.scan[j], self._scan_lines[j % 16], self.scan[i], ends, starts, spread)

    def _register(self, pano_j, lines, pano_i, ends_i, starts, spread) -> Registration:
        self.icps += 1
        from agents.slam.registration import SPREAD, register_from

        scratch = (np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(4, np.int64))
        pose, hessian, quality = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
        register_from(
            pano_j, lines, pano_i, ends_i, self.config.range_max, starts, spread, scratch, pose, hessian, quality
        )
        return Registration(pose, hessian / SPREAD**2, float(quality[0]), float(quality[1]), int(quality[2]))

    def _look(self, i: int) -> None:
        c = self.config
        if c.whole:
            self.panorama[i] = self.scan[i]
        else:
            first = max(int(np.searchsorted(self.path, self.path[i] - c.panorama_length)), i - c.panorama_keyframes, 0)
            merge_scans(self.scan, self.pose, first, i, self.pose[i], c.range_max, self._nearest, self.panorama[i])
        ends = np.empty(self.beams)
        endpoints(self.panorama[i], c.range_max, ends)
        fit_wall_lines(ends, c.range_max, self.lines[i])
        signature(self.panorama[i], self.signature[i])

    def match(self, j: int, i: int, starts: np.ndarray, spread: np.ndarray) -> Registration:
        ends_i = np.empty(self.beams)
        endpoints(self.panorama[i], self.config.range_max, ends_i)
        return self._register(self.panorama[j], self.lines[j], self.panorama[i], ends_i, starts, spread)

    def ways(self, source: int) -> np.ndarray:
        lengths, before = np.empty(self.count), np.empty(self.count, np.int64)
        shortest_paths(self.joints, self.degrees, self.pose, source, lengths, before, self.queue, self.waiting)
        return lengths

    # --- known places ---
    def _close(self) -> None:
        c = self.config
        i = self.count - 1
        pose, path = self.pose, self.path
        away = np.hypot(pose[:, 0] - pose[i, 0], pose[:, 1] - pose[i, 1])
        since = np.maximum.accumulate(away[::-1])[::-1]
        back = np.flatnonzero((path[i] - path >= c.gap) & (since >= c.leave))
        self.held[i] = False
        if not len(back):
            return
        lengths = self.ways(i)
        around = lengths[back] <= away[back] + c.around
        near = back[(around | (lengths[back] < c.familiar)) & (away[back] < 3.0)]
        near = near[self.sees(self.panorama[i], pose[i], pose[near])]
        if len(near):
            j = int(near[np.argmin(away[near])])
            self._hold(i, j, strict=lengths[j] > away[j] + c.around)
        gate = np.clip(c.drift * lengths[back], c.gate_min, c.gate_max)
        candidates = back[~around & (away[back] < gate)]
        if self.fails >= 4:
            candidates = back[away[back] < np.maximum(gate, 6.0)]
        found = self._search(i, candidates) if len(candidates) else []
        self.pending = [p for p in self.pending if path[i] - path[p["i"]] < c.set_length] + found
        if found:
            self._agree(i, found, lengths)
        elif math.hypot(*self.tension) > c.relax:
            self.solve()

    def _hold(self, i: int, j: int, strict: bool) -> None:
        c = self.config
        expected = relative(self.pose[j], self.pose[i])
        found = self.match(j, i, expected[None], HOLD_SPREAD)
        shift = math.hypot(*(found.pose[:2] - expected[:2]))
        self.holds[i] = (j, strict, round(found.wide, 2), round(found.tight, 2), found.seen, round(shift, 2))
        wide, tight = (c.close_wide, c.close_tight) if strict else (c.hold_wide, c.hold_tight)
        if found.wide > wide and found.tight > tight and found.seen > c.close_seen and shift < 1.0:
            self.sources[i, -1], self.measured[i, -1], self.information[i, -1] = (
                j,
                found.pose,
                inflate(found.information),
            )
            self.group[i] = self.groups - 1
            connect(self.joints, self.degrees, j, i)
            before = self.pose[i].copy()
            self._fit_window()
            self.tension += self.pose[i, :2] - before[:2]
            self.held[i] = True
            self.fails = 0
        else:
            self.fails += 1

    def _search(self, i: int, candidates: np.ndarray) -> list[dict]:
        c = self.config
        unlike = np.empty(len(candidates))
        signature_distances(self.signature, self.pose[:, 2], candidates, self.signature[i], self.pose[i, 2], 2, unlike)
        picked: list[int] = []
        for q in np.argsort(unlike, kind="stable"):
            if not np.isfinite(unlike[q]) or len(picked) == c.candidates:
                break
            if all(abs(self.path[candidates[q]] - self.path[p]) > 1.0 for p in picked):
                picked.append(int(candidates[q]))
        found = []
        self.tested = len(picked)
        best = Registration(np.zeros(3), np.eye(3), 0.0, 0.0, 0)
        for j in picked:
            expected = relative(self.pose[j], self.pose[i])
            expected[:2] /= max(1.0, math.hypot(*expected[:2]))
            grid = expected + SEARCH
            starts = np.empty((3, 3))
            best_starts(
                self.panorama[j],
                self.panorama[i],
                c.range_max,
                grid,
                np.empty(4, np.int64),
                np.empty(len(grid)),
                starts,
            )
            trial = self.match(j, i, starts, MATCH_SPREAD)
            if trial.wide + trial.tight > best.wide + best.tight:
                best = trial
            if (
                trial.wide > c.close_wide
                and trial.tight > c.close_tight
                and trial.seen > c.close_seen
                and math.hypot(*trial.pose[:2]) < c.close_offset
            ):
                found.append(
                    {
                        "i": i,
                        "j": j,
                        "match": trial,
                        "firm": trial.min_eigenvalue > c.firm,
                        "key": trial.wide + 0.5 * trial.tight,
                    }
                )
        self.searches.append(
            (i, len(candidates), len(found), best.wide, best.tight, best.seen, math.hypot(*best.pose[:2]))
        )
        return found

    def _agree(self, i: int, found: list[dict], lengths: np.ndarray) -> None:
        c = self.config
        pending = self.pending
        now = np.array(
            [
                compose(compose(self.pose[p["j"]], p["match"].pose), relative(self.pose[p["i"]], self.pose[i]))
                for p in pending
            ]
        )
        rows, paths = np.array([p["i"] for p in pending]), self.path[[p["i"] for p in pending]]
        agrees = np.zeros((len(pending), len(pending)), np.bool_)
        find_consistent(now, rows, paths, LIMITS, agrees)
        members, scratch = np.zeros(len(pending), np.int64), np.zeros(len(pending), np.bool_)
        sets = []
        for start in range(len(pending)):
            size = grow_set(agrees, start, members, scratch)
            sets.append((size, start, members[:size].copy()))
        # What a set is worth: the more it would move the track beyond what is expected to have drifted, the less.
        shifts = np.hypot(now[:, 0] - self.pose[i, 0], now[:, 1] - self.pose[i, 1])
        ways = lengths[[p["j"] for p in pending]]
        surprise = np.clip(shifts / (c.expected_shift + self.drift * ways), c.surprise_min, c.surprise_max)
        worth = np.array([s[0] for s in sets]) / surprise
        start = max(
            (k for k in range(len(pending)) if pending[k]["i"] == i), key=lambda k: (worth[k], pending[k]["key"])
        )
        size, _, chosen = sets[start]
        elsewhere = (np.hypot(now[:, 0] - now[start, 0], now[:, 1] - now[start, 1]) > 1.5) | (
            np.abs(wrap_all(now[:, 2] - now[start, 2])) > 0.35
        )
        rival = worth[elsewhere].max(initial=0.0)
        firm = sum(pending[k]["firm"] for k in chosen)
        span = self.path[i] - paths[chosen].min()
        self.log.append((i, pending[start]["j"], size, rival, firm, span, shifts[start], surprise[start]))
        if (
            worth[start] < c.set_size
            or firm < surprise[start] * c.set_firm
            or span < surprise[start] * c.set_span
            or worth[start] < rival + c.rival_margin
            or rival > c.rival_share * worth[start]
        ):
            return
        shift, way = float(shifts[start]), float(ways[start])
        self.drift = max(self.drift, shift / way)
        for k in chosen:
            p = pending[k]
            self._add_loop(p["j"], p["i"], p["match"], self.groups)
            connect(self.joints, self.degrees, p["j"], p["i"])
        self.groups += 1
        self.closures.append(
            {
                "i": i,
                "j": pending[start]["j"],
                "shift": shift,
                "size": size,
                "rival": rival,
                "firm": firm,
                "way": way,
            }
        )
        self.solve()
        self.pending = []
        self.held[i] = True

    def _add_loop(self, j: int, i: int, found: Registration, group: int) -> None:
        self.loops.append((j, i, found.pose, inflate(found.information), group))

    def solve(self) -> None:
        """Fit all poses to all edges."""
        c = self.config
        self.solves += 1
        rows, slots = np.nonzero(self.sources >= 0)
        ends = np.column_stack([self.sources[rows, slots], rows])
        measured, information = self.measured[rows, slots], self.information[rows, slots]
        doubtful = np.where(slots == self.sources.shape[1] - 1, self.group[rows], -1)
        if self.loops:
            ends = np.concatenate([ends, [(j, i) for j, i, *_ in self.loops]])
            measured = np.concatenate([measured, [m for _, _, m, _, _ in self.loops]])
            information = np.concatenate([information, [m for _, _, _, m, _ in self.loops]])
            doubtful = np.concatenate([doubtful, [g for *_, g in self.loops]])
        poses, self.weights = optimize_robustly(
            self.pose.copy(),
            ends,
            measured,
            information,
            doubtful,
            self.heading,
            self.heading_information,
            c.graph_threshold,
        )
        self.pose[:] = poses
        self.tension = np.zeros(2)

    def sees(self, panorama: np.ndarray, pose: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return which of the poses `(m, 3)` are in sight."""
        offset = relative(pose, others)
        apart = np.hypot(offset[:, 0], offset[:, 1])
        beams = np.rint(np.arctan2(offset[:, 1], offset[:, 0]) * self.beams / math.tau).astype(int)
        reach = max(1, round(4 * self.beams / 360))
        around = panorama[(beams[:, None] + np.arange(-reach, reach + 1)) % self.beams]
        nearest = np.where(around > 0, around, np.inf).min(axis=1)
        return (apart < 0.3) | (np.isfinite(nearest) & (nearest > apart + 0.1))

    def _claim(self, pose: np.ndarray) -> int | None:
        """Return the step of the nearest place in sight."""
        c = self.config
        last = self.count - 1
        away = np.hypot(self.pose[:, 0] - pose[0], self.pose[:, 1] - pose[1])
        since = np.maximum.accumulate(away[::-1])[::-1]
        back = np.flatnonzero((self.driven - self.path >= c.gap) & (since >= c.leave) & (away < c.claim_distance))
        if not len(back):
            return None
        back = back[self.sees(self.panorama[last], self.pose[last], self.pose[back])]
        return int(self.step[back[np.argmin(away[back])]]) if len(back) else None
