"""The TensorFlow-free RLDS reader against TensorFlow's reading of the same files, bit for bit (half a minute).

Needs the `tensorflow` extra. Two writers (ours, and TensorFlow's own encoders and record writer) make builds with
nested steps, JPEG, PNG, 16-bit depth, float images, zlib and raw tensors, strings, empty episodes and several shards.
Everything but JPEG has to be equal to the bit; JPEG, decoded by TensorFlow with its accurate DCT, within 2 grey levels.
TensorFlow's default is a faster, rougher DCT: how far it is from TensorFlow's accurate one is printed beside.

    python -m benchmarks.rlds_parity
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.writing import encode_image, write_build
from dsvla_jax.errors import UserError

MAX_JPEG_DIFFERENCE = 2
STEPS = (5, 0, 1, 12, 3)


def feature_spec() -> Any:
    """Every kind of feature that Open X-Embodiment builds hold."""
    from tensorflow_datasets.core import features as f

    observation = {
        "image": f.Image(shape=(256, 320, 3), encoding_format="jpeg"),
        "any_size": f.Image(shape=(None, None, 3), encoding_format="jpeg"),
        "wrist": f.Image(shape=(64, 80, 3), encoding_format="png"),
        "depth": f.Image(shape=(64, 80, 1), dtype=np.uint16, encoding_format="png"),
        "metres": f.Image(shape=(64, 80, 1), dtype=np.float32, encoding_format="png"),
        "state": f.Tensor(shape=(7,), dtype=np.float32),
        "zlib": f.Tensor(shape=(2, 3), dtype=np.float32, encoding="zlib"),
        "bytes": f.Tensor(shape=(4,), dtype=np.int64, encoding="bytes"),
        "double": f.Tensor(shape=(2,), dtype=np.float64),
        "natural_language_instruction": f.Tensor(shape=(), dtype=np.object_),
    }
    return f.FeaturesDict(
        {
            "steps": f.Dataset(
                {
                    "observation": f.FeaturesDict(observation),
                    "action": f.FeaturesDict(
                        {"world_vector": f.Tensor(shape=(3,), dtype=np.float32), "open": f.Scalar(dtype=np.bool_)}
                    ),
                    "code": f.Tensor(shape=(512,), dtype=np.int32),
                    "byte": f.Scalar(dtype=np.uint8),
                    "language_instruction": f.Text(),
                }
            ),
            "episode_metadata": f.FeaturesDict(
                {"file_path": f.Text(), "camera": f.Tensor(shape=(4, 4), dtype=np.float32)}
            ),
        }
    )


def photograph(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """uint8 (H, W, 3): smooth patches, edges and a little noise, so that JPEG has work to do."""
    import cv2

    picture = cv2.resize(rng.integers(0, 256, (9, 11, 3), np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    low = rng.integers(0, min(height, width) // 2, 2)
    picture[low[0] : low[0] + 20, low[1] : low[1] + 30] = rng.integers(0, 256, 3)
    return np.clip(picture + rng.normal(0, 4, picture.shape), 0, 255).astype(np.uint8)


def make_episode(number: int, steps: int, encode: bool) -> Any:
    """One episode; encode: images as encoded files (no TensorFlow needed), else as arrays."""
    rng = np.random.default_rng(number)

    def picture(array: np.ndarray, extension: str) -> Any:
        return encode_image(array, extension) if encode else array

    def step(place: int) -> dict[str, Any]:
        metres = rng.random((64, 80, 1), np.float32)
        return {
            "observation": {
                "image": picture(photograph(rng, 256, 320), ".jpg"),
                "any_size": picture(photograph(rng, 90 + place, 121), ".jpg"),
                "wrist": picture(photograph(rng, 64, 80), ".png"),
                "depth": picture(rng.integers(0, 65536, (64, 80, 1), np.uint16), ".png"),
                "metres": picture(metres.view(np.uint8)[..., [2, 1, 0, 3]], ".png") if encode else metres,
                "state": rng.normal(size=7).astype(np.float32),
                "zlib": rng.normal(size=(2, 3)).astype(np.float32),
                "bytes": rng.integers(-(2**62), 2**62, 4),
                "double": rng.normal(size=2),
                "natural_language_instruction": f"schließe die Tür {place}",
            },
            "action": {"world_vector": rng.normal(size=3).astype(np.float32), "open": bool(place % 2)},
            "code": rng.integers(0, 2**31 - 1, 512).astype(np.int32),
            "byte": np.uint8(place),
            "language_instruction": "" if place == 0 else f"pick up {place}",
        }

    camera = rng.normal(size=(4, 4)).astype(np.float32)
    return {"steps": [step(i) for i in range(steps)], "episode_metadata": {"file_path": str(number), "camera": camera}}


def write_with_tensorflow(folder: Path, features: Any) -> Path:
    """The same layout as ours, but images, examples and records written by TensorFlow."""
    import tensorflow as tf

    build = write_build(folder, "by_tensorflow", features, {"train": []}, shards=2)
    episodes = [make_episode(number, steps, encode=False) for number, steps in enumerate(STEPS)]
    lengths = []
    for number, run in enumerate(np.array_split(np.arange(len(episodes)), 2)):
        path = build / f"by_tensorflow-train.tfrecord-{number:05d}-of-00002"
        with tf.io.TFRecordWriter(str(path)) as writer:
            for i in run:
                writer.write(features.serialize_example(episodes[i]))
        lengths.append(f'"{len(run)}"')
    info = build / "dataset_info.json"
    info.write_text(info.read_text().replace('"0",\n    "0"', ", ".join(lengths)))
    return build


def compare(build: Path, dct: str) -> tuple[int, int]:
    """(values compared, largest difference of a decoded JPEG in grey levels); raises UserError where a value differs.

    dct: TensorFlow's, INTEGER_ACCURATE or INTEGER_FAST.
    """
    import tensorflow as tf
    import tensorflow_datasets as tfds

    @tfds.decode.make_decoder()
    def jpeg(example: Any, feature: Any) -> Any:
        del feature
        return tf.io.decode_jpeg(example, channels=3, dct_method=dct)

    decoders = {"steps": {"observation": {"image": jpeg(), "any_size": jpeg()}}}  # pyright: ignore[reportCallIssue]
    builder: Any = tfds.builder_from_directory(str(build))
    oracle = builder.as_dataset(split="train", shuffle_files=False, decoders=decoders)
    ours = RldsBuild(build)
    records = [
        ours.parse(file.read(i), f"{shard.path}, record {i}")
        for shard in ours.shards("train")
        for file in [ours.open_shard(shard)]
        for i in range(len(file))
    ]
    # Shards are read one after the other only by one reader.
    expected = sorted(tfds.as_numpy(oracle), key=lambda episode: int(episode["episode_metadata"]["file_path"]))
    if len(expected) != len(records):
        raise UserError(f"{build}: TensorFlow reads {len(expected)} episodes, we read {len(records)}")
    compared = worst = 0
    for episode, record in zip(expected, records, strict=True):
        steps = list(episode.pop("steps"))
        if len(steps) != record.num_steps:
            raise UserError(f"{record.where}: TensorFlow reads {len(steps)} steps, we read {record.num_steps}")
        for path, value in flatten(episode):
            worst = max(worst, difference(record, path, value, None))
            compared += 1
        for place, step in enumerate(steps):
            for path, value in flatten(step):
                worst = max(worst, difference(record, f"steps/{path}", value, place))
                compared += 1
    return compared, worst


def flatten(tree: Any, path: str = "") -> list[tuple[str, Any]]:
    """(path, leaf) of nested dicts."""
    if not isinstance(tree, dict):
        return [(path, tree)]
    return [item for name, child in tree.items() for item in flatten(child, f"{path}/{name}" if path else name)]


def difference(record: Any, path: str, expected: Any, step: int | None) -> int:
    """Grey levels by which a JPEG differs; 0 for all else, which has to be equal (else UserError)."""
    where = f"{record.where}, step {step}, {path}"
    if isinstance(expected, bytes):
        got: Any = record.text(path)[step or 0].encode()
        equal = got == expected
    elif path.endswith(("image", "any_size", "wrist", "depth", "metres")):
        got = record.image(path, step)
        if path.endswith(("/image", "/any_size")) and got.shape == expected.shape:
            return int(np.abs(got.astype(int) - expected).max())
        equal = got.dtype == expected.dtype and np.array_equal(got, expected)
    else:
        column = record.column(path)
        got, expected = (column if step is None else column[step]), np.asarray(expected)
        equal = got.dtype == expected.dtype and got.tobytes() == expected.tobytes()
    if not equal:
        raise UserError(f"{where}: TensorFlow reads {str(expected)[:80]}, we read {str(got)[:80]}")
    return 0


def main() -> int:
    """Prints what was compared; 0 where all of it agrees."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    try:
        import tensorflow  # noqa: F401
    except ImportError:
        print("error: TensorFlow is missing: pip install tensorflow-cpu", file=sys.stderr)
        return 1
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        features = feature_spec()
        episodes = [make_episode(number, steps, encode=True) for number, steps in enumerate(STEPS)]
        builds = {
            "written by us": write_build(Path(folder), "ours", features, {"train": episodes}),
            "written by TensorFlow": write_with_tensorflow(Path(folder), features),
        }
        for name, build in builds.items():
            try:
                compared, worst = compare(build, "INTEGER_ACCURATE")
                rough = compare(build, "INTEGER_FAST")[1]
            except UserError as error:
                print(f"{name}: FAILED: {error}")
                failed = 1
                continue
            print(f"{name}: {compared} values equal; decoded JPEG differs by at most {worst} grey levels", end=" ")
            print(f"(from TensorFlow's fast DCT: {rough})")
            failed |= worst > MAX_JPEG_DIFFERENCE
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
