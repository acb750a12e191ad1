"""MJX: MuJoCo as a pure function of arrays, for accelerators and for larger jitted programs."""

import contextlib
import dataclasses
import functools
import io
from collections.abc import Callable
from typing import Concatenate, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from dsvla_jax.sim.physics import First, Judge, Parameters, Result, SimState, Verdict
from dsvla_jax.types import Array

# mjx prints that warp, an engine of its own for one vendor's cards, is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True, eq=False)
class MjxConstants:
    """What belongs to the compiled program and not to its arguments; compared by identity.

    data: zeros of the model's shapes. mocap_bodies: int, body ids. mocap_ids: int, their rows in the state.
    judge, resize: see `mjx_physics`.
    """

    data: mjx.Data
    mocap_bodies: np.ndarray
    mocap_ids: np.ndarray
    judge: Judge | None
    resize: bool


@struct.dataclass
class MjxPhysics:
    """A `Physics` whose leaves are the model's arrays.

    Pass it to the enclosing jit (see ``jit_with_mjx``) as an argument, so that the model is not baked into the program
    as constants.
    """

    model: mjx.Model
    constants: MjxConstants = struct.field(pytree_node=False)

    @property
    def traceable(self) -> bool:
        """It may be called inside ``jax.jit``."""
        return True

    def compile_part(
        self, function: Callable[Concatenate[First, Parameters], Result], first: First
    ) -> Callable[Parameters, Result]:
        """Compiles nothing: the whole program is compiled around the physics."""
        return functools.partial(function, first)

    def __call__(self, state: SimState, controls: Array, eq_active: Array | None = None) -> SimState:
        """Runs the episodes in MJX; see `Physics`."""
        steps = controls.shape[1]
        if eq_active is None:
            eq_active = jnp.broadcast_to(
                jnp.asarray(state.eq_active)[:, None], (controls.shape[0], steps, state.eq_active.shape[-1])
            )
        return jax.vmap(functools.partial(_run, self.model, self.constants))(state, controls, eq_active)


def mjx_physics(model: mujoco.MjModel, judge: Judge | None = None, resize: bool = False) -> MjxPhysics:
    """Makes the MJX physics of a model.

    judge: called after every step; without one the verdicts stay as they are. resize: episodes have geom sizes of their
    own.
    """
    mocap_bodies = np.flatnonzero(model.body_mocapid >= 0)
    # MJX commits its arrays to a device; jit would compile again whenever they meet others that are not.
    return MjxPhysics(
        model=_uncommitted(mjx.put_model(model, impl="jax")),
        constants=MjxConstants(
            data=_uncommitted(mjx.make_data(model, impl="jax")),
            mocap_bodies=mocap_bodies,
            mocap_ids=model.body_mocapid[mocap_bodies],
            judge=judge,
            resize=resize,
        ),
    )


def _uncommitted(tree: Tree) -> Tree:
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), tree)


def _run(model: mjx.Model, constants: MjxConstants, state: SimState, controls: Array, eq_active: Array) -> SimState:
    """One episode: controls (S, nu), eq_active (S, neq)."""
    model = _with_state(model, constants, state)
    active_dtype = constants.data.eq_active.dtype
    start = _data(constants, state)

    def step(
        carry: tuple[mjx.Data, Verdict, Array], inputs: tuple[Array, Array]
    ) -> tuple[tuple[mjx.Data, Verdict, Array], None]:
        data, verdict, finite = carry
        control, active = inputs
        data = mjx.step(model, data.replace(ctrl=control, eq_active=active.astype(active_dtype)))
        finite = finite & jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
        if constants.judge is not None:
            judged = constants.judge(state.replace(qpos=data.qpos, eq_active=active, verdict=verdict))
            verdict = jax.tree.map(lambda new, old: jnp.where(finite, new, old), judged, verdict)
        return (data, verdict, finite), None

    carry = (start, jax.tree.map(jnp.asarray, state.verdict), jnp.array(True))
    (data, verdict, finite), _ = jax.lax.scan(step, carry, (controls, eq_active))
    state = state.replace(
        qpos=jnp.where(finite, data.qpos, state.qpos),
        qvel=jnp.where(finite, data.qvel, state.qvel),
        ctrl=controls[-1],
        eq_active=eq_active[-1],
        verdict=jax.tree.map(lambda new, old: jnp.where(finite, new, old), verdict, state.verdict),
        diverged=state.diverged | ~finite,
    )
    placed = mjx.kinematics(model, _data(constants, state))
    return state.replace(geom_xpos=placed.geom_xpos, geom_xmat=placed.geom_xmat)


def _with_state(model: mjx.Model, constants: MjxConstants, state: SimState) -> mjx.Model:
    """Returns the model of one episode: its welds, and its furniture where the mocap poses are.

    MJX moves a mocap body without the bodies that hang from it; those follow the model's own pose of the body.
    """
    if constants.resize:
        model = model.replace(geom_size=state.geom_size, geom_pos=state.geom_pos)
    bodies, rows = constants.mocap_bodies, constants.mocap_ids
    return model.replace(
        eq_data=state.eq_data,
        body_pos=model.body_pos.at[bodies].set(state.mocap_pos[rows]),
        body_quat=model.body_quat.at[bodies].set(state.mocap_quat[rows]),
    )


def _data(constants: MjxConstants, state: SimState) -> mjx.Data:
    return constants.data.replace(
        qpos=jnp.asarray(state.qpos),
        qvel=jnp.asarray(state.qvel),
        mocap_pos=jnp.asarray(state.mocap_pos),
        mocap_quat=jnp.asarray(state.mocap_quat),
    )
