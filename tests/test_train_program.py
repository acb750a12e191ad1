"""train.py as a process of its own: what a scheduler sees of it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

import eval as evaluation
from data_pipelines.episodes import EpisodeReader, write_episodes
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.encoding.pretrained_tokenizers import save_tokenizer
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.evaluation.demo import Options as DemoOptions
from dsvla_jax.evaluation.demo import main as demo
from dsvla_jax.evaluation.results import read_results
from dsvla_jax.experiment import load_experiment
from dsvla_jax.serving.__main__ import Options as ServingOptions
from dsvla_jax.serving.__main__ import build_server
from dsvla_jax.serving.requests import Expected, parse_request
from examples.robot_client import simulated_robot
from tests.random_data import random_episode
from tests.small import SMALL_RUN

ROOT = Path(__file__).parent.parent


def start(folder: Path, options: str, config: str = SMALL_RUN) -> subprocess.Popen[str]:
    """train.py in a folder, which gets what it says of errors and progress."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": "1"}
    with (folder / "errors").open("w") as errors:
        return subprocess.Popen(
            [sys.executable, str(ROOT / "train.py"), *config.split(), *options.split()],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )


def write_recordings(folder: Path) -> str:
    """Writes random recordings and their vocabulary; returns the options to learn from them."""
    episodes = [random_episode(seed, size=32) for seed in range(4)]
    write_episodes(folder / "data", episodes)
    tokenizer = WordTokenizer(vocabulary(episode.instruction for episode in episodes))
    (folder / "words").mkdir()
    save_tokenizer(tokenizer, folder / "words")
    return (
        "--data.source episodes --data.folder data --data.tasks all --tokenizer words "
        f"--model.language.vocab-size {tokenizer.vocab_size}"
    )


def lines_of(run: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def test_sigterm_saves_the_step_in_progress_and_ends_with_a_status_of_its_own(tmp_path: Path):
    data = write_recordings(tmp_path)
    with start(tmp_path, f"{data} --steps 1000000 --checkpoint-every 1000000 --profile 2") as process:
        assert process.stdout is not None
        printed = []
        for line in process.stdout:
            printed.append(line)
            if line.startswith("trace: "):
                process.send_signal(signal.SIGTERM)
        process.wait(timeout=300)
    run = tmp_path / "run"
    assert process.returncode == 75, (tmp_path / "errors").read_text()
    lines = lines_of(run)
    with contextlib.closing(RunCheckpoints(run, read_only=True)) as checkpoints:
        assert checkpoints.latest_step == lines[-1]["step"] == len(lines) >= 4
    assert f"SIGTERM: run is saved at step {len(lines)}; the same command goes on from there" in printed[-1]
    assert lines[-1]["model_tflops_per_second"] > 0
    assert "model_flops_utilisation" not in lines[-1], "nobody publishes the peak of a CPU"
    # The trace, for either of the viewers that its line names.
    assert (
        len(list((run / "profile").rglob("*.xplane.pb"))) == len(list((run / "profile").rglob("*.trace.json.gz"))) == 1
    )


@pytest.mark.slow
def test_a_run_in_simulation_is_validated_and_evaluated_on_seeds_of_their_own(tmp_path: Path):
    data = "--data.tasks lamp_on --data.episodes 4 --data.image-size 32 --validation.episodes 2"
    checks = "--steps 4 --validate-every 2 --evaluate-every 4 --evaluation.episodes-while-training 2"
    process = start(tmp_path, f"{data} {checks}")
    process.communicate(timeout=900)
    assert process.returncode == 0, (tmp_path / "errors").read_text()
    validated = {
        line["step"]: line["validation/position_cm"] for line in lines_of(tmp_path / "run") if "validation/loss" in line
    }
    assert list(validated) == [2, 4]
    last = lines_of(tmp_path / "run")[-1]
    assert last["evaluation/lamp_on"] == last["evaluation/success"] in (0, 0.5, 1)
    training, held_out = (EpisodeReader(tmp_path / "data" / name) for name in ("demos", "demos_validation"))
    assert (len(training), len(held_out)) == (4, 2)
    assert held_out.settings["split"] == "validation"
    pictures = {training.episode(number).rgb_png[0] for number in range(4)}
    assert not pictures & {held_out.episode(number).rgb_png[0] for number in range(2)}
    with contextlib.closing(RunCheckpoints(tmp_path / "run", read_only=True)) as checkpoints:
        assert checkpoints.best_step == 4, "a step that was evaluated comes first"


@pytest.mark.slow
def test_a_policy_of_two_cameras_from_demonstrations_to_evaluation_serving_and_demo(tmp_path: Path):
    data = "--data.tasks lamp_on --data.episodes 4 --data.image-size 32 --data.keypoints oracle --validation.episodes 2"
    checks = "--steps 4 --validate-every 4 --evaluate-every 4 --evaluation.episodes-while-training 2"
    two = " ".join(SMALL_RUN.split()).replace("tiny ", "tiny_two_cameras ", 1)
    process = start(tmp_path, f"{data} {checks}", two)
    process.communicate(timeout=900)
    run = tmp_path / "run"
    assert process.returncode == 0, (tmp_path / "errors").read_text()
    assert lines_of(run)[-1]["evaluation/success"] in (0, 0.5, 1)
    assert EpisodeReader(tmp_path / "data" / "demos_two_cameras").cameras == ("front", "wrist")
    experiment = load_experiment(run / "config.json")
    assert (experiment.data.cameras, experiment.model.cameras) == (("front", "wrist"), 2)
    evaluation.main(evaluation.Options(run, episodes=2))
    results = read_results(run / "eval")
    assert len(results) == 2
    strips = [cv2.imread(str(path)) for path in sorted((run / "eval" / "strips").rglob("*.png"))]
    assert [strip.shape[0] for strip in strips if strip is not None] == [64, 64]
    demo(DemoOptions(run))
    assert (run / "demo.html").is_file()
    metadata = build_server(ServingOptions(run)).metadata
    assert metadata["cameras"] == ["front", "wrist"]
    robot = simulated_robot(metadata, "lamp_on", 0)
    expected = Expected(((32, 32),), (1,), experiment.encoding, cameras=("front", "wrist"))
    assert parse_request({**robot.observe(), "prompt": robot.prompt}, expected).points
