"""How an episode ended, and why."""

import dataclasses

import jax
import numpy as np
from jaxtyping import UInt8

from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.types import Array, Camera, Observation


@dataclasses.dataclass(frozen=True)
class View:
    """What the C cameras of one episode saw at one moment."""

    rgb: UInt8[np.ndarray, "c h w 3"]
    camera: Camera[np.ndarray]
    """Stacked: intrinsics (C, 3, 3), world_from_camera (C, 4, 4)."""


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
    views: list[View]
    """What the policy saw before each keyframe, and the last view. Of the loop on the device, the last view alone."""
    targets: list[np.ndarray]
    """float32 (A, 3): the position answered to each view but the last."""


def views_of(observation: Observation) -> list[View]:
    """Returns what was seen of each of the B episodes."""
    rgb, camera = jax.tree.map(np.asarray, (observation.pictures.rgb, observation.pictures.camera))
    return [View(rgb[i], jax.tree.map(lambda x, i=i: x[i], camera)) for i in range(len(rgb))]


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
