"""The robot, its kinematics, the controller, both engines and the environment, against MuJoCo and against physics."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dsvla_jax.geometry.rotations import (
    DOWN,
    quaternion_from_axis_angle,
    quaternion_from_wxyz,
    quaternion_multiply,
    rotation_distance,
)
from dsvla_jax.sim import controller, environment, physics, robot
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.kinematics import forward_kinematics, reaches, track
from dsvla_jax.sim.mjx_physics import mjx_physics
from dsvla_jax.sim.mujoco_physics import MujocoPhysics
from dsvla_jax.sim.scene import build_scene
from dsvla_jax.sim.tasks import Graspable, Placement, StateView, Task
from dsvla_jax.sim.tasks.task import BOX, HINGE, SLIDE, SPHERE, add_furniture, add_object, add_part, upright_pose
from dsvla_jax.types import TABLE_HEIGHT, Action

HALF = 0.0225
BASE = jnp.array([*robot.SINGLE_BASE, 0, 0, 0, 1], jnp.float32)
Run = Callable[[physics.SimState, jax.Array, jax.Array], physics.SimState]
BATCH = 4  # the same everywhere, as each batch size is compiled anew

_forward = jax.jit(jax.vmap(forward_kinematics, in_axes=(0, None)))


def _cube_task(num_arms: int, shape=BOX) -> Task:
    """A cube (or a ball in its place) on the table; success is holding it 10 cm up."""

    def build(spec):
        cube = add_object(spec, "cube", HALF)
        add_part(cube, "cube", shape, [HALF] * 3, [0, 0, 0], [0.8, 0.1, 0.1, 1], robot.OBJECT, mass=0.1)

    def sample(key, variation):
        xy = jax.random.uniform(key, (2,), minval=jnp.array([0.05, -0.15]), maxval=jnp.array([0.25, 0.15]))
        # A little above the table, so that it has to settle.
        return Placement(free={"cube": upright_pose(xy[0], xy[1], TABLE_HEIGHT + HALF + 0.005)})

    def expert(view):
        raise NotImplementedError

    return Task(
        name="cube",
        num_arms=num_arms,
        build=build,
        sample=sample,
        instructions=("lift the cube",),
        keypoints=lambda view: jnp.broadcast_to(view.body_pose("cube")[:3], (num_arms, 1, 3)),
        success=lambda view: view.body_pose("cube")[2] > TABLE_HEIGHT + HALF + 0.1,
        expert=expert,
        graspables=(Graspable("cube", (HALF, HALF, HALF)),),
    )


@functools.cache
def _environment(num_arms: int = 1, backend: Literal["mujoco", "mjx"] = "mujoco", shape=BOX) -> Environment:
    return Environment(_cube_task(num_arms, shape), backend, image_size=32)


def _cube(env: Environment, state) -> np.ndarray:
    return np.asarray(jax.vmap(lambda s: env.view(s).body_pose("cube"))(state))


def _at(positions, gripper: float, turn=jnp.asarray(DOWN)) -> Action:  # noqa: B008
    """positions (B, A, 3), one gripper command for all."""
    positions = jnp.asarray(positions, jnp.float32)
    pose = jnp.concatenate([positions, jnp.broadcast_to(turn, (*positions.shape[:2], 4))], axis=-1)
    return Action(pose=pose, gripper_open=jnp.full(positions.shape[:2], gripper, jnp.float32))


def _up(height: float) -> np.ndarray:
    return np.array([0.0, 0.0, height])


def _keys():
    return jax.random.split(jax.random.key(0), BATCH)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0, 1.0), (0.0, 0.0, np.sin(0.4), np.cos(0.4))])
def test_forward_kinematics_is_mujocos(turn):
    spec = mujoco.MjSpec()
    robot.set_physics_options(spec)
    robot.add_panda(spec, "left_", (0.1, -0.2, 0.3), turn)
    model = spec.compile()
    data, arm = mujoco.MjData(model), robot.find_arm(model, "left_")
    postures = np.random.default_rng(0).uniform(robot.JOINT_LOW, robot.JOINT_HIGH, (20, 7))
    poses = np.asarray(_forward(postures.astype(np.float32), arm.base))
    for joints, pose in zip(postures, poses, strict=True):
        data.qpos[arm.joints] = joints
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(pose[:3], data.site("left_tcp").xpos, atol=2e-6)
        wxyz = np.zeros(4)
        mujoco.mju_mat2Quat(wxyz, data.site("left_tcp").xmat)
        assert rotation_distance(pose[3:], np.roll(wxyz, -1).astype(np.float32)) < 5e-6
        assert pose[6] >= 0


def test_a_spec_in_degrees_is_refused():
    with pytest.raises(ValueError, match="set_physics_options"):
        robot.add_panda(mujoco.MjSpec(), "left_", robot.SINGLE_BASE)


def test_start_posture_is_rlbenchs():
    pose = np.asarray(_forward(robot.START_JOINTS[None].astype(np.float32), BASE))[0]
    np.testing.assert_allclose(pose[:3], [0.2785, -0.0082, 1.4719], atol=0.05)
    assert rotation_distance(pose[3:], DOWN) < np.deg2rad(15)


def test_inverse_kinematics_reaches_the_workspace():
    rng = np.random.default_rng(1)
    low, high = [0.0, -0.3, TABLE_HEIGHT + 0.02], [0.35, 0.3, TABLE_HEIGHT + 0.25]
    positions = rng.uniform(low, high, (64, 3)).astype(np.float32)
    yaw = quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.asarray(rng.uniform(-1.5, 1.5, 64), jnp.float32))
    poses = jnp.concatenate([positions, quaternion_multiply(yaw, jnp.asarray(DOWN))], axis=-1)
    seed = jnp.asarray(robot.START_JOINTS, jnp.float32)

    @jax.jit
    @jax.vmap
    def solve(pose):
        joints = track(jnp.broadcast_to(pose, (20, 7)), seed, BASE)[-1]
        return joints, reaches(joints, pose, BASE)

    joints, ok = solve(poses)
    assert np.mean(ok) > 0.95
    reached = _forward(joints, BASE)
    assert rotation_distance(reached[:, 3:], poses[:, 3:])[np.asarray(ok)].max() < 0.02
    assert np.linalg.norm((reached - poses)[:, :3], axis=-1)[np.asarray(ok)].max() < 0.002
    assert (joints >= robot.JOINT_LOW).all()
    assert (joints <= robot.JOINT_HIGH).all()

    far = poses.at[:, 0].add(2.0)
    assert not np.any(solve(far)[1])


def test_the_path_is_straight_and_ends_at_rest():
    seed = jnp.asarray(robot.START_JOINTS, jnp.float32)
    goal = jnp.asarray([0.15, 0.2, 0.85, *DOWN], jnp.float32)
    knots, ok = jax.jit(controller.plan_joints)(seed, goal, BASE)
    assert ok
    places = np.asarray(_forward(knots, BASE))[:, :3]
    along = np.linspace(places[0], np.asarray(goal[:3]), len(places))
    assert np.abs(places - along).max() < 0.002
    targets = np.asarray(controller.joint_targets(knots))
    np.testing.assert_allclose(targets[-1], knots[-1], atol=1e-5)
    assert np.abs(targets[0] - np.asarray(seed)).max() < 0.02


@pytest.mark.parametrize("num_arms", [1, 2])
def test_keyframes_are_tracked(num_arms):
    env = _environment(num_arms)
    state = env.reset(_keys())
    sides = np.array([0.0] if num_arms == 1 else [0.3, -0.3])
    rng = np.random.default_rng(2)
    for gripper in (0.0, 1.0, 0.0):
        positions = rng.uniform(
            [0.0, -0.12, TABLE_HEIGHT + 0.12], [0.3, 0.12, TABLE_HEIGHT + 0.4], (BATCH, num_arms, 3)
        )
        positions[..., 1] += sides
        action = _at(positions, gripper)
        state = env.step(state, action)
        pose, gripper_open = env.end_effector(state)
        assert not np.any(state.ik_failed)
        assert np.linalg.norm((pose - action.pose)[..., :3], axis=-1).max() < 0.005
        assert rotation_distance(pose[..., 3:], action.pose[..., 3:]).max() < 0.02
        np.testing.assert_array_equal(gripper_open, action.gripper_open)


def test_links_are_where_mujoco_puts_them():
    def build(spec):
        cabinet = add_furniture(spec, "cabinet")
        drawer = cabinet.add_body(name="drawer", pos=[0.1, 0.02, 0.2], quat=[0.9, 0.1, 0.3, 0.2])
        drawer.add_joint(name="drawer", type=SLIDE, axis=[1, 2, 0])
        flap = drawer.add_body(name="flap", pos=[0.0, 0.1, 0.05])
        flap.add_joint(name="flap", type=HINGE, axis=[0, 1, 1], pos=[0.03, -0.02, 0.01], ref=0.3)
        cube = add_object(spec, "cube", HALF)
        lid = cube.add_body(name="lid", pos=[0.0, 0.0, HALF])
        lid.add_joint(name="lid", type=HINGE, axis=[0, 0, 1], pos=[HALF, 0, 0])
        knob = lid.add_body(name="knob", pos=[0.01, 0.0, 0.01], quat=[0.5, 0.5, 0.5, 0.5])
        for body in (drawer, flap, cube, lid, knob):
            add_part(body, body.name, SPHERE, [0.01], [0, 0, 0], [1, 1, 1, 1], mass=0.1)

    scene = build_scene(dataclasses.replace(_cube_task(1), build=build))
    turn = quaternion_from_axis_angle(jnp.array([0.6, 0.0, 0.8]), jnp.float32(0.7))
    pose = jnp.concatenate([jnp.array([0.2, -0.1, 0.9]), turn])
    joints = {name: jnp.float32(value) for name, value in (("drawer", 0.07), ("flap", -0.8), ("lid", 1.1))}
    placed = scene.place(Placement(mocap={"cabinet": pose}, free={"cube": pose}, joints=joints))
    data = mujoco.MjData(scene.mj_model)
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = placed.qpos, placed.mocap_pos, placed.mocap_quat
    mujoco.mj_kinematics(scene.mj_model, data)
    nothing = jnp.zeros((1, 1), bool)
    view = StateView(placed.qpos, placed.mocap_pos, placed.mocap_quat, nothing, jnp.int32(0), scene.layout)
    for name in ("cabinet", "drawer", "flap", "cube", "lid", "knob"):
        body, pose = data.body(name), view.body_pose(name)
        np.testing.assert_allclose(pose[:3], body.xpos, atol=1e-6)
        assert rotation_distance(pose[3:], quaternion_from_wxyz(jnp.asarray(body.xquat, jnp.float32))) < 1e-3


def test_reset_is_seeded_settled_and_observable():
    env = _environment()
    state = env.reset(_keys())
    np.testing.assert_allclose(_cube(env, state)[:, 2], TABLE_HEIGHT + HALF, atol=1e-3)
    assert np.abs(np.asarray(state.qvel)).max() < 1e-2
    again = env.reset(_keys()[::-1])
    np.testing.assert_array_equal(again.qpos, np.asarray(state.qpos)[::-1])
    assert np.ptp(_cube(env, state)[:, 0]) > 0.01
    assert not np.any(state.verdict.succeeded)
    assert not np.any(state.ik_failed)
    observation = env.observe(state)
    assert observation.pictures.rgb.shape == (BATCH, 1, 32, 32, 3)
    assert observation.pictures.depth.shape == (BATCH, 1, 32, 32)
    assert observation.pictures.camera.intrinsics.shape == (BATCH, 1, 3, 3)
    assert observation.robot.pose.shape == (BATCH, 1, 7)
    np.testing.assert_array_equal(observation.robot.gripper_open, 1.0)
    assert env.keypoints(state).shape == (BATCH, 1, 1, 3)
    cube_geom = env.scene.mj_model.geom("cube").id
    assert (np.asarray(env.render(state)[2]) == cube_geom).any()


def test_the_compiled_environment_is_the_pure_functions():
    env = _environment()
    action = _at(np.full((BATCH, 1, 3), [0.2, 0.1, 1.0]), 0.0)
    compiled = env.step(env.reset(_keys()), action)
    started = environment.reset(env.scene, env.renderer, env.physics, _keys(), env.variations(_keys()))
    pure = environment.step(env.scene, env.physics, started, action)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), pure, compiled)
    seen, expected = environment.observe(env.scene, env.renderer, env.cameras, pure), env.observe(compiled)
    np.testing.assert_allclose(seen.robot.pose, expected.robot.pose, atol=1e-5)
    assert np.mean(np.asarray(seen.pictures.rgb) != np.asarray(expected.pictures.rgb)) < 1e-2


def _carry(env: Environment, state):
    """Grasps, lifts and carries the cube. Returns the state when held, and when carried."""
    cube = _cube(env, state)[:, None, :3]
    held = env.step(env.step(state, _at(cube + _up(0.1), 1.0)), _at(cube, 0.0))
    lifted = env.step(held, _at(cube + _up(0.2), 0.0))
    goal = np.broadcast_to([0.15, 0.0, TABLE_HEIGHT + 0.2], (BATCH, 1, 3))
    turn = quaternion_multiply(quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(0.7)), jnp.array(DOWN))
    return held, env.step(lifted, _at(goal, 0.0, turn)), goal


def test_a_cube_is_attached_carried_and_released():
    env = _environment()
    state = env.reset(_keys())
    weld = env.scene.graspables[0].welds[0]
    held, carried, goal = _carry(env, state)
    assert np.asarray(held.eq_active)[:, weld].all()
    assert not np.any(held.verdict.succeeded)
    np.testing.assert_allclose(_cube(env, carried)[:, :3], goal[:, 0], atol=0.006)
    np.testing.assert_array_equal(env.success(carried), True)

    dropped = env.step(carried, _at(goal, 1.0))
    assert not np.asarray(dropped.eq_active)[:, weld].any()
    settled = env.step(dropped, _at(goal, 1.0))
    assert _cube(env, settled)[:, 2].max() < TABLE_HEIGHT + 0.05
    np.testing.assert_array_equal(env.success(settled), True)  # latched


def test_only_a_cube_at_the_closing_fingers_is_attached():
    env = _environment()
    state = env.reset(_keys())
    weld = env.scene.graspables[0].welds[0]
    cube = _cube(env, state)[:, None, :3]
    above = env.step(state, _at(cube + _up(HALF + 0.05), 0.0))
    assert not np.asarray(above.eq_active)[:, weld].any()
    # The fingers are closed already: touching the cube does not attach it.
    touched = env.step(above, _at(cube + _up(HALF + 0.01), 0.0))
    assert not np.asarray(touched.eq_active)[:, weld].any()


def test_an_unreachable_pose_stops_its_own_episode_only():
    env = _environment()
    state = env.reset(_keys())
    near = _at(np.full((BATCH, 1, 3), [0.2, 0.1, 1.0]), 0.0)
    for bad in (5.0, np.nan):
        mixed = Action(pose=near.pose.at[1, 0, 0].set(bad), gripper_open=near.gripper_open)
        after = env.step(state, mixed)
        np.testing.assert_array_equal(after.ik_failed, [False, True, False, False])
        np.testing.assert_allclose(np.asarray(after.qpos)[1], np.asarray(state.qpos)[1], atol=1e-3)
        alone = env.step(state, near)
        np.testing.assert_array_equal(np.asarray(after.qpos)[[0, 2, 3]], np.asarray(alone.qpos)[[0, 2, 3]])


def test_actions_of_a_wrong_shape_are_named():
    env = _environment()
    with pytest.raises(ValueError, match=r"expected pose \(4, 1, 7\)"):
        env.step(env.reset(_keys()), _at(np.zeros((BATCH, 2, 3)), 1.0))


@functools.cache
def _tiny_model() -> mujoco.MjModel:
    """A ball on a plane, a ball welded to a mocap body from which a pendulum hangs, a slide with an actuator."""
    spec = mujoco.MjSpec()
    robot.set_physics_options(spec)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    ball = mujoco.mjtGeom.mjGEOM_SPHERE
    spec.worldbody.add_geom(type=plane, size=[1, 1, 0.1], contype=1, conaffinity=6)
    for name, x in (("free", 0.0), ("held", 0.5)):
        body = spec.worldbody.add_body(name=name, pos=[x, 0, 0.06])
        body.add_freejoint()
        body.add_geom(type=ball, size=[0.05, 0, 0], mass=0.1, contype=2, conaffinity=1)
    hand = spec.worldbody.add_body(name="hand", mocap=True, pos=[0.5, 0, 0.3])
    pendulum = hand.add_body(pos=[0, 0, 0.1])
    pendulum.add_joint(name="pendulum", axis=[0, 1, 0], damping=0.01)
    pendulum.add_geom(type=ball, pos=[0.1, 0, 0], size=[0.02, 0, 0], mass=0.1, contype=0, conaffinity=0)
    slider = spec.worldbody.add_body(pos=[0, 0.5, 0.3])
    slider.add_joint(name="slide", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], damping=0.5)
    slider.add_geom(type=ball, size=[0.05, 0, 0], mass=1.0, contype=0, conaffinity=0)
    spec.add_equality(
        name="weld",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="hand",
        name2="held",
        active=False,
        solref=[0.02, 1.0],
    )
    actuator = spec.add_actuator(name="slide", target="slide", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=50.0, kv=5.0)
    return spec.compile()


def _tiny_run(run: Run) -> physics.SimState:
    """Four episodes: the second begins with a non-finite velocity, and each welds its ball at an offset of its own
    half-way through."""
    state = physics.initial_state(_tiny_model(), 4)
    rows = np.zeros((4, 1, mujoco.mjNEQDATA), np.float32)
    rows[:, 0, 3:11] = [0.1, 0, -0.1, 1, 0, 0, 0, 1]
    rows[:, 0, 3] += 0.02 * np.arange(4)
    mocap = np.array(state.mocap_pos)
    mocap[:, 0, 1] = 0.1 * np.arange(4)
    qvel = np.array(state.qvel)
    qvel[:, 0] = 0.3
    qvel[1, 0] = np.nan
    state = state.replace(eq_data=rows, mocap_pos=mocap, qvel=qvel)
    steps = 120
    controls = np.broadcast_to(np.linspace(0, 1, steps, dtype=np.float32)[None, :, None], (4, steps, 1))
    active = np.broadcast_to((np.arange(steps) >= 60)[None, :, None], (4, steps, 1))
    return run(state, jnp.asarray(controls), jnp.asarray(active))


def _passing_low(state: physics.SimState) -> physics.Verdict:
    """Holds only while the ball falls, at no end of the run."""
    low = (state.qpos[2] < 0.0575) & (state.qpos[0] < 0.05)
    return state.verdict.replace(succeeded=state.verdict.succeeded | low)


def test_both_engines_agree_and_keep_episodes_apart():
    c_state = _tiny_run(MujocoPhysics(_tiny_model(), _passing_low))
    engine = mjx_physics(_tiny_model(), _passing_low)
    mjx_state = _tiny_run(physics.jit_with_mjx(lambda *arguments: engine(*arguments)))
    good = np.array([0, 2, 3])
    for state in (c_state, mjx_state):
        np.testing.assert_array_equal(state.diverged, [False, True, False, False])
        np.testing.assert_array_equal(state.verdict.succeeded, [True, False, True, True])
        np.testing.assert_allclose(np.asarray(state.qpos)[1], np.asarray(_tiny_model().qpos0), atol=1e-6)
        # The welded balls have come to their own offsets from their own hands.
        held = np.asarray(state.qpos)[good, 7:10]
        expected = [[0.6 + 0.02 * i, 0.1 * i, 0.2] for i in good]
        np.testing.assert_allclose(held, expected, atol=0.02)
        assert np.isfinite(np.asarray(state.geom_xpos)).all()
    for field in ("qpos", "qvel", "ctrl", "geom_xpos", "geom_xmat"):
        first, second = (np.asarray(getattr(s, field))[good] for s in (c_state, mjx_state))
        np.testing.assert_allclose(first, second, atol=2e-3, err_msg=field)
    np.testing.assert_array_equal(c_state.eq_active, mjx_state.eq_active)


@pytest.mark.slow
def test_mjx_grasps_and_carries_as_mujoco_does():
    # A ball: contacts between boxes take minutes to compile.
    env, oracle = _environment(backend="mjx", shape=SPHERE), _environment(shape=SPHERE)
    state = env.reset(_keys())
    expected = oracle.reset(_keys())
    np.testing.assert_allclose(state.qpos, expected.qpos, atol=1e-3)
    _, carried, goal = _carry(env, state)
    np.testing.assert_array_equal(env.success(carried), True)
    np.testing.assert_allclose(_cube(env, carried)[:, :3], goal[:, 0], atol=0.006)
    np.testing.assert_allclose(_cube(env, carried), _cube(oracle, _carry(oracle, expected)[1]), atol=0.02)
