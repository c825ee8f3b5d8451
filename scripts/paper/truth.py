"""TEMPORARY until task.loop_closure has it."""
import numpy as np
from cyclic_env.config import ClosureConfig
from cyclic_env.simulation.wall_index import build_wall_index
from cyclic_env.task.loop_closure import line_of_sight

def true_returns(plan, way, steps):
    closure = ClosureConfig()
    tiles = build_wall_index(plan, closure.return_radius)
    truth = np.zeros((len(steps), len(steps)), bool)
    for i, step in enumerate(steps.tolist()):
        off = np.hypot(*(way[: step + 1, :2] - way[step, :2]).T)
        away = np.flatnonzero(off >= closure.leave_radius)
        last_away = away[-1] if len(away) else -1
        for j in np.flatnonzero(off[steps[:i]] <= closure.return_radius).tolist():
            earlier = steps[j]
            if line_of_sight(tiles, 0, *way[step, :2], *way[earlier, :2]):
                truth[i, j] = way[step, 2] - way[earlier, 2] >= closure.gap and earlier < last_away
    return truth
