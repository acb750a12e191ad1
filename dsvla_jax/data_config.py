"""What a run learns from. On the lowest floor: the pipelines read it, and an experiment contains it."""

import dataclasses
from typing import Literal

from dsvla_jax.ranges import at_least, check_fields, more_than, require

SHARE = at_least(0, at_most=1)
# Noise in metres: the box that poses are counted in is 2 m wide.
NOISE = at_least(0, at_most=10)

MAX_CAMERAS = 4


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Demonstrations and what is varied each time a sample is drawn from them."""

    source: Literal["simulator", "episodes"] = "simulator"
    """`simulator`: scripted experts write what `folder` lacks; `episodes`: `folder` as it is, imported or one's own."""
    folder: str = "data/demos"
    """Folder of the demonstrations."""
    tasks: tuple[str, ...] = ("lamp_on", "put_rubbish_in_bin", "close_fridge", "bimanual_lift_ball")
    """Names of tasks, all, single_arm or dual_arm; of imported or own demonstrations names or all."""
    episodes: int = 100
    """Demonstrations a task; of imported or own ones, at most so many."""
    cameras: tuple[str, ...] = ("front",)
    """Names of 1 to 4 cameras to learn from, in this order. The simulator's are front, left_shoulder, right_shoulder,
    overhead and wrist, of two arms wrist_left and wrist_right. `front` is also the only camera of demonstrations that
    have no other, whatever its name."""
    image_size: int = 96
    """Rendered pixels a side."""
    seed: int = 0
    """Seed of the demonstrations that are generated."""
    perturb: float = 0.03
    """Metres by which half of the keyframes are missed on purpose, so that the next sample starts off the path."""
    keypoints: Literal["segmentation", "oracle"] = "segmentation"
    """Of simulated demonstrations, and so of evaluation unless it is told otherwise: those found in the first picture
    by the simulator's masks and the depth on them (paper, section 3.3), or the task's own points."""
    shift_world: float = 0.0
    """Metres: pose, keypoints, target and camera are moved by one random offset, so the picture stays true."""
    crop: float = 1.0
    """Least share of each side that a random window keeps; its intrinsics move along. 1 turns it off."""
    state_jitter: float = 0.0
    """Metres of noise on the stated current position, on half of the samples."""
    keypoint_noise: float = 0.03
    """Metres of uniform noise an axis on the keypoint (paper, section 3.3; the paper leaves its size open)."""
    keypoint_noise_probability: float = 0.5
    """Share of the samples whose keypoint gets noise."""
    colour_variation: float = 0.0
    """Relative strength of the brightness, contrast and colour variation; 0 turns it off."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "data",
            episodes=at_least(1),
            image_size=at_least(1),
            seed=at_least(0),
            perturb=NOISE,
            shift_world=NOISE,
            crop=more_than(0, at_most=1),
            state_jitter=NOISE,
            keypoint_noise=NOISE,
            keypoint_noise_probability=SHARE,
            colour_variation=SHARE,
        )
        require_folder("data.folder", self.folder)
        distinct = len(set(self.cameras)) == len(self.cameras) and all(self.cameras)
        expected = f"1 to {MAX_CAMERAS} different names"
        require(distinct and 1 <= len(self.cameras) <= MAX_CAMERAS, "data.cameras", expected, self.cameras)
        require(bool(_names(self.tasks)), "data.tasks", "names of tasks", self.tasks)


@dataclasses.dataclass(frozen=True)
class OxeConfig:
    """Open X-Embodiment episodes to learn from (docs/data_oxe.md)."""

    folder: str = "data/oxe"
    """Where the datasets' folders are: a path or a URL."""
    mixture: tuple[str, ...] = ("oxe_magic_soup_plus_minus",)
    """A named mixture, or datasets as NAME or NAME=WEIGHT; a weight multiplies the dataset's number of samples."""
    split: str = "train"
    """Split of every dataset, as its builder names it."""
    target: Literal["relative", "absolute"] = "relative"
    """relative: displacement from the present pose, binned between its 1 % and 99 % quantiles; absolute: the pose."""
    horizon: float = 1.0
    """Seconds from a frame to its target; 0 for the next keyframe."""
    image_size: int = 224
    """Pixels a side of the square picture."""
    crop: float = 0.9
    """Smallest fraction of a picture's sides that a random crop keeps; 1 turns it off."""
    colour_variation: float = 0.2
    """Relative strength of the brightness, contrast and saturation variation; 0 turns it off."""
    window: int = 32
    """Episodes of each dataset that are open at a time, among whose frames samples are drawn."""
    streams: int = 8
    """Parts that episodes are dealt to. As many processes, or a divisor of it, read none of each other's records."""
    unsupported: Literal["refuse", "leave_out"] = "refuse"
    """What to do with datasets that do not tell what the target needs."""
    unlabelled: Literal["leave_out", "keep", "refuse"] = "leave_out"
    """What to do with episodes whose instruction is empty, blank or "nan": leave them out, as openvla does, learn from
    them with prompts that ask for nothing, or stop."""
    colours_mended: bool = False
    """The copies have red and blue in their places, as those that went through rlds_dataset_mod for octo or openvla."""
    skip_bad: bool = False
    """Leave damaged records and pictures out, and list them, instead of stopping."""
    cache: str = ""
    """A folder for indices and statistics; empty: beside the data, or the user's cache where that cannot be written."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "oxe",
            horizon=at_least(0, at_most=3600),
            image_size=at_least(1),
            crop=more_than(0, at_most=1),
            colour_variation=SHARE,
            window=at_least(1),
            streams=at_least(1, at_most=4096),
        )
        require_folder("oxe.folder", self.folder)
        # None at all is for programs that read a single build, which no mixture names.
        names = _names(self.mixture)
        require(bool(names) or not self.mixture, "oxe.mixture", "a named mixture or names of datasets", self.mixture)
        require(bool(self.split), "oxe.split", "the name of a split, such as train", repr(self.split))


@dataclasses.dataclass(frozen=True)
class LearnedFrom:
    """What a policy saw in training, which is what it must be asked with."""

    source: Literal["simulator", "demonstrations", "oxe"]
    """The task suite, imported or own demonstrations, or Open X-Embodiment."""
    keypoints: Literal["none", "oracle", "segmentation", "recorded"]
    """none: prompts without them. oracle: the task's own. segmentation: found in the first picture with the simulator's
    masks. recorded: those of the demonstrations."""
    image_size: tuple[int, int]
    """Height and width of the pictures, pixels."""
    arms: tuple[int, ...]
    """The numbers of arms."""
    tasks: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    """The cameras' names, in their order; empty for one camera of which the data do not say the name."""


def require_folder(option: str, folder: str) -> None:
    """Raises UserError for an empty name: it would mean the folder that the program is started in."""
    require(bool(folder.strip()), option, "the path of a folder", repr(folder))


def _names(words: tuple[str, ...]) -> list[str]:
    return [name for word in words for name in word.split(",") if name.strip()]
