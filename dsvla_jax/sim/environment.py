"""Episodes of one task, B at a time: reset, observe, execute a key pose, judge."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.command_line import require_usual_draws
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.sim import controller, raycast
from dsvla_jax.sim import physics as physics_module
from dsvla_jax.sim.physics import SimState, Verdict
from dsvla_jax.sim.scene import build_scene
from dsvla_jax.sim.shifts import Start, check_shifts, shift
from dsvla_jax.sim.tasks import StateView, Task, get_task
from dsvla_jax.types import Action, Array, Camera, Observation

MAX_RAYS = 2**21  # cast at once over all episodes: more need gigabytes
# A pose that no arm reaches: an action that cannot be planned leaves the arms still.
_OUT_OF_REACH = np.array([0.0, 0.0, 100.0, 0.0, 1.0, 0.0, 0.0], np.float32)


@functools.partial(jax.jit, static_argnums=1)
def _draw_variations(keys: Array, count: int) -> Array:
    # A stream of its own, so that a task's placement does not depend on how many variations it has.
    return jax.vmap(lambda key: jax.random.randint(jax.random.fold_in(key, 1), (), 0, count))(keys)


class Environment:
    """A task in a simulator. It keeps compiled programs, never the state of an episode: every method is a function of
    its arguments. With MJX, the pure ``execute_in_mjx(mjx_model, state, action)`` is there for larger jitted programs.

    task: a Task or its name. physics: "mujoco" (C, for CPUs) or "mjx" (accelerators, jitted throughout).
    image_size: height and width of the front camera's picture, pixels.
    num_arms: only checked against the task's, for a caller that needs a certain number.
    shifts: which of ``shifts.SHIFTS`` make the episodes unlike those of training.
    Raises UserError where JAX's settings would draw other episodes from the same seeds.
    """

    def __init__(
        self,
        task: Task | str,
        physics: Literal["mujoco", "mjx"] = "mujoco",
        image_size: int = 96,
        num_arms: int | None = None,
        shadows: bool = True,
        shifts: Sequence[str] = (),
    ):
        require_usual_draws()
        self.task = get_task(task) if isinstance(task, str) else task
        if num_arms is not None and num_arms != self.task.num_arms:
            raise ValueError(f"task {self.task.name!r} is for {self.task.num_arms} arm(s), not {num_arms}")
        self.shifts = check_shifts(shifts)
        self.scene = build_scene(self.task, clutter="background" in self.shifts)
        self.num_arms = self.task.num_arms
        self.image_size = image_size
        self.camera = front_camera(image_size)
        self._shadows = shadows
        self._primitives = raycast.primitives_from_model(self.scene.mj_model)
        self._arms = self.scene.arms
        graspables = self.scene.graspables
        self._welds = self.scene.welds
        self._half_extents = np.array([g.half_extents for g in graspables], np.float32).reshape(-1, 3)
        self._centres = np.array([g.centre for g in graspables], np.float32).reshape(-1, 3)
        self._judge = self._judge_one  # one object, as it is a key of compiled programs

        self._begin = jax.jit(jax.vmap(self._begin_one))
        self._render = jax.jit(self._render_batch)
        self._end_effector = jax.jit(jax.vmap(lambda qpos: controller.end_effector(qpos, self._arms)))
        self._keypoints = jax.jit(jax.vmap(lambda state: self.task.keypoints(self.view(state))))
        self._taken = jax.jit(jax.vmap(self._taken_one))
        self._expert = jax.jit(jax.vmap(lambda state: self.task.expert(self.view(state))))
        if physics == "mujoco":
            stepper = physics_module.mujoco_stepper(self.scene.mj_model, resize="instance" in self.shifts)
            self._execute = self._execute_on(stepper, physics_module.jit_on_one_thread)
        elif physics == "mjx":
            stepper = physics_module.mjx_stepper(self.scene.mj_model, resize="instance" in self.shifts)
            self.mjx_model, self.execute_in_mjx = stepper.mjx_model, self._execute_mjx(stepper)
            jitted = physics_module.jit_with_mjx(self.execute_in_mjx)
            self._execute = lambda state, action: jitted(self.mjx_model, state, action)
        else:
            raise ValueError(f"physics: expected 'mujoco' or 'mjx', got {physics!r}")

    def view(self, state: SimState) -> StateView:
        """What the task's functions read, of one example."""
        return self.scene.view(state)

    def reset(self, keys: Array, variation: Array | None = None) -> SimState:
        """PRNG keys (B,) -> the B episodes' start: bodies placed and at rest, arms at the start posture.

        variation: int32 (B,), drawn from the keys if not given.
        """
        batch = len(keys)
        if variation is None:
            variation = self.variations(keys)
        start = self._begin(keys, jnp.asarray(variation, jnp.int32))
        state = physics_module.initial_state(self.scene.mj_model, batch, self.camera).replace(
            qpos=start.scene.qpos,
            ctrl=start.scene.ctrl,
            mocap_pos=start.scene.mocap_pos,
            mocap_quat=start.scene.mocap_quat,
            geom_rgba=start.scene.geom_rgba,
            geom_size=start.geom_size,
            geom_pos=start.geom_pos,
            camera=start.camera,
            light=start.light,
            variation=jnp.asarray(variation, jnp.int32),
        )
        hold = Action(
            pose=jnp.broadcast_to(_OUT_OF_REACH, (batch, self.num_arms, 7)),
            gripper_open=jnp.ones((batch, self.num_arms), jnp.float32),
        )
        settled = self.execute(state, hold)
        return settled.replace(verdict=state.verdict, ik_failed=state.ik_failed)

    def variations(self, keys: Array) -> Array:
        """The variations int32 (B,) that ``reset`` draws from PRNG keys (B,)."""
        return _draw_variations(keys, self.task.variations)

    def execute(self, state: SimState, action: Action) -> SimState:
        """Moves to a key pose, then opens or closes the grippers. action: pose (B, A, 7), gripper_open (B, A).

        In an episode whose pose is out of reach for any arm, nothing is moved and ``ik_failed`` is set.
        """
        expected = (state.qpos.shape[0], self.num_arms)
        if action.pose.shape != (*expected, 7) or action.gripper_open.shape != expected:
            raise ValueError(
                f"action of task {self.task.name!r}: expected pose {(*expected, 7)} and gripper_open {expected}, got "
                f"{tuple(action.pose.shape)} and {tuple(action.gripper_open.shape)}"
            )
        return self._execute(state, action)

    def follow(self, state: SimState, plan: Action) -> list[SimState]:
        """The states at the start and after each key pose of a plan: pose (B, M, A, 7), gripper_open (B, M, A)."""
        states = [state]
        for m in range(plan.pose.shape[1]):
            state = self.execute(states[-1], Action(plan.pose[:, m], plan.gripper_open[:, m]))
            # Otherwise the whole plan would be in the queue of a device before its first key pose is done.
            states.append(jax.block_until_ready(state))
        return states

    def observe(self, state: SimState) -> Observation:
        """What a policy sees of the B episodes; every field with the batch in front, the camera's too."""
        rgb, depth, _ = self.render(state)
        pose, gripper_open = self.end_effector(state)
        return Observation(rgb=rgb, depth=depth, camera=state.camera, pose=pose, gripper_open=gripper_open)

    def render(self, state: SimState) -> tuple[Array, Array, Array]:
        """rgb uint8 (B, H, W, 3), depth float32 (B, H, W) metres, segmentation int32 (B, H, W), geom ids, -1 sky."""
        seen = (self._primitives.sizes, self.camera, self._primitives.light_direction)
        if self.shifts:
            seen = (state.geom_size, state.camera, state.light)
        return self._render(state.geom_xpos, state.geom_xmat, state.geom_rgba, *seen)

    def success(self, state: SimState) -> Array:
        """bool (B,): the task's predicate has held at some physics step since reset, and no failure came before."""
        return jnp.asarray(state.verdict.succeeded)

    def instructions(self, state: SimState, way: int | np.ndarray = 0) -> list[str]:
        """B sentences, in one of the ways that the task can be said; way: one for all or (B,)."""
        variations = np.asarray(state.variation)
        return [
            self.task.say(int(v), int(w))
            for v, w in zip(variations, np.broadcast_to(way, len(variations)), strict=True)
        ]

    def took_wrong_object(self, state: SimState) -> Array:
        """bool (B,): some hand has ever held a graspable that is not among the task's targets."""
        return self._taken(state)[0]

    def dropped(self, state: SimState) -> Array:
        """bool (B,): a target has been held, and none is held now."""
        return self._taken(state)[1]

    @functools.cached_property
    def expert_keyframes(self) -> int:
        """M, the key poses of the scripted expert; no action is taken to find out."""
        state = physics_module.initial_state(self.scene.mj_model, 1, self.camera)
        return jax.eval_shape(self._expert, state).pose.shape[1]

    def keypoints(self, state: SimState) -> Array:
        """float32 (B, A, K, 3), the task's keypoints as the objects are now."""
        return self._keypoints(state)

    def expert(self, state: SimState) -> Action:
        """The scripted demonstration from a reset state: pose (B, M, A, 7), gripper_open (B, M, A)."""
        return self._expert(state)

    def end_effector(self, state: SimState) -> tuple[Array, Array]:
        """pose float32 (B, A, 7), gripper_open float32 (B, A)."""
        return self._end_effector(state.qpos)

    def _begin_one(self, key: Array, variation: Array) -> Start:
        model = self.scene.mj_model
        start = Start(
            scene=self.scene.place(self.task.sample(key, variation)),
            camera=self.camera,
            light=self._primitives.light_direction,
            geom_size=jnp.asarray(model.geom_size, jnp.float32),
            geom_pos=jnp.asarray(model.geom_pos, jnp.float32),
        )
        return shift(self.shifts, self.scene, jax.random.fold_in(key, 2), start)

    def _judge_one(self, state: SimState) -> Verdict:
        """The stages are passed one a step at most; success counts after the last of them."""
        view, verdict = self.view(state), state.verdict
        open_ = ~(verdict.succeeded | verdict.failed)
        failed = verdict.failed | (open_ & self.task.failure(view))
        stage = verdict.stage
        if self.task.stages:
            holds = jnp.stack([condition(view) for condition in self.task.stages] + [jnp.array(False)])
            stage = stage + (open_ & holds[stage])
        done = (stage == len(self.task.stages)) & self.task.success(view)
        return Verdict(verdict.succeeded | (open_ & ~failed & done), failed, stage.astype(jnp.int32))

    def _taken_one(self, state: SimState) -> tuple[Array, Array]:
        if not self._welds.size:
            return jnp.array(False), jnp.array(False)
        view, ever = self.view(state), jnp.any(state.grasped[self._welds], axis=0)
        right = jnp.ones_like(ever) if self.task.targets is None else self.task.targets(view)
        return jnp.any(ever & ~right), jnp.any(ever & right) & ~jnp.any(view.held & right)

    def _plan_one(self, ctrl: Array, action: Action) -> controller.Plan:
        return controller.plan(ctrl, action, self._arms)

    def _release_one(self, eq_active: Array, opening: Array) -> Array:
        return controller.release_schedule(eq_active, opening, self._welds)

    def _attach_one(self, state: SimState, ok: Array, closing: Array) -> SimState:
        poses, _ = controller.end_effector(state.qpos, self._arms)
        view = self.view(state)
        bodies = [view.body_pose(graspable.body) for graspable in self.task.graspables]
        eq_active, eq_data = controller.attach(
            state.eq_active,
            state.eq_data,
            poses,
            closing,
            jnp.stack(bodies) if bodies else jnp.zeros((0, 7)),
            self._half_extents,
            self._centres,
            self._welds,
        )
        if self.scene.attachments.size:
            # What the hand has just taken counts as held: it would otherwise be dragged back by its carrier.
            after = self.view(state.replace(eq_active=eq_active))
            riding = eq_active[self.scene.attachments] & ~self.task.release(after)
            eq_active = eq_active.at[self.scene.attachments].set(riding)
        return state.replace(
            eq_active=eq_active,
            eq_data=eq_data,
            grasped=state.grasped.at[self._welds].max(eq_active[self._welds]),
            ik_failed=state.ik_failed | ~ok,
        )

    def _execute_on(self, stepper: Any, jit: Callable[[Any], Any]) -> Callable[[SimState, Action], SimState]:
        # Apart from the rest, the plan is one program for all tasks, which is compiled once and then found on disk.
        plan_batch = jit(jax.vmap(self._plan_one))
        release_batch, attach_batch = jit(jax.vmap(self._release_one)), jit(jax.vmap(self._attach_one))

        def execute(state: SimState, action: Action) -> SimState:
            # Accelerators would otherwise multiply float32 matrices in fewer bits than physics and kinematics bear.
            with jax.default_matmul_precision("highest"):
                plan = plan_batch(state.ctrl, action)
                state = stepper(state, plan.controls, self._judge, release_batch(state.eq_active, plan.opening))
                return attach_batch(state, plan.ok, plan.closing)

        return execute

    def _execute_mjx(self, stepper: physics_module.MjxStepper) -> Callable[[Any, SimState, Action], SimState]:
        def execute(mjx_model: Any, state: SimState, action: Action) -> SimState:
            run = functools.partial(stepper, mjx_model=mjx_model)
            return self._execute_on(run, jit=lambda function: function)(state, action)

        return execute

    def _render_batch(
        self, geom_xpos: Array, geom_xmat: Array, geom_rgba: Array, geom_size: Array, camera: Camera, light: Array
    ) -> tuple[Array, Array, Array]:
        """Sizes, camera and light are those of one example unless there are shifts."""
        block = min(raycast.MAX_BLOCK_RAYS, MAX_RAYS // len(geom_xpos))

        def one(
            geom_xpos: Array, geom_xmat: Array, geom_rgba: Array, geom_size: Array, camera: Camera, light: Array
        ) -> tuple[Array, Array, Array]:
            return raycast.render(
                self._primitives.replace(sizes=geom_size, light_direction=light),
                geom_xpos,
                geom_xmat,
                geom_rgba,
                camera,
                self.image_size,
                self.image_size,
                shadows=self._shadows,
                max_block_rays=block,
            )

        own = 0 if self.shifts else None
        return jax.vmap(one, in_axes=(0, 0, 0, own, own, own))(
            geom_xpos, geom_xmat, geom_rgba, geom_size, camera, light
        )
