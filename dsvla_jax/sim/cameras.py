"""RLBench's cameras: front, both shoulders and overhead, fixed in the world, and one on the wrist of each arm.

The poses and fields of view of front, shoulder and wrist cameras are those of RLBench's recordings, to a few
millimetres. The overhead camera's are ours: straight above the middle of the workspace, looking down. Axes are those of
`geometry/cameras.py`.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import make_camera
from dsvla_jax.geometry.rotations import quaternion_to_matrix
from dsvla_jax.sim.kinematics import forward_kinematics
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.rendering import Renderer, Rendering, render, render_from
from dsvla_jax.sim.robot import Arm
from dsvla_jax.sim.scene import Scene
from dsvla_jax.types import Array, Camera, Picture

FRONT = "front"
SINGLE_WRIST, DUAL_WRISTS = ("wrist",), ("wrist_left", "wrist_right")

# Radians.
FIELD_OF_VIEW, WRIST_FIELD_OF_VIEW = np.deg2rad(40.0), np.deg2rad(60.0)


def _looking(position: tuple[float, float, float], heading: float, pitch: float) -> np.ndarray:
    """float32 (4, 4), camera-to-world. heading: about the vertical, 0 along +x; pitch: downwards. Both in degrees."""
    turn, down = np.deg2rad(heading), np.deg2rad(pitch)
    sine, cosine = np.sin(turn), np.cos(turn)
    matrix = np.eye(4)
    matrix[:3, 0] = -sine, cosine, 0
    matrix[:3, 1] = np.sin(down) * cosine, np.sin(down) * sine, np.cos(down)
    matrix[:3, 2] = np.cos(down) * cosine, np.cos(down) * sine, -np.sin(down)
    matrix[:3, 3] = position
    return matrix.astype(np.float32)


FIXED = {
    "left_shoulder": _looking((-0.175, 0.2, 1.98), heading=-10.0, pitch=65.0),
    "right_shoulder": _looking((-0.175, -0.2, 1.98), heading=10.0, pitch=65.0),
    "overhead": _looking((0.15, 0.0, 2.1), heading=0.0, pitch=90.0),
}
# Camera to tool: beside the hand, 10 cm behind the tool centre point, and looking along the approach direction.
TOOL_FROM_WRIST_CAMERA = np.array(
    [
        [0.0, -1.0, 0.0, -0.041],
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, -0.0975],
        [0.0, 0.0, 0.0, 1.0],
    ],
    np.float32,
)


def camera_names(num_arms: int) -> tuple[str, ...]:
    """Returns the cameras of a scene with 1 or 2 arms."""
    return (FRONT, *FIXED, *(SINGLE_WRIST if num_arms == 1 else DUAL_WRISTS))


def check_cameras(names: Sequence[str], num_arms: int) -> tuple[str, ...]:
    """Returns the names. Raises UserError for no name, an unknown or a repeated one."""
    known = camera_names(num_arms)
    if not names or len(set(names)) < len(names) or not set(names) <= set(known):
        raise UserError(
            f"cameras: expected some of {', '.join(known)}, each once (a scene with {num_arms} arm(s) has these), got "
            f"{', '.join(names) or 'none'}"
        )
    return tuple(names)


def place_camera(scene: Scene, name: str, image_size: int, state: SimState) -> Camera:
    """Returns one camera of each of B episodes: intrinsics (B, 3, 3), world_from_camera (B, 4, 4).

    The front camera is the state's own, which test conditions may move; a wrist camera moves with its hand.
    """
    if name == FRONT:
        return state.camera
    batch = state.qpos.shape[0]
    if name in FIXED:
        camera = make_camera(FIXED[name], FIELD_OF_VIEW, image_size, image_size)
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), camera)
    arm = scene.arms[0 if name in SINGLE_WRIST else DUAL_WRISTS.index(name)]
    intrinsics = make_camera(np.eye(4), WRIST_FIELD_OF_VIEW, image_size, image_size).intrinsics
    return Camera(
        intrinsics=jnp.broadcast_to(intrinsics, (batch, 3, 3)),
        world_from_camera=jax.vmap(lambda qpos: _wrist_pose(arm, qpos))(jnp.asarray(state.qpos)),
    )


def take_pictures(
    scene: Scene, renderer: Renderer, names: Sequence[str], state: SimState, front: Rendering | None = None
) -> Picture[Array]:
    """Draws B episodes from several cameras: rgb uint8 (B, C, H, W, 3) and so on, in the order of ``names``.

    Depth is 0 where nothing is hit. front: what `render` drew of this state, if it is there already.
    """
    others = [name for name in names if name != FRONT]
    pictures: dict[str, Picture[Array]] = {}
    if FRONT in names:
        front = render(renderer, state) if front is None else front
        pictures[FRONT] = Picture(front.rgb, front.depth, state.camera)
    if others:
        cameras = [place_camera(scene, name, renderer.image_size, state) for name in others]
        stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(each) for each in x]), *cameras)  # (C, B, ...)
        # One camera after the other: one program, and the memory of one picture an episode.
        drawn = jax.lax.map(lambda camera: render_from(renderer, state, camera), stacked)
        for c, name in enumerate(others):
            pictures[name] = jax.tree.map(lambda x, c=c: x[c], Picture(drawn.rgb, drawn.depth, stacked))
    return jax.tree.map(lambda *x: jnp.stack(x, axis=1), *[pictures[name] for name in names])


def _wrist_pose(arm: Arm, qpos: Array) -> Array:
    """qpos (nq,) -> (4, 4), camera-to-world."""
    # Accelerators would otherwise multiply float32 matrices in fewer bits than a camera's pose bears.
    with jax.default_matmul_precision("highest"):
        tool = forward_kinematics(qpos[arm.joints], jnp.asarray(arm.base))
        world_from_tool = jnp.eye(4).at[:3, :3].set(quaternion_to_matrix(tool[3:])).at[:3, 3].set(tool[:3])
        return world_from_tool @ TOOL_FROM_WRIST_CAMERA
