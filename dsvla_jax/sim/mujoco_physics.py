"""C MuJoCo on the host's processors, in a pool of threads."""

import copy
import functools
import os
from collections.abc import Callable, Hashable
from typing import Any, Concatenate

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from dsvla_jax.sim.physics import First, Judge, Parameters, Result, SimState, Verdict, jit_on_one_thread
from dsvla_jax.types import Array


def judge_steps(judge: Judge, state: SimState, qpos: Array, eq_active: Array) -> Verdict:
    """The verdict after S steps, per example: qpos (S, nq), eq_active (S, neq)."""

    def step(verdict: Verdict, inputs: tuple[Array, Array]) -> tuple[Verdict, None]:
        qpos, active = inputs
        return judge(state.replace(qpos=qpos, eq_active=active, verdict=verdict)), None

    return jax.lax.scan(step, state.verdict, (qpos, eq_active))[0]


class MujocoPhysics:
    """A `Physics` that takes and returns arrays on the host; not for use under jit.

    judge: called after every step; without one the verdicts stay as they are. resize: episodes have geom sizes of their
    own. threads: 2 at most if not given.
    """

    traceable = False

    def __init__(
        self, model: mujoco.MjModel, judge: Judge | None = None, resize: bool = False, threads: int | None = None
    ) -> None:
        self.model = model
        self._judge = jax.jit(jax.vmap(functools.partial(judge_steps, judge))) if judge else None
        self._resize = resize
        self._threads = threads or min(2, os.cpu_count() or 1)
        self._pool = mujoco.rollout.Rollout(nthread=self._threads)
        self._data = [mujoco.MjData(model) for _ in range(self._threads)]
        # Weld poses are model fields, so each episode needs a model of its own.
        self._models: list[mujoco.MjModel] = []
        # Functions of any signatures, each with its first argument.
        self._parts: dict[tuple[Callable[..., Any], Hashable], Callable[..., Any]] = {}

    def compile_part(
        self, function: Callable[Concatenate[First, Parameters], Result], first: First
    ) -> Callable[Parameters, Result]:
        """Compiles ``function`` with its first argument as a constant; the same two give the same program again."""
        key = (function, first)
        if key not in self._parts:
            self._parts[key] = jit_on_one_thread(functools.partial(function, first))
        return self._parts[key]

    def __call__(self, state: SimState, controls: Array, eq_active: Array | None = None) -> SimState:
        """Runs the episodes in C; see `Physics`. Raises ValueError for controls of another batch or model."""
        model = self.model
        batch, steps, nu = controls.shape
        if nu != model.nu or batch != state.qpos.shape[0]:
            raise ValueError(
                f"controls: expected ({state.qpos.shape[0]}, steps, {model.nu}), got {tuple(controls.shape)}"
            )
        self._need_models(batch)
        eq_data, mocap_pos, mocap_quat = map(np.asarray, (state.eq_data, state.mocap_pos, state.mocap_quat))
        mocap_bodies = np.flatnonzero(model.body_mocapid >= 0)
        mocap_ids = model.body_mocapid[mocap_bodies]
        for i in range(batch):
            # A rollout whose controls do not name the mocap poses takes them from the model's body poses.
            self._models[i].eq_data[:] = eq_data[i]
            self._models[i].body_pos[mocap_bodies] = mocap_pos[i, mocap_ids]
            self._models[i].body_quat[mocap_bodies] = mocap_quat[i, mocap_ids]
        self._set_sizes(state)
        if eq_active is None:
            active = np.broadcast_to(np.asarray(state.eq_active)[:, None], (batch, steps, model.neq))
        else:
            active = np.asarray(eq_active)
        spec = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_EQ_ACTIVE)
        inputs = np.concatenate([np.asarray(controls, np.float64), active.astype(np.float64)], axis=-1)
        start = np.concatenate([np.zeros((batch, 1)), np.asarray(state.qpos), np.asarray(state.qvel)], axis=1)
        if model.na or model.npluginstate:
            raise ValueError(
                "the model has actuator activations or plugins, which SimState does not carry: remove them"
            )
        history = np.asarray(self._pool.rollout(self._models[:batch], self._data, start, inputs, control_spec=spec)[0])

        # MuJoCo resets an episode that diverges, and its clock with it.
        expected = steps * model.opt.timestep
        ok = np.isfinite(history).all(axis=(1, 2)) & (np.abs(history[:, -1, 0] - expected) < 0.5 * model.opt.timestep)
        history = np.where(ok[:, None, None], history[..., 1:], start[:, None, 1:]).astype(np.float32)
        qpos, qvel = history[..., : model.nq], history[..., model.nq :]
        verdict = state.verdict
        if self._judge is not None:
            judged = self._judge(state, jnp.asarray(qpos), jnp.asarray(active))
            verdict = jax.tree.map(lambda new, old: np.where(ok, new, old), judged, verdict)
        state = state.replace(
            qpos=qpos[:, -1],
            qvel=qvel[:, -1],
            ctrl=np.asarray(controls, np.float32)[:, -1],
            eq_active=active[:, -1],
            verdict=verdict,
            diverged=np.asarray(state.diverged) | ~ok,
        )
        return self.update_geometry(state)

    def _need_models(self, batch: int) -> None:
        while len(self._models) < batch:
            self._models.append(copy.copy(self.model))

    def _set_sizes(self, state: SimState) -> None:
        """Gives each episode's model its own sizes, and bounds around them."""
        if not self._resize:
            return
        base, sizes, places = self.model, np.asarray(state.geom_size), np.asarray(state.geom_pos)
        factors = np.max(sizes / np.where(base.geom_size > 0, base.geom_size, np.inf), axis=-1)
        factors = np.where(factors > 0, factors, 1.0)  # a plane has no size of its own
        for model, size, place, factor in zip(self._models[: len(sizes)], sizes, places, factors, strict=True):
            model.geom_size[:], model.geom_pos[:] = size, place
            model.geom_rbound[:] = base.geom_rbound * factor
            model.geom_aabb[:, 3:] = base.geom_aabb[:, 3:] * factor[:, None]
            # The middle phase bounds whole bodies, which grow less than twice.
            model.bvh_aabb[:, 3:] = 2 * base.bvh_aabb[:, 3:]

    def update_geometry(self, state: SimState) -> SimState:
        """Sets geom_xpos and geom_xmat from qpos and the mocap poses."""
        model, data = self.model, self._data[0]
        if self._resize:
            self._need_models(len(state.qpos))
            self._set_sizes(state)
        qpos, mocap_pos, mocap_quat = map(np.asarray, (state.qpos, state.mocap_pos, state.mocap_quat))
        batch = qpos.shape[0]
        positions = np.empty((batch, model.ngeom, 3), np.float32)
        matrices = np.empty((batch, model.ngeom, 9), np.float32)
        for i in range(batch):
            data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos[i], mocap_pos[i], mocap_quat[i]
            mujoco.mj_kinematics(self._models[i] if self._resize else model, data)
            positions[i], matrices[i] = data.geom_xpos, data.geom_xmat
        return state.replace(geom_xpos=positions, geom_xmat=matrices.reshape(batch, model.ngeom, 3, 3))
