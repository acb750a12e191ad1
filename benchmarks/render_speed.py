"""One 128 px colour-depth-segmentation frame costs no more than mujoco.Renderer's three passes (2 minutes; needs EGL).

Usage: MUJOCO_GL=egl python -m benchmarks.render_speed [TASK ...]. Exits with 77 where no OpenGL context can be made.
"""

import sys
import time

import jax
import mujoco
import numpy as np

from benchmarks.raycast_parity import NO_OPENGL, OpenGLViews
from dsvla_jax.command_line import configure_jax
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks

SIZE, BATCH, ROUNDS = 128, 8, 5


def milliseconds(names: list[str], rounds: int) -> dict[str, tuple[float, float]]:
    """Fastest time a frame of the ray caster (in batches) and of the renderer, by turns so that both see one load."""
    times = {}
    for name in names:
        environment = Environment(name, image_size=SIZE)
        model = environment.scene.mj_model
        state = environment.reset(episode_keys(0, "validation", name, 0, BATCH))
        data = mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = state.qpos[0], state.mocap_pos[0], state.mocap_quat[0]
        mujoco.mj_forward(model, data)
        jax.block_until_ready(environment.render(state))
        ours, theirs = [], []
        with OpenGLViews(model, SIZE, fine=False) as views:
            views.view(data, environment.camera)
            for _ in range(rounds):
                start = time.perf_counter()
                jax.block_until_ready(environment.render(state))
                ours.append((time.perf_counter() - start) / BATCH)
                start = time.perf_counter()
                views.view(data, environment.camera)
                theirs.append(time.perf_counter() - start)
        times[name] = (1e3 * min(ours), 1e3 * min(theirs))
    return times


def main(names: tuple[str, ...]) -> int:
    configure_jax()
    try:
        times = milliseconds(list(select_tasks(names)), ROUNDS)
    except (RuntimeError, AttributeError, ImportError) as error:  # what a missing GL library surfaces as
        print(f"no OpenGL context: {error}", file=sys.stderr)
        return NO_OPENGL
    for name, (ours, theirs) in times.items():
        print(f"{name:36} ray caster {ours:6.1f} ms a frame, mujoco.Renderer {theirs:6.1f} ms, {ours / theirs:.2f}")
    worst = max(ours / theirs for ours, theirs in times.values())
    median = np.median([ours / theirs for ours, theirs in times.values()])
    print(f"ratio: median {median:.2f}, worst {worst:.2f} (at most 1)")
    return int(worst > 1)


if __name__ == "__main__":
    sys.exit(main(tuple(sys.argv[1:]) or ("all",)))
