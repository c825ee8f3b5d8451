"""`CyclicLoopEnv`: the environment for one robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from cyclic_env.config import EnvConfig
from cyclic_env.engine.building import INFO
from cyclic_env.engine.engine import Engine
from cyclic_env.envs.arguments import (
    RENDER_FPS,
    RENDER_MODES,
    check_render_mode,
    check_seed,
    env_config,
    peek_rng,
    start_option,
)
from cyclic_env.envs.exclusive_access import ExclusiveAccess
from cyclic_env.envs.spaces import action_space, observation_space
from cyclic_env.errors import UsageError
from cyclic_env.floor_plans import FloorPlan, MapName
from cyclic_env.task.rewards import REWARD_TERMS


class CyclicLoopEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """A robot explores a building full of loops and has to recognise the places that it returns to.

    The robot has two wheels, a laser, a distance meter and a compass. The corridors close on themselves: a *cycle* is a
    block of the building that the robot can drive around, in a lap of at least 40 m with two points at least 10 m apart
    (see `cyclic_env.floor_plans.cycles`). In every step the robot may claim to be back where it was some steps ago. The
    claim is judged by the true positions. A correct claim closes a new cycle when the loop that it completes runs
    around the blocks of the building in a way that no combination of the loops before it does. An episode succeeds when
    the whole building has been seen and all of its cycles are closed.

    **Action space**, by `action_type`:

    | type | space | meaning |
    |---|---|---|
    | ``"wheels"`` (default) | ``Box(-1, 1, (4,), float32)`` | left and right wheel (x 1.2 m/s), claim, match |
    | ``"twist"`` | ``Box(-1, 1, (4,), float32)`` | v (x 1.2 m/s), omega (x 3 rad/s), claim, match |
    | ``"discrete"`` | ``MultiDiscrete([5, 2])`` | stop, forward, left, right, back; claim or not |

    A claim above 0 says "I am back at a known place", and match says when the robot was here before: at step
    ``k = rint((match + 1) / 2 * t)`` of the t steps so far, including this one; k = 0 is the start. A discrete claim
    names no step. The environment takes the nearest one that the robot returns to (without one, the claim is false), so
    it tests detection alone, and results can't be compared with those of the other types. Discrete left and right turn
    on the spot at 0.9 rad/s. Values out of range are clipped; a twist that is too fast for the wheels is scaled down as
    a whole.

    **Observation space**, a ``Dict`` of float32:

    | key | space | meaning |
    |---|---|---|
    | ``laser`` | ``Box(0, 12, (180,))`` | ranges in metres, beam 0 straight ahead, counter-clockwise, 2 degrees apart |
    | ``distance`` | ``Box(-1e5, 1e5, (1,))`` | metres driven along the heading; reverse subtracts |
    | ``compass`` | ``Box(-1, 1, (2,))`` | unit vector of the heading, east and north |

    Wheels that spin at a wall add no distance. Dead reckoning is
    ``position += (distance - previous_distance) * compass``.

    **Reward**: the sum of ``info["reward_terms"]``; a perfect episode is worth 100 less its time.

    | term | worth |
    |---|---|
    | ``coverage`` | 50 x share of the free cells newly seen (100 where the building has no cycle) |
    | ``new_cycle`` | 50 / cycles of the building, for each one closed |
    | ``false_claim`` | -5 for each |
    | ``missed_revisit`` | -1 for each stretch of known ground passed without a correct claim; each counts once |
    | ``collision`` | -40 / step budget, for each step in which a wall pushed back |
    | ``time`` | -10 / step budget, for each step; a collision that ends the episode is charged the rest of them |

    The cells that the scan at the start sees are paid for in the first step.

    **Info** has the same keys after every reset and step. Its values are Python scalars: ``is_success``, ``coverage``
    (share of the free cells that have been seen), ``cycles_closed``, ``cycles_total``, ``revisit`` (whether this step
    truly is one), ``claim_judged``, ``claim_correct``, ``claim_error_m`` (distance between the two positions of a
    judged claim; 0.0 without one), ``claims`` (judged so far), ``false_claims``, ``revisits`` (settled so far),
    ``revisits_recognised``, ``precision``, ``recall`` (each 1.0 while it has nothing to count), ``new_cycle``,
    ``collisions`` (contacts begun), ``path_length_m``, and the true ``x``, ``y`` and ``heading``; and ``reward_terms``,
    a dict of floats. `cyclic_env.task.loop_closure` defines revisits, claims and cycles.

    **Start**: at rest, at the start of the plan or of ``reset(options={"start": (x, y, heading)})``, or at a random one
    with ``random_start=True``.

    **Episode end**: terminated when 99 % of the cells have been seen and all cycles are closed (``is_success``), or at
    the first contact with ``terminate_on_collision=True``; truncated after `step_budget` steps.

    Parameters
    ----------
    map_name : str, path, FloorPlan, or a list of these, optional
        A shipped plan (``cyclic_env.map_names()``), a YAML file (a floor plan or a ROS map), a generated building
        (``"generated:cycles=4,seed=7"``), or a plan itself. A list is a pool, as is ``"generated:train"``: every reset
        draws one of its plans. The environment's ``spec`` can be written as JSON if maps are given as text.
    config : EnvConfig or mapping, optional
        All settings at once; by default the default settings.
    render_mode : {"human", "rgb_array"}, optional
    **settings
        Single fields of `cyclic_env.EnvConfig`, which lists them all, in place of the config's: ``noise="typical"``,
        ``step_budget=2000``, ``laser={"num_beams": 90}``.

    Attributes
    ----------
    config : EnvConfig
    floor_plans : sequence of FloorPlan
        The pool from which every reset draws a plan.

    Raises
    ------
    ConfigError, FloorPlanError, ActionError, UsageError
        All are `CyclicLoopError`: one line that says what is wrong and what to do.

    Version history
    ---------------
    v0: the first. Version 2 of its rules (`cyclic_env.task.loop_closure.RULES_VERSION`) counts known ground once for
    revisit events, and so for ``missed_revisit``, precision and recall. A correct claim just before an event recognises
    it, and a cycle needs a lap, rather than a ring, of at least 40 m.

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
        map_name: MapName | Sequence[MapName] | None = None,
        *,
        config: EnvConfig | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        self.config, self.floor_plans = env_config(map_name, config, settings)
        self.engine = Engine(self.config, self.floor_plans, num_robots=1)
        self.action_space = action_space(self.config.action_type)
        self.observation_space = observation_space(self.config.laser)
        self.render_mode = check_render_mode(render_mode)
        self._running = False
        self._access = ExclusiveAccess()
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
            If the seed, the start, or the plan that the reset draws doesn't fit; the running episode goes on.
        """
        with self._access:
            start, seed = start_option(options), check_seed(seed)
            if start is not None or not self.engine.is_prepared:  # refuse before anything changes
                self.engine.draw_start(peek_rng(self.np_random, seed), start)
            super().reset(seed=seed)
            self.engine.reset_row(0, self.np_random, start)
            self.engine.measure(np.zeros(1, np.int64), [self.np_random])
            self._running = True
            if self.render_mode == "human":
                self.render()
            return self._observation(), self._info()

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Drive for one control step (0.2 s), and judge the claim if the action makes one."""
        with self._access:
            if not self._running:
                raise UsageError("there is no running episode: call reset() first, and again after each episode.")
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
        return self.engine.step_budget(0)

    def trajectory(self) -> np.ndarray:
        """Return the true path since the reset, `(t + 1, 3)`: x, y and path length, metres."""
        return self.engine.trajectory(0)

    def claims(self) -> np.ndarray:
        """Return the judged claims since the reset, in order: `(n,)` records of `cyclic_env.task.path_history.CLAIM`.

        They were made at ``trajectory()[claims["step"]]``, and named ``trajectory()[claims["match"]]`` unless the match
        is -1.
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
        return self._renderer.draw(self)

    def close(self) -> None:
        """Close the window, if there is one, and end the threads."""
        with self._access:
            if self._renderer is not None:
                self._renderer.close()
                self._renderer = None
            self.engine.close()

    def __getstate__(self) -> dict[str, Any]:
        with self._access:
            return {**self.__dict__, "_renderer": None}
