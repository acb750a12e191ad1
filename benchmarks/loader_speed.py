"""The loaders: frames/s and memory against tf.data, flat memory over 20 passes, statistics in time (four minutes).

Needs the `tensorflow` extra, here or in another environment (``--peer-python /path/to/python``); ``--no-peer`` leaves
the comparison out. On one 256-pixel dataset both crop, vary colours, resize to 224 and batch; each runs in a process of
its own on the same cores, by turns. tf.data reads as octo does: parse with skipped decoding, flatten to frames, shuffle
encoded frames, decode in a parallel map. Our loader also writes prompts and answers. Asked for: 1.5 times the frames/s,
half the peak resident memory, no growth over 20 passes, of the demonstrations' loader too, and the statistics of 1,000
episodes of 50 steps (100 different ones, ten times over) in 10 seconds.

    python -m benchmarks.loader_speed [--episodes 60]
"""

import argparse
import io
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

NAME, STEPS, BATCH, SIZE, CROP = "libero_10_no_noops", 50, 32, 224, 0.9
SPEED, MEMORY, GROWTH, SECONDS = 1.5, 0.5, 1.05, 10.0
ROUNDS = 7


def write_data(folder: Path, episodes: int, copies: int = 1) -> None:
    """A build with photographs instead of the fixture's plain pictures: about 27 kB each.

    copies: how many times its shard is listed (as further links to one file).
    """
    from benchmarks.rlds_parity import photograph
    from data_pipelines.oxe.fixtures.fixture import episode_of, features_of
    from data_pipelines.oxe.fixtures.known_motion import known_episode
    from data_pipelines.oxe.fixtures.write import FIXTURES
    from data_pipelines.rlds.writing import encode_image, write_build

    rng = np.random.default_rng(0)
    pictures = [encode_image(photograph(rng, 256, 256)).getvalue() for _ in range(64)]
    fixture = FIXTURES[NAME]

    def episode(number: int) -> dict:
        made: dict = episode_of(fixture, known_episode(fixture.kind, 1, STEPS, number))
        for step in made["steps"]:
            for view in ("image", "wrist_image"):
                step["observation"][view] = io.BytesIO(pictures[rng.integers(64)])
        return made

    made = [episode(i) for i in range(episodes)]
    build = write_build(folder, NAME, features_of(fixture), {"train": made}, 4 if copies == 1 else 1)
    if copies > 1:
        (shard,) = build.glob("*.tfrecord-*")
        for number in range(copies):
            os.link(shard, build / f"{NAME}-train.tfrecord-{number:05d}-of-{copies:05d}")
        info = json.loads((build / "dataset_info.json").read_text())
        info["splits"][0]["shardLengths"] = [str(episodes)] * copies
        (build / "dataset_info.json").write_text(json.dumps(info))


def ours(folder: Path, frames: int, passes: int = 1) -> dict:
    """Frames/s of our loader, and its memory after each pass."""
    from data_pipelines.oxe.loader import OxeLoader
    from dsvla_jax.data_config import OxeConfig
    from dsvla_jax.encoding.config import EncodingConfig
    from dsvla_jax.suite_vocabulary import suite_tokenizer

    config = OxeConfig(folder=str(folder), mixture=(NAME,), image_size=SIZE, crop=CROP, streams=1)
    encoding = EncodingConfig(image_size=SIZE, style="compact", max_text_length=64, use_points=False)
    loader = OxeLoader(config, encoding, suite_tokenizer(), batch_size=BATCH, seed=0, progress=False)
    return measure((example.pictures.rgb for example in loader), frames, passes)


def demonstrations(folder: Path, frames: int, passes: int = 1) -> dict:
    """The same of the loader of demonstrations, with every variation that a config can ask for."""
    from data_pipelines.episodes import EpisodeReader
    from data_pipelines.loader import make_loader
    from data_pipelines.samples import make_sampler
    from dsvla_jax.data_config import DataConfig
    from dsvla_jax.encoding.config import EncodingConfig
    from dsvla_jax.suite_vocabulary import suite_tokenizer

    data = DataConfig(shift_world=0.05, crop=CROP, state_jitter=0.01, colour_variation=0.2)
    encoding = EncodingConfig(image_size=SIZE, style="compact", max_text_length=64)
    sample = make_sampler(data, encoding, suite_tokenizer())
    loader = make_loader(EpisodeReader(folder), sample, batch_size=BATCH, seed=0)
    return measure((example.pictures.rgb for example in loader), frames, passes)


def write_demonstrations(folder: Path, episodes: int, frames: int) -> None:
    """Demonstrations of one arm with pictures of noise."""
    from data_pipelines.episodes import write_episodes
    from data_pipelines.records import make_episode
    from dsvla_jax.types import Camera, Picture

    rng = np.random.default_rng(0)

    def episode(number: int):
        pose = np.concatenate(
            [rng.uniform(-0.3, 0.3, (frames, 1, 3)) + np.array([0, 0, 1]), np.zeros((frames, 1, 4))], axis=2
        )
        pose[..., 4] = 1.0
        camera = np.eye(4)
        camera[:3, :3], camera[:3, 3] = np.diag([1, -1, -1]), (0, 0, 2)
        return make_episode(
            task="lamp_on",
            instruction="turn on the light",
            seed=number,
            pictures=[
                Picture(
                    rng.integers(0, 256, (1, SIZE, SIZE, 3), np.uint8),
                    rng.uniform(0.5, 1.5, (1, SIZE, SIZE)),
                    Camera(np.array([[[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]]]), camera[None]),
                )
                for _ in range(frames)
            ],
            pose=pose,
            gripper_open=np.ones((frames, 1)),
            target_pose=pose,
            target_gripper=np.zeros((frames, 1)),
            keypoints=pose[:1, :, :3].swapaxes(0, 1),
            active_keypoint=pose[..., :3],
        )

    folder.mkdir()
    write_episodes(folder, map(episode, range(episodes)))


def tf_data(folder: Path, frames: int, passes: int = 1) -> dict:
    """Frames/s of tf.data."""
    import tensorflow as tf
    import tensorflow_datasets as tfds

    skip = tfds.decode.SkipDecoding()
    builder = tfds.builder_from_directory(str(folder / NAME / "0.1.0"))
    views = {"image": skip, "wrist_image": skip}
    episodes = builder.as_dataset(
        split="train",  # pyright: ignore[reportCallIssue]
        decoders={"steps": {"observation": views}},
        shuffle_files=True,
    )

    def picture(step):
        image = tf.io.decode_jpeg(step["observation"]["image"], channels=3)
        side = tf.cast(256 * tf.random.uniform([], CROP, 1.0), tf.int32)
        image = tf.image.resize(tf.image.random_crop(image, [side, side, 3]), [SIZE, SIZE])
        image = tf.image.random_brightness(image / 255.0, 0.2)
        image = tf.image.random_saturation(tf.image.random_contrast(image, 0.8, 1.2), 0.8, 1.2)
        image = tf.cast(tf.clip_by_value(image, 0, 1) * 255, tf.uint8)
        return {"rgb": image, "action": step["action"], "text": step["language_instruction"]}

    stream = episodes.repeat().flat_map(lambda episode: episode["steps"]).shuffle(2000)
    stream = stream.map(picture, num_parallel_calls=tf.data.AUTOTUNE).batch(BATCH).prefetch(tf.data.AUTOTUNE)
    return measure((batch["rgb"] for batch in stream.as_numpy_iterator()), frames, passes)


def measure(pictures: Iterator[np.ndarray], frames: int, passes: int) -> dict:
    """Frames/s over each of `passes` times `frames`, after a first batch, and the resident memory after each.

    work: milliseconds of processor time a frame, which says more than the clock where others use the machine.
    """
    assert next(pictures).shape == (BATCH, SIZE, SIZE, 3)
    speeds, memory = [], []
    worked = time.process_time()
    for _ in range(passes):
        start = time.perf_counter()
        for _ in range(frames // BATCH):
            next(pictures)
        speeds.append(frames // BATCH * BATCH / (time.perf_counter() - start))
        memory.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6)
    work = (time.process_time() - worked) / (passes * (frames // BATCH * BATCH))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"speed": float(np.median(speeds)), "work": 1e3 * work, "peak": peak, "memory": memory}


def statistics(folder: Path, *_: int) -> dict:
    """Seconds for the index and statistics of the whole build: by the clock, and of processor time.

    One thread does it all, so that processor time is the clock's on a machine that nobody else uses.
    """
    from data_pipelines.oxe.index import scan
    from data_pipelines.oxe.registry import get_dataset
    from data_pipelines.rlds.build import RldsBuild
    from dsvla_jax.data_config import OxeConfig

    build = RldsBuild(folder / NAME)
    start, worked = time.perf_counter(), time.process_time()
    index = scan(build, get_dataset(NAME), OxeConfig(), progress=False)
    took, worked = time.perf_counter() - start, time.process_time() - worked
    return {"seconds": took, "work": worked, "episodes": len(index.samples), "samples": index.num_samples}


def in_process(what: str, folder: Path, frames: int, passes: int = 1, python: str = sys.executable) -> dict:
    """Runs one measurement in a process of its own."""
    command = [python, "-m", "benchmarks.loader_speed", "--only", what, str(folder), str(frames), str(passes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{what} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compare(folder: Path, frames: int, peer_python: str) -> dict[str, tuple[float, float, str]]:
    """Prints what both loaders do by turns, and returns the ratios with what is asked of them."""
    rounds = [
        (in_process("ours", folder, frames), in_process("tf_data", folder, frames, python=peer_python))
        for _ in range(ROUNDS)
    ]
    ratios = [mine["speed"] / peer["speed"] for mine, peer in rounds]
    mine, peer = (
        {key: float(np.median([one[i][key] for one in rounds])) for key in ("speed", "work", "peak")} for i in (0, 1)
    )
    for name, one in (("ours", mine), ("tf.data", peer)):
        figures = f"{one['work']:.2f} ms of processor time a frame, peak {one['peak']:.0f} MB"
        print(f"{name}: {one['speed']:.0f} frames/s, {figures}")
    print(f"speed ratio of each round: {', '.join(f'{ratio:.2f}' for ratio in ratios)}")
    return {
        "speed": (float(np.median(ratios)), SPEED, "at least"),
        "peak memory": (mine["peak"] / peer["peak"], MEMORY, "at most"),
    }


def main() -> int:
    """Prints the figures; 0 where all that is asked for holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--peer-python", default=sys.executable, help="of an environment with TensorFlow")
    parser.add_argument("--no-peer", action="store_true", help="only what needs no TensorFlow")
    parser.add_argument("--only", nargs=4, metavar=("WHAT", "FOLDER", "FRAMES", "PASSES"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        what, folder, frames, passes = options.only
        measured = {"ours": ours, "tf_data": tf_data, "demonstrations": demonstrations, "statistics": statistics}[what]
        print(json.dumps(measured(Path(folder), int(frames), int(passes))))
        return 0
    results = {}
    with tempfile.TemporaryDirectory() as temporary:
        small, large, demos = (Path(temporary) / name for name in ("small", "large", "demos"))
        write_data(small, options.episodes)
        frames = options.episodes * (STEPS - 1)
        if not options.no_peer:
            results |= compare(small, frames, options.peer_python)
        write_demonstrations(demos, 20, 6)
        for what, folder, count in (("ours", small, frames), ("demonstrations", demos, 120)):
            memory = in_process(what, folder, count, 20)["memory"]
            print(f"{what}: resident memory after passes 1, 5, 10, 15, 20:", end=" ")
            print(", ".join(f"{memory[number - 1]:.0f}" for number in (1, 5, 10, 15, 20)), "MB")
            # Means of five, because one reading is worth a few per cent: where in a window of episodes it was taken.
            growth = float(np.mean(memory[15:]) / np.mean(memory[3:8]))
            results[f"memory of passes 16-20 to 4-8, {what}"] = (growth, GROWTH, "at most")
        write_data(large, 100, copies=10)
        told = in_process("statistics", large, 0)
        print(f"statistics of {told['episodes']} episodes, {told['samples']} samples: {told['seconds']:.1f} s", end=" ")
        print(f"by the clock, {told['work']:.1f} s of processor time")
        results["statistics, seconds of processor time"] = (told["work"], SECONDS, "at most")
    failed = 0
    for name, (value, limit, kind) in results.items():
        good = value >= limit if kind == "at least" else value <= limit
        failed |= not good
        print(f"{name}: {value:.2f} ({kind} {limit:g}): {'ok' if good else 'FAILED'}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
