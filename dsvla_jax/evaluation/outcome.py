"""How an episode ended, and why."""

import dataclasses

import jax
import numpy as np

from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.types import Array, Camera


@dataclasses.dataclass(frozen=True)
class EpisodeOutcome:
    """One finished episode."""

    success: bool
    reason: str
    """Why it failed; empty on success."""
    keyframes: int
    """Keyframes executed."""
    instruction: str
    answers: list[str]
    """The policy's answer text for each keyframe."""
    frames: list[np.ndarray]
    """uint8 (H, W, 3): what the policy saw before each keyframe, and the last view. Of the loop on the device, the last
    view alone."""
    camera: Camera
    """The camera of the frames."""
    targets: list[np.ndarray]
    """float32 (A, 3): the position answered to each frame but the last."""


def is_over(state: SimState) -> Array:
    """Returns bool (B,): whether nothing that is still to come can change an episode's outcome."""
    return state.verdict.succeeded | state.verdict.failed | state.diverged


def failure_reasons(environment: Environment, state: SimState) -> list[str]:
    """Returns why each of the B episodes has not succeeded, the gravest reason first; empty if it has."""
    checks = {
        "the simulation diverged": state.diverged,
        "entered the fail zone": state.verdict.failed,
        "took the wrong object": environment.took_wrong_object(state),
        "a pose was out of reach": state.ik_failed,
        "dropped the object": environment.dropped(state),
    }
    found = {reason: np.asarray(check) for reason, check in checks.items()}
    succeeded = np.asarray(environment.success(state))
    return [
        "" if succeeded[i] else next((reason for reason, check in found.items() if check[i]), "time-out")
        for i in range(len(succeeded))
    ]


def camera_of(state: SimState, episode: int) -> Camera:
    """Returns the camera of one of the B episodes."""
    return jax.tree.map(lambda x: x[episode], state.camera)
