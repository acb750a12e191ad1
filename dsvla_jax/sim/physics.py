"""The state of many episodes of one MuJoCo model, and what steps them: C MuJoCo or MJX, behind one interface.

`sim/mujoco_physics.py` steps on the host, `sim/mjx_physics.py` inside jitted programs. Both are a `Physics`.
"""

from collections.abc import Callable, Hashable
from typing import Concatenate, Literal, ParamSpec, Protocol, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.sim.light import light_direction
from dsvla_jax.types import Array, Camera

Engine = Literal["mujoco", "mjx"]

Parameters = ParamSpec("Parameters")
First = TypeVar("First", bound=Hashable)
Result = TypeVar("Result")


class Verdict(struct.PyTreeNode):
    """How an episode is judged so far, latched.

    succeeded, failed: bool (B,), whichever came first. stage: int32 (B,), how many of the conditions that must hold
    one after the other have held.
    """

    succeeded: Array
    failed: Array
    stage: Array


class SimState(struct.PyTreeNode):
    """The whole state of B episodes. Quaternions inside qpos and mocap_quat are wxyz, MuJoCo's order.

    qpos: float32 (B, nq). qvel: float32 (B, nv). ctrl: float32 (B, nu), the last controls.
    mocap_pos: float32 (B, nmocap, 3). mocap_quat: float32 (B, nmocap, 4).
    eq_active: bool (B, neq). eq_data: float32 (B, neq, mjNEQDATA); the rows of welds hold the relative pose.
    geom_xpos: float32 (B, ngeom, 3), geom_xmat: float32 (B, ngeom, 3, 3), world poses for the renderer.
    geom_rgba: float32 (B, ngeom, 4).
    geom_size, geom_pos: float32 (B, ngeom, 3), in the bodies' frames; the model's own unless the physics was made with
        ``resize``.
    camera: the front cameras of the B episodes. light: float32 (B, 3), unit, the direction in which light travels.
    verdict: Verdict. ik_failed: bool (B,), latched: some commanded pose was out of reach.
    grasped: bool (B, neq), latched: the welds that have ever held something.
    diverged: bool (B,), latched: the physics became non-finite, and the state is that of before the run.
    variation: int32 (B,), the task's variation.
    """

    qpos: Array
    qvel: Array
    ctrl: Array
    mocap_pos: Array
    mocap_quat: Array
    eq_active: Array
    eq_data: Array
    geom_xpos: Array
    geom_xmat: Array
    geom_rgba: Array
    geom_size: Array
    geom_pos: Array
    camera: Camera
    light: Array
    verdict: Verdict
    grasped: Array
    ik_failed: Array
    diverged: Array
    variation: Array


Judge = Callable[[SimState], Verdict]
"""The rule of a task, of one example: called after every physics step, with the verdict so far and the step's qpos and
eq_active in the state. Of the other physical fields it may read only those that stay the same while the physics runs:
mocap poses and variation."""


class Physics(Protocol):
    """Steps the episodes of one MuJoCo model, and judges them after every step by the rule it was made with."""

    @property
    def traceable(self) -> bool:
        """Whether it is a pytree of arrays that may be called inside ``jax.jit`` and passed to it as an argument."""
        ...

    def __call__(self, state: SimState, controls: Array, eq_active: Array | None = None) -> SimState:
        """Applies float32 controls (B, S, nu), one row a physics step, to every episode of the batch.

        eq_active: bool (B, S, neq), switches equality constraints step by step; the last row stays in the state. The
            state's own if not given.
        """
        ...

    def compile_part(
        self, function: Callable[Concatenate[First, Parameters], Result], first: First
    ) -> Callable[Parameters, Result]:
        """Gives ``function`` its first argument, a static one, and compiles it if it must be compiled by itself."""
        ...


def initial_state(model: mujoco.MjModel, batch: int, camera: Camera | None = None) -> SimState:
    """``batch`` copies of the model's reference configuration, at rest, seen by ``camera`` (of one example)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)

    def tile(array: np.ndarray, dtype: type = np.float32) -> Array:
        return jnp.asarray(np.broadcast_to(np.asarray(array, dtype), (batch, *np.shape(array))))

    false = jnp.zeros(batch, bool)
    return SimState(
        qpos=tile(data.qpos),
        qvel=tile(data.qvel),
        ctrl=tile(data.ctrl),
        mocap_pos=tile(data.mocap_pos),
        mocap_quat=tile(data.mocap_quat),
        eq_active=tile(data.eq_active, bool),
        eq_data=tile(model.eq_data),
        geom_xpos=tile(data.geom_xpos),
        geom_xmat=tile(data.geom_xmat.reshape(-1, 3, 3)),
        geom_rgba=tile(model.geom_rgba),
        geom_size=tile(model.geom_size),
        geom_pos=tile(model.geom_pos),
        camera=jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), camera or front_camera(1)),
        light=tile(light_direction()),
        verdict=Verdict(false, false, jnp.zeros(batch, jnp.int32)),
        grasped=jnp.zeros((batch, model.neq), bool),
        ik_failed=false,
        diverged=false,
        variation=jnp.zeros(batch, jnp.int32),
    )


def jit_with_mjx(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """``jax.jit`` for programs with MJX in them.

    XLA's CPU fusion emitters of jax 0.10 recompute a chain of bodies from its root for every link: exponentially in
    the number of joints, seconds a step for an arm. They are switched off where that compiler is the one in use.
    """
    affected = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11)
    return jax.jit(function, compiler_options={"xla_cpu_use_fusion_emitters": False} if affected else None)


def jit_on_one_thread(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compiles programs of many tiny matrix products one after the other, such as inverse kinematics.

    On a CPU, to hand them to a pool of threads takes longer than to multiply them.
    """
    options = {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else None
    return jax.jit(function, compiler_options=options)
