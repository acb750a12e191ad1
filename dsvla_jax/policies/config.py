"""What a policy is made of, besides its weights and vocabulary: read by training, evaluation and serving."""

import dataclasses
from typing import Literal

from dsvla_jax.data_config import LearnedFrom
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.encoding.vector_scale import VectorScale
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.same_sizes import require_same_sizes
from dsvla_jax.ranges import at_least, check_fields, require
from dsvla_jax.types import LOOK_BACK

# Heads of the attention to words, and groups of channels that are normalised together.
DP3_HEADS, DP3_GROUPS = 4, 8


@dataclasses.dataclass(frozen=True)
class BehaviourCloningConfig:
    """Behaviour cloning on 3DS-VLA's trunk: a head reads the keyframe off its last hidden state, as numbers."""

    kind: Literal["behaviour_cloning"] = "behaviour_cloning"
    """Which policy this is."""
    upcoming: int = 1
    """Keyframes that are learned from every frame on; the first is executed."""
    normalise: Literal["box", "data"] = "box"
    """The range of what is learned. box: positions in half sides of the codec's box. data: every number also stretched
    from its range in the demonstrations to -1 to 1."""
    hidden: int = 256
    """Width of the head's two hidden layers."""
    rotation_weight: float = 1.0
    """Weight of the rotation's error in the loss; that of the position is 1."""
    gripper_weight: float = 0.1
    """Weight of the gripper's error in the loss."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "baseline",
            upcoming=at_least(1, at_most=100),
            hidden=at_least(1),
            rotation_weight=at_least(0),
            gripper_weight=at_least(0),
        )


@dataclasses.dataclass(frozen=True)
class DP3Config:
    """3D Diffusion Policy: a small point encoder and a denoising network over the next keyframes."""

    kind: Literal["dp3"] = "dp3"
    """Which policy this is."""
    upcoming: int = 4
    """Keyframes that are denoised together; the first is executed."""
    normalise: Literal["box", "data"] = "box"
    """The range of what is learned. box: positions in half sides of the codec's box. data: every number also stretched
    from its range in the demonstrations to -1 to 1."""
    look_back: int = 0
    """Earlier states of the robot that it reads, at most 4, with the number of keyframes so far; 0 for neither."""
    colours: bool = True
    """Whether points have colours; the original's have none."""
    point_channels: tuple[int, ...] = (64, 128, 256)
    """Channels of the point encoder's layers, before the maximum over points."""
    feature: int = 128
    """Channels of the points' feature, of words and of the robot's state; a multiple of 4."""
    language_layers: int = 2
    """Layers in which the points' feature looks at the words."""
    channels: tuple[int, ...] = (128, 256, 384)
    """Channels of the denoising network's levels, each a multiple of 8."""
    diffusion_steps: int = 100
    """Noise levels in training."""
    inference_steps: int = 10
    """Denoising steps of one action, at most diffusion_steps."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "baseline",
            upcoming=at_least(1, at_most=100),
            look_back=at_least(0, at_most=LOOK_BACK),
            feature=at_least(1),
            point_channels=at_least(1),
            channels=at_least(1),
            language_layers=at_least(0, at_most=100),
            diffusion_steps=at_least(2),
            inference_steps=at_least(1, at_most=self.diffusion_steps),
        )
        require(bool(self.point_channels), "baseline.point_channels", "one number or more", self.point_channels)
        widths = bool(self.channels) and not any(width % DP3_GROUPS for width in self.channels)
        require(widths, "baseline.channels", f"multiples of {DP3_GROUPS}, one or more", self.channels)
        require(self.feature % DP3_HEADS == 0, "baseline.feature", f"a multiple of {DP3_HEADS}", self.feature)


Baseline = BehaviourCloningConfig | DP3Config
"""Policies that 3DS-VLA is compared with."""


def uses_model(baseline: Baseline | None) -> bool:
    """Whether a policy has the network of `ModelConfig`; others have one of their own."""
    return not isinstance(baseline, DP3Config)


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """What inference needs to know of a run besides its weights and vocabulary."""

    encoding: EncodingConfig
    model: ModelConfig
    displacement: DisplacementScale | None = None
    """The range of answers that say where to go from the present pose; None for answers that are poses."""
    vector_scale: VectorScale | None = None
    """The range of what a baseline with `normalise` "data" answers with."""
    learned_from: LearnedFrom | None = None
    """None for runs of versions that did not keep it."""
    vocabulary: str | None = None
    """What `vocabulary_digest` gives for the run's vocabulary; None in runs from before it was written."""
    baseline: Baseline | None = None
    """Another policy than 3DS-VLA."""

    @property
    def wants_keypoints(self) -> bool:
        """Whether prompts state a keypoint, because those of training did."""
        seen = self.learned_from is None or self.learned_from.keypoints != "none"
        return self.encoding.use_keypoints and seen

    def __post_init__(self) -> None:
        if uses_model(self.baseline):
            require_same_sizes(self.encoding, self.model)
