"""Physics: many episodes of one MuJoCo model at a time, by C MuJoCo or by MJX, behind one signature.

``mujoco_stepper(model)`` and ``mjx_stepper(model)`` both return a function

    run(state, controls, judge=None, eq_active=None) -> state

that applies float32 controls (B, S, nu), one row a physics step, to every episode of the batch. ``eq_active`` bool
(B, S, neq) switches equality constraints step by step; the last row stays in the state.

``judge(state) -> Verdict`` is per example and called after every step, with the verdict so far and the step's qpos and
eq_active in the state; of the other physical fields it may read only what does not change within a run (mocap poses,
variation).
"""

import contextlib
import copy
import functools
import io
import os
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from flax import struct

from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.sim import raycast
from dsvla_jax.types import Array, Camera


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
    geom_size, geom_pos: float32 (B, ngeom, 3), in the bodies' frames; the model's own unless a stepper was made with
        ``resize``.
    camera: the B cameras that look on. light: float32 (B, 3), unit, the way that light travels in the world.
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


class Stepper(Protocol):
    def __call__(
        self, state: SimState, controls: Array, judge: Judge | None = None, eq_active: Array | None = None
    ) -> SimState: ...


def initial_state(model: mujoco.MjModel, batch: int, camera: Camera | None = None) -> SimState:
    """``batch`` copies of the model's reference configuration, at rest, seen by ``camera`` (of one example)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)

    def tile(array: np.ndarray, dtype: Any = np.float32) -> Array:
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
        camera=jax.tree.map(tile, camera or front_camera(1)),
        light=tile(raycast.light_direction()),
        verdict=Verdict(false, false, jnp.zeros(batch, jnp.int32)),
        grasped=jnp.zeros((batch, model.neq), bool),
        ik_failed=false,
        diverged=false,
        variation=jnp.zeros(batch, jnp.int32),
    )


def judge_steps(judge: Judge, state: SimState, qpos: Array, eq_active: Array) -> Verdict:
    """The verdict after S steps, per example: qpos (S, nq), eq_active (S, neq)."""

    def step(verdict: Verdict, inputs: tuple[Array, Array]) -> tuple[Verdict, None]:
        qpos, active = inputs
        return judge(state.replace(qpos=qpos, eq_active=active, verdict=verdict)), None

    return jax.lax.scan(step, state.verdict, (qpos, eq_active))[0]


class MujocoStepper:
    """C MuJoCo in a pool of threads. Takes and returns arrays on the host; not for use under jit."""

    def __init__(self, model: mujoco.MjModel, threads: int | None = None, resize: bool = False):
        self.model = model
        self._resize = resize
        self._threads = threads or min(2, os.cpu_count() or 1)
        self._pool = mujoco.rollout.Rollout(nthread=self._threads)
        self._data = [mujoco.MjData(model) for _ in range(self._threads)]
        # Weld poses are model fields, so each episode needs a model of its own.
        self._models: list[mujoco.MjModel] = []
        self._judges: dict[Judge, Callable[[SimState, Array, Array], Verdict]] = {}

    def __call__(
        self, state: SimState, controls: Array, judge: Judge | None = None, eq_active: Array | None = None
    ) -> SimState:
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
        history: Any
        history, _ = self._pool.rollout(self._models[:batch], self._data, start, inputs, control_spec=spec)

        # MuJoCo resets an episode that diverges, and its clock with it.
        expected = steps * model.opt.timestep
        ok = np.isfinite(history).all(axis=(1, 2)) & (np.abs(history[:, -1, 0] - expected) < 0.5 * model.opt.timestep)
        history = np.where(ok[:, None, None], history[..., 1:], start[:, None, 1:]).astype(np.float32)
        qpos, qvel = history[..., : model.nq], history[..., model.nq :]
        verdict = state.verdict
        if judge is not None:
            if judge not in self._judges:
                self._judges[judge] = jax.jit(jax.vmap(functools.partial(judge_steps, judge)))
            judged = self._judges[judge](state, jnp.asarray(qpos), jnp.asarray(active))
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


def mujoco_stepper(model: mujoco.MjModel, threads: int | None = None, resize: bool = False) -> MujocoStepper:
    """The C stepper of ``model``; see the module's words for the signature. resize: episodes have their own sizes."""
    return MujocoStepper(model, threads, resize)


class MjxStepper:
    """MJX: pure, for use under ``jit_with_mjx``. ``mjx_model`` may be passed in as an argument of the enclosing jit, so
    that the model is not baked into the program as constants."""

    def __init__(self, model: mujoco.MjModel, resize: bool = False):
        # mjx prints that warp, an engine of its own for one vendor's cards, is not installed.
        with contextlib.redirect_stdout(io.StringIO()):
            from mujoco import mjx

        self._mjx, self._resize = mjx, resize
        # MJX commits its arrays to a device; jit would compile again whenever they meet others that are not.
        self.mjx_model = _uncommitted(mjx.put_model(model, impl="jax"))
        self._template = _uncommitted(mjx.make_data(model, impl="jax"))
        self._mocap_bodies = np.flatnonzero(model.body_mocapid >= 0)
        self._mocap_ids = model.body_mocapid[self._mocap_bodies]

    def __call__(
        self,
        state: SimState,
        controls: Array,
        judge: Judge | None = None,
        eq_active: Array | None = None,
        mjx_model: Any = None,
    ) -> SimState:
        model = self.mjx_model if mjx_model is None else mjx_model
        steps = controls.shape[1]
        if eq_active is None:
            eq_active = jnp.broadcast_to(
                jnp.asarray(state.eq_active)[:, None], (controls.shape[0], steps, state.eq_active.shape[-1])
            )
        run = functools.partial(self._run_one, model, judge=judge)
        return jax.vmap(run)(state, controls, eq_active)

    def _run_one(self, model: Any, state: SimState, controls: Array, eq_active: Array, judge: Judge | None) -> SimState:
        model = self._with_state(model, state)
        active_dtype = self._template.eq_active.dtype
        data = self._data(state)

        def step(carry: tuple[Any, Verdict, Array], inputs: tuple[Array, Array]) -> tuple[Any, None]:
            data, verdict, finite = carry
            control, active = inputs
            data = self._mjx.step(model, data.replace(ctrl=control, eq_active=active.astype(active_dtype)))
            finite = finite & jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
            if judge is not None:
                judged = judge(state.replace(qpos=data.qpos, eq_active=active, verdict=verdict))
                verdict = jax.tree.map(lambda new, old: jnp.where(finite, new, old), judged, verdict)
            return (data, verdict, finite), None

        carry = (data, jax.tree.map(jnp.asarray, state.verdict), jnp.array(True))
        (data, verdict, finite), _ = jax.lax.scan(step, carry, (controls, eq_active))
        state = state.replace(
            qpos=jnp.where(finite, data.qpos, state.qpos),
            qvel=jnp.where(finite, data.qvel, state.qvel),
            ctrl=controls[-1],
            eq_active=eq_active[-1],
            verdict=jax.tree.map(lambda new, old: jnp.where(finite, new, old), verdict, state.verdict),
            diverged=state.diverged | ~finite,
        )
        return self._with_geometry(model, state)

    def _with_state(self, model: Any, state: SimState) -> Any:
        """The model of one episode: its welds, and its furniture where the mocap poses are. MJX moves a mocap body
        without the bodies that hang from it; those follow the model's own pose of the body."""
        if self._resize:
            model = model.replace(geom_size=state.geom_size, geom_pos=state.geom_pos)
        return model.replace(
            eq_data=state.eq_data,
            body_pos=model.body_pos.at[self._mocap_bodies].set(state.mocap_pos[self._mocap_ids]),
            body_quat=model.body_quat.at[self._mocap_bodies].set(state.mocap_quat[self._mocap_ids]),
        )

    def _with_geometry(self, model: Any, state: SimState) -> SimState:
        data = self._mjx.kinematics(model, self._data(state))
        return state.replace(geom_xpos=data.geom_xpos, geom_xmat=data.geom_xmat)

    def _data(self, state: SimState) -> Any:
        return self._template.replace(
            qpos=jnp.asarray(state.qpos),
            qvel=jnp.asarray(state.qvel),
            mocap_pos=jnp.asarray(state.mocap_pos),
            mocap_quat=jnp.asarray(state.mocap_quat),
        )


def _uncommitted(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), tree)


def jit_with_mjx(function: Callable[..., Any], **options: Any) -> Any:
    """``jax.jit`` for programs with MJX in them.

    XLA's CPU fusion emitters of jax 0.10 recompute a chain of bodies from its root for every link: exponentially in
    the number of joints, seconds a step for an arm. They are switched off where that compiler is the one in use.
    """
    affected = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11)
    return jax.jit(function, compiler_options={"xla_cpu_use_fusion_emitters": False} if affected else None, **options)


def jit_on_one_thread(function: Callable[..., Any]) -> Any:
    """``jax.jit`` for programs of many tiny matrix products one after the other, such as inverse kinematics: on a CPU,
    to hand them to a pool of threads takes longer than to multiply them."""
    options = {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else None
    return jax.jit(function, compiler_options=options)


def mjx_stepper(model: mujoco.MjModel, resize: bool = False) -> MjxStepper:
    """The MJX stepper of ``model``; see the module's words for the signature. resize: episodes have their own sizes."""
    return MjxStepper(model, resize)
