"""How a fixture's features and values are written down, and one episode of it as the build stores it."""

import dataclasses
import io
import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from tensorflow_datasets.core import features as tfds_features

from data_pipelines.oxe.fixture_motion import Kind, KnownEpisode, StepOf
from data_pipelines.rlds.writing import encode_image

Values = dict[str, Any]
STEP = "is_first=b is_last=b is_terminal=b reward=f"
TOLD = f"{STEP} discount=f language_embedding=512 language_instruction=t"
NAMED = f"{STEP} observation/natural_language_embedding=512 observation/natural_language_instruction=s"


@dataclasses.dataclass(frozen=True)
class Fixture:
    """How one dataset's build looks.

    steps, episode: ``path=kind`` separated by spaces; see `feature_of`. values: (left or only arm, right arm) -> what a
    step holds, by path; further numbers are noise. episode_values: the same for the episode. bgr: names of the pictures
    that have red and blue exchanged.
    """

    steps: str
    values: Callable[[StepOf, StepOf], Values]
    kind: Kind = "full"
    arms: int = 1
    episode: str = "episode_metadata/file_path=t"
    episode_values: Callable[[], Values] = dict
    bgr: tuple[str, ...] = ()


def feature_of(kind: str) -> Any:
    """The feature of a kind.

    b, f, i, d, u: a bool, float32, int64, float64, uint8. 7, 4x4: float32 of that shape; i, l, d or u after it: int32,
    int64, float64, uint8; z before it: zlib-encoded. s: a string tensor, t: Text. J, P, D, F before HxW: a JPEG, a PNG,
    a 16-bit depth PNG, a float32 image.
    """
    if kind in ("s", "t"):
        return tfds_features.Text() if kind == "t" else tfds_features.Tensor(shape=(), dtype=np.object_)
    scalars = {"b": np.bool_, "f": np.float32, "i": np.int64, "d": np.float64, "u": np.uint8}
    if kind in scalars:
        return tfds_features.Scalar(dtype=scalars[kind])
    match = re.fullmatch(r"([JPDFz]?)([0-9x]+)([idul]?)", kind)
    if match is None:
        raise ValueError(f"feature kind: got {kind!r}; see feature_of")
    shape = tuple(int(size) for size in match[2].split("x"))
    if match[1] in ("J", "P"):
        return tfds_features.Image(shape=(*shape, 3), encoding_format="jpeg" if match[1] == "J" else "png")
    if match[1] in ("D", "F"):
        dtype = np.uint16 if match[1] == "D" else np.float32
        return tfds_features.Image(shape=(*shape, 1), dtype=dtype, encoding_format="png")
    dtype = {"": np.float32, "i": np.int32, "d": np.float64, "u": np.uint8, "l": np.int64}[match[3]]
    return tfds_features.Tensor(shape=shape, dtype=dtype, encoding="zlib" if match[1] == "z" else "none")


def _split(spec: str) -> dict[str, str]:
    return dict(entry.split("=") for entry in spec.split())


def _nested(flat: Values) -> Values:
    """By the part before the first slash: a name such as present/xyz keeps its own."""
    nested: Values = {}
    for path, value in flat.items():
        group, _, name = path.partition("/")
        if name:
            nested.setdefault(group, {})[name] = value
        else:
            nested[group] = value
    return nested


def _dict(flat: Values) -> Any:
    nested = _nested(flat)
    return {name: tfds_features.FeaturesDict(v) if isinstance(v, dict) else v for name, v in nested.items()}


def features_of(fixture: Fixture) -> Any:
    """The tfds features of a build."""
    steps = _dict({path: feature_of(kind) for path, kind in _split(fixture.steps).items()})
    episode = _dict({path: feature_of(kind) for path, kind in _split(fixture.episode).items()})
    return tfds_features.FeaturesDict({**episode, "steps": tfds_features.Dataset(steps)})


def episode_of(fixture: Fixture, known: KnownEpisode) -> Values:
    """One episode as the build stores it."""
    rng = np.random.default_rng([known.seed, 7])
    spec = _split(fixture.steps)

    def step(place: int) -> Values:
        arms = [StepOf(arm, place, rng) for arm in known.arms]
        written = {**_common(known, place), **fixture.values(arms[0], arms[-1])}
        colour = known.colour(place)
        red, green, blue = colour
        colours = {f"observation/{name}": (blue, green, red) for name in fixture.bgr}
        return _nested(
            {path: _value(kind, written.get(path), colours.get(path, colour), rng) for path, kind in spec.items()}
        )

    told = fixture.episode_values()
    episode = {path: _value(kind, told.get(path), (0, 0, 0), rng) for path, kind in _split(fixture.episode).items()}
    return {**_nested(episode), "steps": [step(place) for place in range(known.num_steps)]}


def _common(known: KnownEpisode, place: int) -> Values:
    points = np.zeros(512, np.int32)
    points[: len(known.instruction)] = list(known.instruction.encode())
    return {
        "is_first": place == 0,
        "is_last": place == known.num_steps - 1,
        "is_terminal": place == known.num_steps - 1,
        "language_instruction": known.instruction,
        "observation/natural_language_instruction": known.instruction,
        "observation/instruction": points,
    }


def _value(kind: str, value: Any, colour: tuple[int, int, int], rng: np.random.Generator) -> Any:
    """A value as its feature takes it; noise where there is none."""
    if kind in ("s", "t"):
        return value or "unused"
    if kind[0] in "JPDF":
        return _picture(kind, colour if value is None else value)
    if kind in ("b", "f", "i", "d", "u"):
        dtype = {"b": np.bool_, "f": np.float32, "i": np.int64, "d": np.float64, "u": np.uint8}[kind]
        return dtype(rng.integers(0, 2) if value is None else np.asarray(value).reshape(()))
    shape = tuple(int(size) for size in re.findall(r"\d+", kind))
    dtype = {"i": np.int32, "d": np.float64, "u": np.uint8, "l": np.int64}.get(kind[-1], np.float32)
    if value is None:
        value = rng.normal(3.0, 1.0, shape) if shape != (512,) else np.zeros(512)
    array = np.asarray(value, np.float64).reshape(shape)
    return (array if np.dtype(dtype).kind == "f" else np.clip(np.rint(array), 0, None)).astype(dtype)


@cache
def _encoded(kind: str, colour: Any) -> bytes:
    height, width = (int(size) for size in kind[1:].split("x"))
    if kind[0] in "JP":
        picture = np.full((height, width, 3), colour, np.uint8)
        return encode_image(picture, ".jpg" if kind[0] == "J" else ".png").getvalue()
    if kind[0] == "D":
        return encode_image(np.full((height, width, 1), colour, np.uint16), ".png").getvalue()
    stored = np.full((height, width, 1), colour, np.float32).view(np.uint8)
    return encode_image(np.ascontiguousarray(stored[..., [2, 1, 0, 3]]), ".png").getvalue()


def _picture(kind: str, colour: Any) -> Any:
    if kind[0] in "DF" and isinstance(colour, tuple):
        colour = 1000
    return io.BytesIO(_encoded(kind, colour))
