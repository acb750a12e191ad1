"""The environment as pure functions, `reset`, `step`, `observe` and `judge`, and a class that compiles them.

All of them but `judge` take B episodes of one task at a time. An action is a keyframe: the arms move to a pose, then
the grippers open or close.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.command_line import require_usual_draws
from dsvla_jax.sim import controller
from dsvla_jax.sim.cameras import FRONT, check_cameras, take_pictures
from dsvla_jax.sim.mujoco_physics import MujocoPhysics
from dsvla_jax.sim.physics import Engine, Physics, SimState, Verdict, initial_state, jit_with_mjx
from dsvla_jax.sim.rendering import Renderer, Rendering, make_renderer, render
from dsvla_jax.sim.scene import Scene, build_scene
from dsvla_jax.sim.shifts import Start, check_shifts, shift
from dsvla_jax.sim.tasks import StateView, Task, get_task
from dsvla_jax.types import Action, Array, Observation, Picture, RobotState

# A pose that no arm reaches: an action that cannot be planned leaves the arms still.
_OUT_OF_REACH = np.array([0.0, 0.0, 100.0, 0.0, 1.0, 0.0, 0.0], np.float32)


class EndEffectors(NamedTuple):
    """pose: float32 (B, A, 7) of the tool centre points. gripper_open: float32 (B, A), 0 or 1."""

    pose: Array
    gripper_open: Array


class Taken(NamedTuple):
    """What the hands of B episodes have taken and lost.

    wrong: bool (B,), some hand has ever held a graspable that is not among the task's targets. dropped: bool (B,), a
    target has been held, and none is held now.
    """

    wrong: Array
    dropped: Array


def reset(scene: Scene, renderer: Renderer, physics: Physics, keys: Array, variation: Array) -> SimState:
    """Starts B episodes: bodies placed and at rest, arms at the start posture.

    keys: PRNG keys (B,). variation: int32 (B,), see `draw_variations`.
    """
    return settle(scene, place(scene, renderer, keys, variation), functools.partial(step, scene, physics))


def step(scene: Scene, physics: Physics, state: SimState, action: Action) -> SimState:
    """Moves the arms to a keyframe, then opens or closes the grippers.

    In an episode whose pose is out of reach for any arm, nothing is moved and ``ik_failed`` is set.

    action: pose (B, A, 7), gripper_open (B, A). physics: of the scene, see `make_physics`; under ``jax.jit`` it must be
    traceable.
    """
    # Accelerators would otherwise multiply float32 matrices in fewer bits than physics and kinematics bear.
    with jax.default_matmul_precision("highest"):
        # Apart from the rest, the plan is one program for all tasks, which is compiled once and then found on disk.
        plan = physics.compile_part(_plan, scene)(state.ctrl, action)
        eq_active = physics.compile_part(_release, scene)(state.eq_active, plan.opening)
        state = physics(state, plan.controls, eq_active)
        return physics.compile_part(_attach, scene)(state, plan.ok, plan.closing)


def observe(scene: Scene, renderer: Renderer, cameras: Sequence[str], state: SimState) -> Observation:
    """Returns what a policy sees of the B episodes; every field with the batch in front, the cameras' too.

    cameras: names, see `sim/cameras.py`; the order of the pictures' camera axis.
    """
    return _observation(take_pictures(scene, renderer, cameras, state), end_effectors(scene, state))


def judge(scene: Scene, state: SimState) -> Verdict:
    """Judges one example after a physics step: the stages are passed one a step at most; success counts after the last.

    Success and failure are latched, whichever comes first.
    """
    task, view, verdict = scene.task, scene.view(state), state.verdict
    open_ = ~(verdict.succeeded | verdict.failed)
    failed = verdict.failed | (open_ & task.failure(view))
    stage = verdict.stage
    if task.stages:
        holds = jnp.stack([condition(view) for condition in task.stages] + [jnp.array(False)])
        stage = stage + (open_ & holds[stage])
    done = (stage == len(task.stages)) & task.success(view)
    return Verdict(verdict.succeeded | (open_ & ~failed & done), failed, stage.astype(jnp.int32))


def make_physics(scene: Scene, engine: Engine) -> Physics:
    """Makes what steps and judges the episodes of a scene.

    engine: "mujoco" (C, for CPUs) or "mjx" (accelerators, jitted throughout). Raises ValueError for another.
    """
    rule, resize = functools.partial(judge, scene), "instance" in scene.shifts
    if engine == "mujoco":
        return MujocoPhysics(scene.mj_model, rule, resize)
    if engine == "mjx":
        # MJX takes seconds to import.
        from dsvla_jax.sim.mjx_physics import mjx_physics

        return mjx_physics(scene.mj_model, rule, resize)
    raise ValueError(f"physics: expected 'mujoco' or 'mjx', got {engine!r}")


def place(scene: Scene, renderer: Renderer, keys: Array, variation: Array) -> SimState:
    """Places the bodies of B episodes, with the scene's shifts; they have not come to rest yet. See `reset`."""

    def one(key: Array, variation: Array) -> SimState:
        model = scene.mj_model
        start = Start(
            scene=scene.place(scene.task.sample(key, variation)),
            camera=renderer.camera,
            light=renderer.primitives.light_direction,
            geom_size=jnp.asarray(model.geom_size, jnp.float32),
            geom_pos=jnp.asarray(model.geom_pos, jnp.float32),
        )
        start = shift(scene, jax.random.fold_in(key, 2), start)
        state = jax.tree.map(lambda x: x[0], initial_state(model, 1))
        return state.replace(
            qpos=start.scene.qpos,
            ctrl=start.scene.ctrl,
            mocap_pos=start.scene.mocap_pos,
            mocap_quat=start.scene.mocap_quat,
            geom_rgba=start.scene.geom_rgba,
            geom_size=start.geom_size,
            geom_pos=start.geom_pos,
            camera=start.camera,
            light=start.light,
            variation=variation,
        )

    return jax.vmap(one)(keys, variation)


def settle(scene: Scene, state: SimState, advance: Callable[[SimState, Action], SimState]) -> SimState:
    """Lets the bodies come to rest while the arms hold still. advance: `step` of the scene, compiled or not."""
    batch, arms = state.qpos.shape[0], len(scene.arms)
    hold = Action(
        pose=jnp.broadcast_to(_OUT_OF_REACH, (batch, arms, 7)), gripper_open=jnp.ones((batch, arms), jnp.float32)
    )
    return advance(state, hold).replace(verdict=state.verdict, ik_failed=state.ik_failed)


@functools.partial(jax.jit, static_argnums=1)
def draw_variations(keys: Array, count: int) -> Array:
    """Draws which of ``count`` variations each episode is: PRNG keys (B,) -> int32 (B,)."""
    # A stream of its own, so that a task's placement does not depend on how many variations it has.
    return jax.vmap(lambda key: jax.random.randint(jax.random.fold_in(key, 1), (), 0, count))(keys)


def end_effectors(scene: Scene, state: SimState) -> EndEffectors:
    """Returns where the hands of B episodes are, and whether they are open."""
    return EndEffectors(*jax.vmap(lambda qpos: controller.end_effector(qpos, scene.arms))(state.qpos))


def taken(scene: Scene, state: SimState) -> Taken:
    """Returns what the hands of B episodes have taken and lost."""

    def one(state: SimState) -> Taken:
        if not scene.welds.size:
            return Taken(jnp.array(False), jnp.array(False))
        view, ever = scene.view(state), jnp.any(state.grasped[scene.welds], axis=0)
        right = jnp.ones_like(ever) if scene.task.targets is None else scene.task.targets(view)
        return Taken(jnp.any(ever & ~right), jnp.any(ever & right) & ~jnp.any(view.held & right))

    return jax.vmap(one)(state)


def _observation(pictures: Picture[Array], hands: EndEffectors) -> Observation:
    return Observation(pictures, RobotState(hands.pose, hands.gripper_open))


def _plan(scene: Scene, ctrl: Array, action: Action) -> controller.Plan:
    return jax.vmap(lambda ctrl, action: controller.plan(ctrl, action, scene.arms))(ctrl, action)


def _release(scene: Scene, eq_active: Array, opening: Array) -> Array:
    return jax.vmap(lambda active, opening: controller.release_schedule(active, opening, scene.welds))(
        eq_active, opening
    )


def _attach(scene: Scene, state: SimState, ok: Array, closing: Array) -> SimState:
    """Welds what the closing hands have reached, and lets go of the attachments that the task releases."""
    half_extents = np.array([g.half_extents for g in scene.graspables], np.float32).reshape(-1, 3)
    centres = np.array([g.centre for g in scene.graspables], np.float32).reshape(-1, 3)

    def one(state: SimState, ok: Array, closing: Array) -> SimState:
        poses, _ = controller.end_effector(state.qpos, scene.arms)
        view = scene.view(state)
        bodies = [view.body_pose(graspable.body) for graspable in scene.task.graspables]
        eq_active, eq_data = controller.attach(
            state.eq_active,
            state.eq_data,
            poses,
            closing,
            jnp.stack(bodies) if bodies else jnp.zeros((0, 7)),
            half_extents,
            centres,
            scene.welds,
        )
        if scene.attachments.size:
            # What the hand has just taken counts as held: it would otherwise be dragged back by its carrier.
            after = scene.view(state.replace(eq_active=eq_active))
            riding = eq_active[scene.attachments] & ~scene.task.release(after)
            eq_active = eq_active.at[scene.attachments].set(riding)
        return state.replace(
            eq_active=eq_active,
            eq_data=eq_data,
            grasped=state.grasped.at[scene.welds].max(eq_active[scene.welds]),
            ik_failed=state.ik_failed | ~ok,
        )

    return jax.vmap(one)(state, ok, closing)


class Environment:
    """A task in a simulator: the functions of this module, compiled for its scene.

    It holds no episode's state: every method is a function of its arguments.

    task: a Task or its name. physics: "mujoco" (C, for CPUs) or "mjx" (accelerators, jitted throughout). To step inside
        a larger jitted program, pass ``environment.physics`` to it and call `step` with ``environment.scene``.
    image_size: height and width of the pictures, pixels. cameras: names of those that `observe` looks through, see
        `sim/cameras.py`.
    shifts: which of ``shifts.SHIFTS`` make the episodes unlike those of training.
    Raises UserError if JAX's settings would draw other episodes from the same seeds.
    """

    def __init__(
        self,
        task: Task | str,
        physics: Engine = "mujoco",
        image_size: int = 96,
        shadows: bool = True,
        shifts: Sequence[str] = (),
        cameras: Sequence[str] = (FRONT,),
    ) -> None:
        require_usual_draws()
        self.task = get_task(task) if isinstance(task, str) else task
        self.shifts = check_shifts(shifts)
        self.scene = build_scene(self.task, self.shifts)
        self.num_arms = self.task.num_arms
        self.image_size = image_size
        self.cameras = check_cameras(cameras, self.num_arms)
        self.renderer = make_renderer(self.scene.mj_model, image_size, shadows, varied=bool(self.shifts))
        self.camera = self.renderer.camera
        self.physics = make_physics(self.scene, physics)

        transition = functools.partial(step, self.scene)
        self._step = jit_with_mjx(transition) if self.physics.traceable else transition
        self._place = jax.jit(functools.partial(place, self.scene))
        self._render = jax.jit(render)
        self._take_pictures = jax.jit(functools.partial(take_pictures, self.scene), static_argnums=1)
        self._end_effectors = jax.jit(functools.partial(end_effectors, self.scene))
        self._taken = jax.jit(functools.partial(taken, self.scene))
        self._keypoints = jax.jit(jax.vmap(lambda state: self.task.keypoints(self.view(state))))
        self._expert = jax.jit(jax.vmap(lambda state: self.task.expert(self.view(state))))

    def reset(self, keys: Array, variation: Array | None = None) -> SimState:
        """Starts B episodes from PRNG keys (B,), see `reset`. variation: int32 (B,), drawn from the keys by default."""
        variation = self.variations(keys) if variation is None else variation
        return settle(self.scene, self._place(self.renderer, keys, jnp.asarray(variation, jnp.int32)), self.step)

    def step(self, state: SimState, action: Action) -> SimState:
        """Moves to a keyframe, see `step`. Raises ValueError for an action of another shape."""
        expected = (state.qpos.shape[0], self.num_arms)
        if action.pose.shape != (*expected, 7) or action.gripper_open.shape != expected:
            raise ValueError(
                f"action of task {self.task.name!r}: expected pose {(*expected, 7)} and gripper_open {expected}, got "
                f"{tuple(action.pose.shape)} and {tuple(action.gripper_open.shape)}"
            )
        return self._step(self.physics, state, action)

    def follow(self, state: SimState, plan: Action) -> list[SimState]:
        """Returns the states at the start and after each keyframe of a plan.

        plan: pose (B, M, A, 7), gripper_open (B, M, A).
        """
        states = [state]
        for m in range(plan.pose.shape[1]):
            state = self.step(states[-1], Action(plan.pose[:, m], plan.gripper_open[:, m]))
            # Otherwise the whole plan would be in the queue of a device before its first keyframe is done.
            states.append(jax.block_until_ready(state))
        return states

    def observe(self, state: SimState) -> Observation:
        """Returns what a policy sees with ``self.cameras``, see `observe`."""
        # One program draws the front camera's picture and its segmentation.
        front = self.render(state) if FRONT in self.cameras else None
        return _observation(self._take_pictures(self.renderer, self.cameras, state, front), self.end_effector(state))

    def render(self, state: SimState) -> Rendering:
        """Draws colour, depth and segmentation of the front camera."""
        return self._render(self.renderer, state)

    def view(self, state: SimState) -> StateView:
        """What the task's functions read, of one example."""
        return self.scene.view(state)

    def variations(self, keys: Array) -> Array:
        """The variations int32 (B,) that ``reset`` draws from PRNG keys (B,)."""
        return draw_variations(keys, self.task.variations)

    def success(self, state: SimState) -> Array:
        """bool (B,): the task's predicate has held at some physics step since reset, and no failure came before."""
        return jnp.asarray(state.verdict.succeeded)

    def instructions(self, state: SimState, paraphrase: int | np.ndarray = 0) -> list[str]:
        """B sentences. paraphrase: which wording of the task, one for all or (B,)."""
        variations = np.asarray(state.variation)
        return [
            self.task.say(int(variation), int(wording))
            for variation, wording in zip(variations, np.broadcast_to(paraphrase, len(variations)), strict=True)
        ]

    def took_wrong_object(self, state: SimState) -> Array:
        """bool (B,): some hand has ever held a graspable that is not among the task's targets."""
        return self._taken(state).wrong

    def dropped(self, state: SimState) -> Array:
        """bool (B,): a target has been held, and none is held now."""
        return self._taken(state).dropped

    @functools.cached_property
    def expert_keyframes(self) -> int:
        """M, the keyframes of the scripted expert; no action is taken to find out."""
        state = initial_state(self.scene.mj_model, 1, self.camera)
        return jax.eval_shape(self._expert, state).pose.shape[1]

    def keypoints(self, state: SimState) -> Array:
        """float32 (B, A, K, 3), the task's keypoints as the objects are now."""
        return self._keypoints(state)

    def expert(self, state: SimState) -> Action:
        """The scripted demonstration from a reset state: pose (B, M, A, 7), gripper_open (B, M, A)."""
        return self._expert(state)

    def end_effector(self, state: SimState) -> EndEffectors:
        """pose float32 (B, A, 7), gripper_open float32 (B, A)."""
        return self._end_effectors(state)
