"""What a run learns from. On the lowest floor: the pipelines read it, and an experiment contains it."""

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Demonstrations and what is varied each time a sample is drawn from them."""

    source: Literal["simulator", "episodes"] = "simulator"
    """`simulator`: scripted experts write what `folder` lacks; `episodes`: `folder` as it is, imported or one's own."""
    folder: str = "data/demos"
    tasks: tuple[str, ...] = ("lamp_on", "put_rubbish_in_bin", "close_fridge", "bimanual_lift_ball")
    """Names of tasks, all, single_arm or dual_arm; of imported or own demonstrations names or all."""
    episodes: int = 100
    """Demonstrations a task; of imported or own ones, at most so many."""
    image_size: int = 96
    """Rendered pixels a side."""
    seed: int = 0
    perturb: float = 0.03
    """Metres by which half of the key poses are missed on purpose, so that the next sample starts off the path."""
    shift_world: float = 0.0
    """Metres: pose, keypoints, target and camera are moved by one random offset, so the picture stays true."""
    state_jitter: float = 0.0
    """Metres of noise on the stated current position, on half of the samples."""
    keypoint_noise: float = 0.03
    """Metres of uniform noise an axis on the keypoint (paper, section 3.3; the paper leaves its size open)."""
    keypoint_noise_probability: float = 0.5
    colour_variation: float = 0.0
    """Relative strength of the brightness, contrast and colour variation; 0 turns it off."""
