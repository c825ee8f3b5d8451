"""`CyclicLoopEnv`: the environment for one robot, as Gymnasium knows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import gymnasium
import numpy as np

from cyclic_env.engine.engine import INFO, Engine, Settings, engine_config
from cyclic_env.envs.spaces import (
    RENDER_FPS,
    RENDER_MODES,
    ExclusiveAccess,
    action_space,
    checked_render_mode,
    checked_seed,
    observation_space,
    peek_rng,
    restored,
    snapshot,
    start_option,
)
from cyclic_env.errors import UsageError
from cyclic_env.floor_plans import FloorPlan, MapName
from cyclic_env.task.rewards import REWARD_TERMS


class CyclicLoopEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A robot explores a building full of loops, and must say when it is back at a place that it knows, and which.

    The robot has two wheels, a laser, a distance meter and a compass. Corridors close on themselves: a *cycle*
    is a block of the building that the robot can drive around. At every step the robot may claim to be back where
    it was some steps ago. The claim is judged against the truth, and closes a cycle when the loop that it
    completes goes around the building in a way that none before did. An episode succeeds when the building is
    seen and all of its cycles are closed.

    **Action space**, by `action_type`:

    | type | space | meaning |
    |---|---|---|
    | ``"wheels"`` (default) | ``Box(-1, 1, (4,), float32)`` | left and right wheel (x 1.2 m/s), claim, match |
    | ``"twist"`` | ``Box(-1, 1, (4,), float32)`` | v (x 1.2 m/s), omega (x 3 rad/s), claim, match |
    | ``"discrete"`` | ``MultiDiscrete([5, 2])`` | stop, forward, left, right, back; claim or not |

    A claim above 0 says "I am back at a known place", and match says when the robot was here: at step
    ``k = rint((match + 1) / 2 * t)`` of the t steps so far, this one counted; k = 0 is the start. With discrete
    actions the environment itself takes the nearest step that t returns to (a false claim where there is none), and
    so tests the detection alone: do not compare it with the other types. There left and right turn
    on the spot at 0.9 rad/s. Values out of range are clipped; a twist beyond the wheels' limit shrinks as a whole.

    **Observation space**, a ``Dict`` of float32:

    | key | space | meaning |
    |---|---|---|
    | ``laser`` | ``Box(0, 12, (180,))`` | ranges in metres, beam 0 straight ahead, counter-clockwise, 2 degrees apart |
    | ``distance`` | ``Box(-1e5, 1e5, (1,))`` | metres driven along the heading; reverse subtracts |
    | ``compass`` | ``Box(-1, 1, (2,))`` | unit vector of the heading, east and north |

    Wheels that spin at a wall add no distance.
    Dead reckoning is ``position += (distance - previous_distance) * compass``.

    **Reward**: the sum of ``info["reward_terms"]``; a perfect episode is worth 100 less its time.

    | term | worth |
    |---|---|
    | ``coverage`` | 50 x share of the free cells newly seen (100 where the building has no cycle) |
    | ``new_cycle`` | 50 / cycles of the building, for each one closed |
    | ``false_claim`` | -5 for each |
    | ``missed_revisit`` | -1 for each stretch of known ground, once, that the robot passed without a correct claim |
    | ``collision`` | -40 / step budget, for each step in which a wall pushed back |
    | ``time`` | -10 / step budget, for each step |

    What the scan at the start sees is paid in the first step.

    **Info** holds the same keys at every reset and step, Python scalars all but the last: ``is_success``,
    ``coverage`` (share of the free cells seen), ``cycles_closed``, ``cycles_total``, ``revisit`` (the truth at this
    step), ``claim_judged``, ``claim_correct``, ``claim_error_m`` (distance between the two places of a judged claim;
    0.0 without one), ``claims`` (judged so far), ``false_claims``, ``revisits`` (settled so far),
    ``revisits_recognised``, ``precision``, ``recall`` (1.0 where nothing could be wrong), ``new_cycle``,
    ``collisions`` (contacts begun), ``path_length_m``, ``x``, ``y``, ``heading`` (the truth), ``reward_terms`` (dict
    of floats).
    What a revisit, a claim and a cycle are is defined in `cyclic_env.task.loop_closure`.

    **Start**: the plan's own, at rest; or ``reset(options={"start": (x, y, heading)})``; or random with `random_start`.

    **Episode end**: terminated when 99 % of the cells are seen and all cycles are closed (``is_success``), or at the
    first contact with ``terminate_on_collision=True``; truncated after `step_budget` steps.

    Parameters
    ----------
    map_name : str, path, FloorPlan, or a list of these
        A shipped plan (``cyclic_env.map_names()``), a YAML file, ours or that of a map of ROS, a generated building
        (``"generated:cycles=4,seed=7"``), or a plan itself. A list is a pool, and so is ``"generated:train"``: every
        reset draws one. Give names, and paths as text, where the environment's ``spec`` is to be written as JSON.
    noise : str, NoiseConfig or mapping
        Preset of the sensors' errors: ``"ideal"``, ``"calibrated"``, ``"typical"``, ``"poor"``; or your own.
    action_type : {"wheels", "twist", "discrete"}
    random_start : bool
        Draw the start anywhere that the robot can reach.
    terminate_on_collision : bool
    step_budget : int, optional
        By default three times the steps that it takes to drive through corridors 2 m wide with the plan's area.
    robot, laser, closure, coverage, reward : settings or mapping, optional
        See `cyclic_env.config`.
    render_mode : {"human", "rgb_array"}, optional

    Raises
    ------
    ConfigError, FloorPlanError, ActionError, UsageError
        All of them `CyclicLoopError`: one line that says what is wrong and what to do.

    Version history
    ---------------
    v0: the first. Since rules 2 (`cyclic_env.task.loop_closure.RULES_VERSION`) ground counts once for revisit events,
    and with them for ``missed_revisit``, precision and recall; a correct claim just before an event recognises it.

    References
    ----------
    A. R. Abdulnabi and M. F. Esmail, Automatic mapping and localization in large-scale cyclic using K-nearest
    neighbours, 2022.
    M. Bosse, P. Newman, J. Leonard and S. Teller, Simultaneous localization and map building in large-scale
    cyclic environments using the Atlas framework, IJRR 23(12), 2004.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012 (Gymnasium's own)

    def __init__(
        self,
        map_name: MapName | Sequence[MapName] = "killian_court",
        *,
        render_mode: str | None = None,
        **settings: Unpack[Settings],
    ) -> None:
        self.engine = Engine(engine_config(map_name=map_name, **settings), num_robots=1)
        self.action_space = action_space(self.engine.config.action_type)
        self.observation_space = observation_space(self.engine.config.laser)
        self.render_mode = checked_render_mode(render_mode)
        self._running = False
        self._turn = ExclusiveAccess()
        self._renderer: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed : int, optional
            Seeds all randomness from here on.
        options : dict, optional
            ``{"start": (x, y, heading)}`` in metres and radians.

        Raises
        ------
        ConfigError, FloorPlanError
            If the seed or the start doesn't fit, or a plan that is new to the pool; the running episode goes on.
        """
        with self._turn:
            start, seed = start_option(options), checked_seed(seed)
            if start is not None or not self.engine.is_prepared:  # refuse before anything changes
                self.engine.draw_place(peek_rng(self.np_random, seed), start)
            super().reset(seed=seed)
            self.engine.reset_row(0, self.np_random, start)
            self.engine.measure(np.zeros(1, np.int64), [self.np_random])
            self._running = True
            if self.render_mode == "human":
                self.render()
            return self._observation(), self._info()

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Drive for 0.2 s, and make a claim or none."""
        with self._turn:
            if not self._running:
                raise UsageError(
                    "step() needs a running episode: call reset() first, and again after an episode has ended."
                )
            self.engine.step([action], [self.np_random])
            reward, terminated, truncated, *_ = self.engine.outcome[0].item()
            self._running = not (terminated or truncated)
            if self.render_mode == "human":
                self.render()
            return self._observation(), reward, terminated, truncated, self._info()

    def _observation(self) -> dict[str, np.ndarray]:
        return {name: value[0] for name, value in self.engine.observation().items()}

    def _info(self) -> dict[str, Any]:
        info = dict(zip(INFO.names or (), self.engine.info[0].item(), strict=True))
        info["reward_terms"] = dict(zip(REWARD_TERMS, self.engine.terms[0].tolist(), strict=True))
        return info

    @property
    def floor_plan(self) -> FloorPlan:
        """The building of the running episode."""
        return self.engine.plan(0)

    @property
    def step_budget(self) -> int:
        """After how many steps the running episode is truncated."""
        return self.engine.config.step_budget_of(self.floor_plan)

    def trajectory(self) -> np.ndarray:
        """Return the true way since the reset, `(t + 1, 3)`: x, y and path length, metres."""
        return self.engine.trajectory(0)

    def claims(self) -> np.ndarray:
        """Return the judged claims since the reset, in order: `(n,)` records of `cyclic_env.task.path_history.CLAIM`.

        Their places are ``trajectory()[claims["step"]]`` and, but for a match of -1, ``trajectory()[claims["match"]]``.
        """
        return self.engine.claims(0)

    def seen_cells(self) -> np.ndarray:
        """Return what has been seen as a picture `(rows, columns)` int8, south first: -1 not free, 0 unseen, 1 seen."""
        return self.engine.seen_cells(0)

    def render(self) -> Any:
        """Draw the building, what has been seen, the robot, its beams, its path, and its claims.

        Returns
        -------
        (height, width, 3) uint8 array with ``render_mode="rgb_array"``; None with ``"human"``, which shows a window.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                'render() does nothing without a render_mode; make the env with render_mode="rgb_array".'
            )
            return None
        self.engine.check_placed(0)
        if self._renderer is None:
            from cyclic_env.rendering.renderer import Renderer

            self._renderer = Renderer(self.render_mode, self.metadata["render_fps"])
        return self._renderer.draw(self.engine, 0)

    def close(self) -> None:
        """Close the window, if there is one, and end the threads."""
        with self._turn:
            if self._renderer is not None:
                self._renderer.close()
                self._renderer = None
            self.engine.close()

    def __getstate__(self) -> dict[str, Any]:
        with self._turn:
            return snapshot({**self.__dict__, "_renderer": None}, ("engine", "_np_random"))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(restored(state))
