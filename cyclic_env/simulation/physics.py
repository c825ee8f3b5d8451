"""The physics: N robots that drive in walled buildings.

Robots of one floor plan share a pymunk Space; they pass through each other and collide with walls only. A Space holds
at most `WORLD_SIZE_MAX` of them, since every pair of robots at the same spot costs pymunk time. Compiled code calls
pymunk's C library directly, and reads and writes all bodies of a Space at once, as `pymunk.batch` does. Either may
change in any release of pymunk, which is therefore pinned tightly and used in this module only.

Wheels act as a force and a torque before each substep, so that the contact solver has the last word.
A body moved within its Space would keep the contacts of its last episode and make resets nondeterministic, so a robot
that is placed gets a new body and a new shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pymunk
from pymunk._chipmunk_cffi import ffi, lib
from pymunk.batch import BodyFields, Buffer, get_space_bodies

from cyclic_env.config import RobotConfig
from cyclic_env.floor_plans import FloorPlan
from cyclic_env.jit import call_c, compiled, num_cores

WORLD_SIZE_MIN, WORLD_SIZE_MAX = 16, 32
"""Robots in one Space, by measurement: fewer need more calls, and more form more pairs at the same start."""

COLLISION_SLOP = 0.001
"""Metres of overlap that the contact solver leaves, so that a contact at rest does not flicker."""

WORLDS_KEPT = 64
"""Number of empty Spaces that are kept for reuse, since making one takes as long as thousands of steps."""

PUSH = 1e-6
"""m/s. A robot is in contact when a wall changed the velocity that its wheels gave it by more than this."""

ROBOTS, WALLS = 0b01, 0b10
READ = BodyFields.POSITION | BodyFields.ANGLE | BodyFields.VELOCITY | BodyFields.ANGULAR_VELOCITY
WRITE = BodyFields.FORCE | BodyFields.TORQUE
READ_WIDTH, WRITE_WIDTH = 6, 3
SLACK = 64
"""Spare floats at the end of a batch buffer, since pymunk would reallocate a buffer that is almost full."""

DRIVE = np.dtype(
    [
        ("x", "f8"),
        ("y", "f8"),
        ("angle", "f8"),  # not wrapped
        ("left", "f8"),  # wheel speeds, m/s
        ("right", "f8"),
        ("travel", "f8"),  # signed displacement along the heading in this control step, metres
        ("contact", "?"),  # a wall pushed back in this control step
        ("along_x", "f8"),  # heading half-way through the running substep
        ("along_y", "f8"),
        ("ahead_x", "f8"),  # and through the next one
        ("ahead_y", "f8"),
        ("target_vx", "f8"),  # velocity that the wheels asked for in the running substep
        ("target_vy", "f8"),
    ]
)
"""State of a robot's drive, kept from one substep to the next."""


class Dynamics(NamedTuple):
    """How the robots drive, as the compiled code takes it."""

    substeps: int
    mass: float  # kg
    inertia: float  # kg m2
    axle_track: float  # m
    lag: float  # share of a wheel's speed error that is gone after a substep
    dt: float  # length of a substep, s


class Bodies(NamedTuple):
    """The n bodies of one Space, in its own order.

    Attributes
    ----------
    states : (n, 6) float64
        x, y, angle, vx, vy and angular velocity.
    forces : (n, 3) float64
        Force x and y, and torque.
    rows : (n,) int64
        The robot of each body.
    counts : (2,) intc
        How many floats pymunk's batches for reading and writing hold.
    """

    states: np.ndarray
    forces: np.ndarray
    rows: np.ndarray
    counts: np.ndarray


@compiled
def command_substep(bodies, drive, commands, first, dynamics):
    """Record what the last substep did to the bodies, unless this is the `first`, and set the forces of the next one.

    The forces give each body the velocity of its wheels by the end of the substep. pymunk first moves a body
    by its old velocity, and then computes contacts and the new velocity: so the new velocity has to point along the
    heading half-way through the substep after that.

    Parameters
    ----------
    bodies : Bodies
        The forces are written to.
    drive : (N,) DRIVE
        Updated.
    commands : (N, 2) float64
        Commanded speeds of the left and the right wheel, m/s.
    first : bool
        Whether a control step begins, which resets travel and contact.
    dynamics : Dynamics
    """
    states, forces, dt = bodies.states, bodies.forces, dynamics.dt
    for i in range(bodies.rows.shape[0]):
        row = bodies.rows[i]
        robot = drive[row]
        angle, omega = states[i, 2], states[i, 5]
        if first:
            robot.travel, robot.contact = 0.0, False
        else:
            observe_body(states[i], robot)
        robot.left += dynamics.lag * (commands[row, 0] - robot.left)
        robot.right += dynamics.lag * (commands[row, 1] - robot.right)
        target_omega = (robot.right - robot.left) / dynamics.axle_track
        speed = 0.5 * (robot.left + robot.right)
        # Without friction no wall turns a round robot: what was ahead is now the heading half-way through the substep.
        robot.along_x, robot.along_y = robot.ahead_x, robot.ahead_y
        ahead = angle + omega * dt + 0.5 * target_omega * dt
        robot.ahead_x, robot.ahead_y = math.cos(ahead), math.sin(ahead)
        robot.target_vx, robot.target_vy = speed * robot.ahead_x, speed * robot.ahead_y
        forces[i, 0] = dynamics.mass * (robot.target_vx - states[i, 3]) / dt
        forces[i, 1] = dynamics.mass * (robot.target_vy - states[i, 4]) / dt
        forces[i, 2] = dynamics.inertia * (target_omega - omega) / dt


@compiled
def observe_body(state, robot):
    """Record what a substep did to one body: position, travel along the heading, contact."""
    robot.travel += (state[0] - robot.x) * robot.along_x + (state[1] - robot.y) * robot.along_y
    robot.x, robot.y, robot.angle = state[0], state[1], state[2]
    if abs(state[3] - robot.target_vx) > PUSH or abs(state[4] - robot.target_vy) > PUSH:
        robot.contact = True


class SpaceCalls(NamedTuple):
    """Addresses of one Space, of functions of pymunk's library, and of the batches that they fill and read."""

    space: int
    step: int
    each_body: int
    read: int
    read_batch: int
    write: int
    write_batch: int


@compiled
def read_bodies(calls, bodies):
    """Read the states of all bodies of a Space."""
    bodies.counts[0] = 0
    call_c(calls.each_body, (calls.space, calls.read, calls.read_batch))


@compiled
def drive_bodies(calls, bodies, drive, commands, dynamics):
    """Drive the robots of one Space for a control step; for the arguments see `SpaceCalls` and `command_substep`."""
    for substep in range(dynamics.substeps):
        command_substep(bodies, drive, commands, substep == 0, dynamics)
        bodies.counts[1] = 0
        call_c(calls.each_body, (calls.space, calls.write, calls.write_batch))
        call_c(calls.step, (calls.space, dynamics.dt))  # skips the Python callbacks of Space.step
        read_bodies(calls, bodies)
    for i in range(bodies.rows.shape[0]):
        observe_body(bodies.states[i], drive[bodies.rows[i]])


def address_of(pointer: Any) -> int:
    """Return the address that a pointer of pymunk's library holds."""
    return int(ffi.cast("intptr_t", pointer))


class World:
    """One Space with the walls of one floor plan, and some of the robots in it."""

    def __init__(self, plan: FloorPlan) -> None:
        self.plan = plan
        self.space = pymunk.Space()
        self.space.collision_slop = COLLISION_SLOP
        for ring in plan.rings:
            corners = [(float(x), float(y)) for x, y in ring]
            for i, corner in enumerate(corners):
                following = corners[(i + 1) % len(corners)]
                wall = pymunk.Segment(self.space.static_body, corner, following, 0.0)
                # A robot that slides along a wall would otherwise catch on the joints with its neighbours.
                wall.set_neighbors(corners[i - 1], corners[(i + 2) % len(corners)])
                wall.filter = pymunk.ShapeFilter(categories=WALLS)
                wall.friction = 0.0
                self.space.add(wall)
        self.body_of: dict[int, pymunk.Body] = {}
        self._refresh()

    def add(self, row: int, body: pymunk.Body, radius: float) -> None:
        """Add the body of a robot in place of the one that it had here."""
        self.remove(row)
        shape = pymunk.Circle(body, radius)
        shape.filter = pymunk.ShapeFilter(categories=ROBOTS, mask=WALLS)
        shape.friction = 0.0
        self.space.add(body, shape)
        self.space._bodies_to_check.clear()  # only Space.step, which is never called, empties it
        self.body_of[row] = body
        self._refresh()

    def remove(self, row: int) -> None:
        """Remove the robot, if it is here."""
        body = self.body_of.pop(row, None)
        if body is not None:
            self.space.remove(body, *body.shapes)
            self._refresh()

    def _refresh(self) -> None:
        """Fit the buffers to the bodies, and find their order in the Space."""
        count = len(self.body_of)
        ids = Buffer()
        get_space_bodies(self.space, BodyFields.BODY_ID, ids)
        row_of = {body.id: row for row, body in self.body_of.items()}
        order = [row_of[i] for i in memoryview(ids.int_buf()).cast("P") if i in row_of]  # the walls' body comes last
        read, write = (np.zeros((count + 1) * width + SLACK) for width in (READ_WIDTH, WRITE_WIDTH))
        # `pymunk.batch` would make these in each call, which takes longer than the work itself.
        self._arrays, self._batches = ffi.new("pmFloatArray[2]"), ffi.new("pmBatchedData[2]")
        for i, (fields, floats) in enumerate(((READ, read), (WRITE, write))):
            self._arrays[i].arr, self._arrays[i].max = ffi.cast("double *", floats.ctypes.data), len(floats)
            self._batches[i].floatArray, self._batches[i].fields = ffi.addressof(self._arrays, i), fields.value
        self.bodies = Bodies(
            states=read[: count * READ_WIDTH].reshape(count, READ_WIDTH),
            forces=write[: count * WRITE_WIDTH].reshape(count, WRITE_WIDTH),
            rows=np.array(order, np.int64),
            counts=np.frombuffer(ffi.buffer(self._arrays), np.intc).reshape(2, -1)[:, 0],
        )
        step, each_body = (ffi.addressof(lib, name) for name in ("cpSpaceStep", "cpSpaceEachBody"))
        read_body, write_body = (ffi.addressof(lib, f"pmSpaceBody{kind}IteratorFuncBatched") for kind in ("Get", "Set"))
        reading, writing = (ffi.addressof(self._batches, i) for i in range(2))
        pointers = (self.space._space, step, each_body, read_body, reading, write_body, writing)
        self.calls = SpaceCalls(*map(address_of, pointers))
        read_bodies(self.calls, self.bodies)


class Simulation:
    """N robots in the buildings of a pool of floor plans.

    Attributes
    ----------
    drive : (N,) array of `DRIVE`
        State of the robots after the last control step.
    plan_of : (N,) int64
        The plan in which each robot is; -1 before it is first placed.
    worlds : list of World
        The Spaces in use; `drive_world` may be called for different ones from different threads.
    """

    def __init__(self, robot: RobotConfig, plans: Sequence[FloorPlan], num_robots: int) -> None:
        self.robot = robot
        self.plans = tuple(plans)  # the engine adds plans when robots first draw them
        self.drive = np.zeros(num_robots, DRIVE)
        self.plan_of = np.full(num_robots, -1, np.int64)
        self.worlds: list[World] = []
        share = math.ceil(num_robots / num_cores())
        self._world_size = min(max(share, WORLD_SIZE_MIN), WORLD_SIZE_MAX)
        self._world_of: dict[int, World] = {}
        self._empty: dict[int, World] = {}  # by their plans
        dt, lag = robot.dt / robot.substeps, robot.wheel_time_constant
        self._dynamics = Dynamics(
            substeps=robot.substeps,
            mass=robot.mass,
            inertia=pymunk.moment_for_circle(robot.mass, 0.0, robot.radius),
            axle_track=robot.axle_track,
            lag=1.0 - math.exp(-dt / lag) if lag > 0 else 1.0,
            dt=dt,
        )

    def place(self, row: int, plan: int, pose: Sequence[float]) -> None:
        """Put a robot at rest at `pose` (x, y, heading) in the plan of that number, as a new body."""
        self._add_body(row, plan, (pose[0], pose[1]), pose[2], (0.0, 0.0), 0.0)
        self.drive[row] = np.zeros((), DRIVE)
        ahead = (math.cos(pose[2]), math.sin(pose[2]))
        for name, value in zip(("x", "y", "angle", "ahead_x", "ahead_y"), (*pose, *ahead), strict=True):
            self.drive[name][row] = value

    def _add_body(self, row: int, plan: int, position: Any, angle: float, velocity: Any, omega: float) -> None:
        world = self._world_of.get(row)
        if world is None or self.plan_of[row] != plan:
            if world is not None:
                self._leave(world, row)
            self.plan_of[row] = plan
            world = self._world_of[row] = self._world_with_room(plan)
        body = pymunk.Body(self.robot.mass, self._dynamics.inertia)
        body.position, body.angle = (float(position[0]), float(position[1])), float(angle)
        body.velocity, body.angular_velocity = velocity, omega
        world.add(row, body, self.robot.radius)

    def _world_with_room(self, plan: int) -> World:
        for world in self.worlds:
            if world.plan is self.plans[plan] and len(world.body_of) < self._world_size:
                return world
        self.worlds.append(self._empty.pop(plan, None) or World(self.plans[plan]))
        return self.worlds[-1]

    def _leave(self, world: World, row: int) -> None:
        world.remove(row)
        if not world.body_of:
            self.worlds.remove(world)
            self._empty[int(self.plan_of[row])] = world
            if len(self._empty) > WORLDS_KEPT:
                del self._empty[next(iter(self._empty))]

    def drive_world(self, world: World, commands: np.ndarray) -> None:
        """Drive the robots of one of the `worlds` for a control step, by their rows of `commands` (N, 2), m/s."""
        drive_bodies(world.calls, world.bodies, self.drive, commands, self._dynamics)

    def __getstate__(self) -> dict[str, Any]:
        bodies = {}
        for row, world in self._world_of.items():
            body = world.body_of[row]
            pose, twist = (tuple(body.position), body.angle), (tuple(body.velocity), body.angular_velocity)
            bodies[row] = (int(self.plan_of[row]), *pose, *twist)
        return {"robot": self.robot, "plans": self.plans, "drive": self.drive.copy(), "bodies": bodies}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["robot"], state["plans"], len(state["drive"]))
        for row, (plan, position, angle, velocity, omega) in state["bodies"].items():
            self._add_body(row, plan, position, angle, velocity, omega)
        self.drive[:] = state["drive"]
