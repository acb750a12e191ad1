"""The configs of Table 3's rows: each trains, and each differs from the next in exactly what its row says."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import configs
from configs import config_names, get_config
from data_pipelines.episodes import Frame
from data_pipelines.samples import make_sampler
from dsvla_jax.encoding.encode import build_prompt, encode_text, model_inputs
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.model.variables import split_variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.sim.tasks import TASKS
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.state import make_optimizer, start_state
from dsvla_jax.types import Action, Example, Picture, RobotState
from tests.learning import step_of

# row: (3D spatial constraint, 3D tokens, aligned positional embeddings)
ROWS = {
    "tiny_image_only": (False, False, False),
    "tiny_constraint": (True, False, False),
    "tiny_index_order": (True, True, False),
    "tiny": (True, True, True),
}


def frame(arms: int, cameras: int, rng: np.random.Generator) -> Frame:
    down = np.array([0, 1, 0, 0], np.float32)

    def pose() -> np.ndarray:
        return np.concatenate([rng.uniform([0, -0.3, 0.8], [0.4, 0.3, 1.2], (arms, 3)), [down] * arms], 1)

    return Frame(
        pictures=Picture(
            rng.integers(0, 255, (cameras, 96, 96, 3), np.uint8),
            rng.uniform(1.0, 1.3, (cameras, 96, 96)).astype(np.float32),
            jax.tree.map(lambda x: np.stack([np.asarray(x)] * cameras), front_camera(96)),
        ),
        robot=RobotState(pose().astype(np.float32), np.ones(arms, np.float32)),
        keypoint=pose()[:, :3].astype(np.float32),
        target=Action(pose().astype(np.float32), np.zeros(arms, np.float32)),
        instruction="turn on the light",
        task="lamp_on",
        task_index=0,
        episode=0,
        frame=0,
    )


def small(name: str) -> Experiment:
    experiment = get_config(name)
    model = replace(
        experiment.model,
        vision=replace(experiment.model.vision, layers=1),
        language=replace(experiment.model.language, layers=1),
        scan_unroll=1,
    )
    return replace(experiment, model=model, batch_size=4, steps=8)


def batch_of(experiment: Experiment) -> Example[np.ndarray]:
    sample = make_sampler(experiment.data, experiment.encoding, suite_tokenizer())
    samples = [
        sample(frame(1 + i % 2, experiment.model.cameras, np.random.default_rng(i)), np.random.default_rng(i))
        for i in range(4)
    ]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *samples)


@pytest.mark.parametrize("name", [*ROWS, "tiny_two_cameras"])
def test_row_trains(name: str):
    experiment = small(name)
    batch = batch_of(experiment)
    values = suite_tokenizer().number_values
    trainable, frozen = split_variables(initialize(experiment.model, jax.random.key(0), values), experiment.regime)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    state = start_state(trainable, optimizer, experiment.seed)
    targets = number_rows(suite_tokenizer(), experiment.encoding.style).targets(experiment.soft_target_sigma)
    step = jax.jit(step_of(experiment, optimizer, targets))
    losses = []
    for _ in range(experiment.steps):
        state, metrics = step(state, frozen, batch)
        losses.append(float(metrics["loss"]))
    assert np.isfinite(losses).all()
    assert losses[-1] < losses[0]


@pytest.mark.parametrize(("name", "row"), ROWS.items())
def test_row_is_what_the_table_says(name: str, row: tuple[bool, bool, bool]):
    constraint, points, aligned = row
    experiment = get_config(name)
    batch = batch_of(experiment)
    near = suite_tokenizer().encode("near")[0]
    assert (batch.text.tokens == near).any(axis=1).all() == constraint
    example = jax.tree.map(jnp.asarray, batch)
    inputs = model_inputs(example.pictures, example.text, experiment.encoding)
    tokens = inputs.point_tokens.shape[1]
    assert tokens == (experiment.model.vision.num_patches if points else 0)
    in_order = (np.asarray(inputs.point_patches) == np.arange(tokens)).all()
    assert in_order != (points and aligned)


def test_without_images_all_pictures_are_alike():
    experiment = get_config("tiny")
    example = jax.tree.map(jnp.asarray, batch_of(experiment))

    def images(use_images: bool) -> np.ndarray:
        encoding = replace(experiment.encoding, use_images=use_images)
        return np.asarray(model_inputs(example.pictures, example.text, encoding).images)

    assert np.ptp(images(True), axis=0).max() > 1
    assert np.ptp(images(False)) == 0


def test_every_config_loads_and_a_typo_names_the_nearest():
    for name in config_names():
        assert isinstance(get_config(name), Experiment)
    with pytest.raises(UserError, match="unknown config 'tiny_lore': did you mean 'tiny_lora'"):
        get_config("tiny_lore")


OWN = """
import dataclasses

from configs.tiny import config as tiny


@dataclasses.dataclass(frozen=True)
class Settings:
    steps: int = 3


def config():
    return dataclasses.replace(tiny(), steps=Settings().steps)
"""


def test_a_config_is_a_name_or_the_path_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "mine" / "own.py"
    file.parent.mkdir()
    file.write_text(OWN)
    expected = replace(get_config("tiny"), steps=3)
    assert get_config("mine/own.py") == get_config(str(file)) == expected
    assert get_config("configs/tiny.py") == get_config(str(Path(configs.__file__).with_name("tiny.py")))
    # A file of that name in the working directory is meant, not the project's.
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "tiny.py").write_text(OWN)
    assert get_config("configs/tiny.py") == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "unknown config 'own.py': no such file; expected the path of a Python file with a function config"),
        ("steps = 3", "own.py: no function config() in this file"),
        ("def config():\n    return 3", "own.py: config() must return an Experiment, got int"),
    ],
)
def test_a_file_without_an_experiment_is_refused(
    content: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / "own.py").write_text(content)
    with pytest.raises(UserError, match=re.escape(message)):
        get_config("own.py")


def test_every_instruction_of_the_suite_fits_the_tiny_text():
    encoding, tokenizer = get_config("tiny").encoding, suite_tokenizer()
    for task in TASKS.values():
        pose = np.tile(np.array([0.2, 0.1, 0.9, 0, 1, 0, 0], np.float32), (task.num_arms, 1))
        robot = RobotState(pose, np.ones(task.num_arms, np.float32))
        keypoint = np.zeros((task.num_arms, 3), np.float32)
        answer = format_answer(np.asarray(encoding.codec.encode(pose, robot.gripper_open)), encoding.style)
        for text in task.all_instructions():
            prompt = build_prompt(encoding, text, robot, keypoint)
            encode_text(tokenizer, prompt, answer, encoding.max_text_length)
