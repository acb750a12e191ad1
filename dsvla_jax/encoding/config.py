"""The configuration of everything between an observation and the network."""

import dataclasses

import numpy as np

from dsvla_jax.encoding.alignment import AlignmentMode
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.encoding.prompts import POSITION_SLOT, Style
from dsvla_jax.ranges import FINITE, at_least, check_fields, require, require_box


@dataclasses.dataclass(frozen=True)
class EncodingConfig:
    """Everything between an observation and the network; hashable, so it can be a static argument of jit."""

    image_size: int = 336
    """Pixels a side of the square image that the network sees; a multiple of patch_size (paper: 336)."""
    patch_size: int = 14
    """Pixels a side of one patch (paper: 14)."""
    points: PointTokenizerConfig = dataclasses.field(default_factory=PointTokenizerConfig)
    """The 3D tokenizer."""
    stride: int = 2
    """Every how many pixels along each side a depth map gives a candidate point."""
    workspace_low: tuple[float, float, float] = (-1.5, -1.5, 0.76)
    """Lower corner of the box that the point cloud is cut to, metres, world frame. The default floor is just above the
    table top, which would otherwise take most of the points."""
    workspace_high: tuple[float, float, float] = (1.5, 1.5, 3.0)
    """Upper corner of that box, metres, world frame."""
    alignment: AlignmentMode = "aligned"
    """Which 2D positional embedding a 3D token reuses. aligned: that of the patch its centre projects to (paper).
    index_order: token i that of patch i, the ablation."""
    style: Style = "paper"
    """Wording of prompt and answer: paper, as published, or compact, for small vocabularies."""
    max_text_length: int = 512
    """Tokens of prompt and answer together, with begin and end."""
    codec: PoseCodec = dataclasses.field(default_factory=PoseCodec)
    """How poses become integers."""
    use_keypoints: bool = True
    """State the active keypoint of each arm in the prompt (paper, section 3.3); false is the ablation."""
    use_points: bool = True
    """Give the vision encoder 3D tokens (paper, section 3.2); false is the ablation."""
    use_images: bool = True
    """Give the vision encoder the pictures; false is a blind control: every picture is replaced by the same one."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "encoding",
            image_size=at_least(1),
            patch_size=at_least(1),
            stride=at_least(1),
            workspace_low=FINITE,
            workspace_high=FINITE,
            max_text_length=at_least(1),
        )
        require_box("encoding.workspace_low", self.workspace_low, "workspace_high", self.workspace_high)
        patches = f"a multiple of patch_size {self.patch_size}"
        require(self.image_size % self.patch_size == 0, "encoding.image_size", patches, self.image_size)
        self._require_writable_positions()

    def _require_writable_positions(self) -> None:
        """Raises UserError if the codec counts a position by an integer that no answer may hold."""
        low, high = np.array(self.codec.low), np.array(self.codec.high)
        counts = np.array([low, high]) * self.codec.bins / (high - low)
        lowest, highest = round(counts.min()), round(counts.max())
        require(
            POSITION_SLOT.low <= lowest and highest <= POSITION_SLOT.high,
            "encoding.codec.bins",
            f"positions that count from {POSITION_SLOT.low} to {POSITION_SLOT.high}, as an answer writes them",
            f"{lowest} to {highest}",
            f"use fewer bins than {self.codec.bins}, or a larger box than {self.codec.low} to {self.codec.high}",
        )

    def require_patches(self, cameras: int) -> None:
        """Raises UserError if alignment index_order has fewer patches of so many cameras than 3D tokens."""
        patches = cameras * self.grid**2
        require(
            not self.use_points or self.alignment != "index_order" or self.num_point_tokens <= patches,
            "encoding.points.group_sizes",
            f"at most {patches} tokens at the end with alignment index_order, one a patch",
            self.num_point_tokens,
        )

    def require_points(self, height: int, width: int, cameras: int, picture: str = "a depth map") -> None:
        """Raises UserError if the cameras' depth maps have fewer points than the 3D tokenizer takes.

        picture: what to call one of them.
        """
        count = cameras * -(-height // self.stride) * -(-width // self.stride)
        each = picture if cameras == 1 else f"{cameras} pictures, each {picture}"
        require(
            not self.use_points or count >= self.points.num_points,
            "encoding.points.num_points",
            f"at most the {count} points of {each} of {height} x {width} pixels with encoding.stride {self.stride}",
            self.points.num_points,
            "lower num_points or stride, or use larger pictures",
        )

    @property
    def grid(self) -> int:
        """Patches along a side of the image."""
        return self.image_size // self.patch_size

    @property
    def num_point_tokens(self) -> int:
        """G."""
        return self.points.num_tokens if self.use_points else 0
