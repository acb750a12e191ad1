"""Settings that cannot be meant: each is refused in one message that names the option, before anything is written."""

import contextlib
import dataclasses
import functools
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

import train
from configs import config_names, get_config
from data_pipelines.preparation import prepare
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, MeshConfig, OptimizerConfig, load_experiment, save_experiment
from dsvla_jax.model.config import LoraConfig, RopeScaling, VisionConfig
from dsvla_jax.planner.preflight import check_step
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policy import load_policy_config, save_policy_config
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.distributed import Watchdog
from dsvla_jax.training.run_folder import require_same_experiment, run_folder
from dsvla_jax.training.sharding import make_mesh
from tests.odd_settings import OddSetting, baseline_experiments, odd_settings, toy_experiment


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    return toy_experiment(tmp_path_factory.mktemp("toy"))


def test_every_field_of_every_config_takes_an_odd_value_or_says_why_not(toy: Experiment, tmp_path: Path):
    """benchmarks/odd_settings.py trains two steps with each value that passes here."""
    asked, oxe = 0, dataclasses.replace(toy, oxe=OxeConfig(image_size=32), validate_every=0)
    assert len({odd.name for odd in odd_settings(oxe)}) > 115
    baselines = [(experiment, "baseline.") for experiment in baseline_experiments(toy)]
    for experiment, section in [(toy, ""), (oxe, ""), *baselines]:
        for odd in (odd for odd in odd_settings(experiment) if odd.name.startswith(section)):
            asked += 1
            # All else than a UserError would be a traceback.
            with contextlib.suppress(UserError):
                prepare(odd.apply(experiment), tmp_path / "run")
    assert asked > 1000
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_no_size_or_rate_is_zero_negative_or_not_a_number(toy: Experiment, value: float):
    for name in (
        "batch_size",
        "steps",
        "model.scan_unroll",
        "model.vision.heads",
        "optimizer.learning_rate",
        "data.crop",
    ):
        with pytest.raises(UserError, match=f"^{name}: expected "):
            OddSetting(name, value).apply(toy)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("encoding.patch_size", 8, "encoding.patch_size is 8 and model.vision.patch_size is 16: 3D tokens would carry"),
        ("encoding.image_size", 64, "encoding.image_size is 64 and model.vision.image_size is 32"),
        ("encoding.points.width", 64, "encoding.points.width is 64 and model.vision.width is 32"),
        ("encoding.codec.bins", 2000, "encoding.codec.bins: expected positions that count from -100 to 200"),
        ("encoding.workspace_low", (2.0, 2.0, 4.0), "encoding.workspace_low: expected less than workspace_high"),
        ("encoding.workspace_high", (1.5, 1.5, math.nan), "encoding.workspace_high: expected a finite number"),
        ("encoding.stride", 20, r"num_points: expected at most the 4 points of a picture of .*stride 20, got 32"),
        ("encoding.max_text_length", 20, "tokens are more than max_text_length 20"),
        ("model.language.vocab_size", 40, "model.language.vocab_size is 40; they must be of one language model"),
        ("optimizer.warmup_steps", 60, r"optimizer.warmup_steps: expected at most steps \(2\), got 60"),
        ("base", "nowhere", "nowhere: no run here"),
        ("model.language.explicit_head_dim", 10**6, "expected at least 1, at most 8192, got 1000000"),
        ("model.attention", "cudnn", "model.dtype: expected bfloat16 with attention 'cudnn', got float32"),
        ("data.source", "simulator", "tokenizer: it lacks"),
        ("evaluate_every", 2, r"tokenizer: it lacks .*, which the simulator gives; .*--evaluate-every 0\)"),
    ],
)
def test_settings_that_contradict_one_another_name_both(toy: Experiment, name: str, value, message, tmp_path: Path):
    with pytest.raises(UserError, match=message):
        prepare(OddSetting(name, value).apply(toy), tmp_path / "run")


@pytest.mark.parametrize(
    "changes",
    [
        {"log_every": 0, "checkpoint_every": 0, "max_skipped_steps": 0},
        {"model.language.vocab_size": 354, "encoding.use_points": False, "model.scan_unroll": 10**6},
    ],
)
def test_odd_but_possible_settings_train(toy: Experiment, changes: dict[str, Any], tmp_path: Path):
    experiment = functools.reduce(lambda one, change: OddSetting(*change).apply(one), changes.items(), toy)
    assert train.main(experiment, tmp_path / "run", Watchdog(tmp_path / "processes")) == 0
    with contextlib.closing(RunCheckpoints(tmp_path / "run", read_only=True)) as checkpoints:
        assert checkpoints.latest_step == 2, "the last step is saved, whatever checkpoint_every says"
    last = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 2
    assert math.isfinite(last["loss"])


def test_a_kernel_that_this_machine_lacks_is_refused(toy: Experiment, tmp_path: Path):
    model = dataclasses.replace(toy.model, dtype="bfloat16", attention="cudnn")
    with pytest.raises(UserError, match=r"model.attention: 'cudnn' is a kernel of NVIDIA's GPUs, and JAX has cpu here"):
        prepare(dataclasses.replace(toy, model=model), tmp_path / "run")


def test_index_order_has_a_patch_for_every_token(toy: Experiment):
    encoding = dataclasses.replace(toy.encoding, alignment="index_order")
    points = dataclasses.replace(encoding.points, group_sizes=(16, 5), num_points=32)
    with pytest.raises(UserError, match="at most 4 tokens at the end with alignment index_order, one a patch, got 5"):
        dataclasses.replace(toy, encoding=dataclasses.replace(encoding, points=points))


@pytest.mark.parametrize("changes", [{"horizon": 1e30}, {"streams": 10**6}])
def test_no_oxe_setting_is_beyond_what_a_mixture_can_have(changes: dict[str, Any]):
    with pytest.raises(UserError, match=r"oxe\.(horizon|streams): expected at least \d, at most \d+"):
        OxeConfig(**changes)


def test_oxe_pictures_must_have_the_points_of_the_tokenizer(toy: Experiment, tmp_path: Path):
    experiment = dataclasses.replace(toy, oxe=OxeConfig(image_size=8), validate_every=0)
    with pytest.raises(UserError, match=r"expected at most the 16 points of a picture of oxe.image_size of 8 x 8"):
        prepare(experiment, tmp_path / "run")


def test_what_no_machine_can_hold_is_refused_before_it_is_allocated(toy: Experiment):
    mesh = make_mesh(MeshConfig(), jax.devices()[:1])
    for name, message in (
        ("model.language.ffn", r"parameters, gradient and optimizer take [\d,.]+ GiB of each device"),
        ("batch_size", r"batch_size: an array of shape .* takes [\d,.]+ GiB of each device"),
    ):
        with pytest.raises(UserError, match=message):
            check_step(OddSetting(name, 2**31 - 1).apply(toy), mesh, (32, 32))


def test_the_memory_of_processors_is_what_the_process_is_allowed():
    show = "from dsvla_jax.planner.preflight import device_memory; print(device_memory())"
    command = f"ulimit -v {6 * 2**20}; exec {sys.executable} -c '{show}'"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "2"}
    printed = subprocess.run(["bash", "-c", command], env=environment, capture_output=True, text=True, check=True)
    assert float(printed.stdout) == 3 * 2**30


def test_zero_means_never_for_all_that_is_done_every_so_many_steps(toy: Experiment):
    for name in ("log_every", "validate_every", "evaluate_every", "checkpoint_every"):
        OddSetting(name, 0).apply(toy)
        with pytest.raises(UserError, match=f"^{name}: expected at least 0, got -1"):
            OddSetting(name, -1).apply(toy)


def test_unlimited_gradients_and_short_runs_stay_possible(toy: Experiment, tmp_path: Path):
    optimizer = OptimizerConfig(gradient_clip=math.inf)
    assert optimizer.warmup_steps > toy.steps
    prepare(dataclasses.replace(toy, optimizer=optimizer), tmp_path / "run")


def test_a_policy_of_contradicting_sizes_does_not_load(toy: Experiment, tmp_path: Path):
    save_policy_config(tmp_path, PolicyConfig(toy.encoding, toy.model), suite_tokenizer())
    stored = json.loads((tmp_path / "policy.json").read_text())
    stored["encoding"]["patch_size"] = 8
    (tmp_path / "policy.json").write_text(json.dumps(stored))
    with pytest.raises(
        CheckpointError, match=r"policy.json: .*encoding.patch_size is 8 and model.vision.patch_size is 16"
    ):
        load_policy_config(tmp_path)


def test_experiments_survive_their_file_and_a_wrong_one_says_what_is_wrong(toy: Experiment, tmp_path: Path):
    for experiment in (toy, *map(get_config, config_names())):
        save_experiment(tmp_path / "config.json", experiment)
        assert load_experiment(tmp_path / "config.json") == experiment
    stored = json.loads((tmp_path / "config.json").read_text())
    stored["data"]["crop"] = 2
    (tmp_path / "config.json").write_text(json.dumps(stored))
    with pytest.raises(UserError, match=r"config.json: .*data.crop: expected more than 0, at most 1, got 2"):
        load_experiment(tmp_path / "config.json")


def test_a_run_without_a_checkpoint_may_start_again_with_another_config(toy: Experiment, tmp_path: Path):
    save_experiment(tmp_path / "config.json", toy)
    corrected = dataclasses.replace(toy, batch_size=4)
    require_same_experiment(tmp_path, corrected)
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="started with another config"):
        require_same_experiment(tmp_path, corrected)


def test_a_run_that_fails_before_its_config_is_written_leaves_no_folder(tmp_path: Path):
    def fail_after(name: str) -> bool:
        with contextlib.suppress(UserError), run_folder(tmp_path / "run"):
            (tmp_path / "run" / name).touch()
            raise UserError("damaged")
        return (tmp_path / "run").exists()

    assert not fail_after("metrics.jsonl")
    assert fail_after("config.json")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DataConfig(tasks=()), "data.tasks: expected names of tasks"),
        (lambda: DataConfig(folder=" "), "data.folder: expected the path of a folder, got ' '"),
        (lambda: DataConfig(keypoints="none"), "data.keypoints: expected one of segmentation, oracle, got 'none'"),  # type: ignore
        (lambda: OxeConfig(mixture=("",)), "oxe.mixture: expected a named mixture"),
        (lambda: MeshConfig(fsdp=0), "mesh: expected positive sizes"),
        (lambda: PoseCodec(low=(0.0, 0.0)), r"encoding.codec.low: expected 3 numbers, got \(0.0, 0.0\)"),  # type: ignore
        (lambda: PoseCodec(low=(0.0, 0.0, 3.0)), "encoding.codec.low: expected less than high"),
        (lambda: LoraConfig(targets=()), "model.lora.targets: expected some of q, k, v"),
        (lambda: RopeScaling(factor=-1), "model.language.rope_scaling.factor: expected more than 0, got -1"),
        (lambda: VisionConfig(width=1.5), "model.vision.width: expected a whole number, got 1.5"),  # type: ignore
    ],
)
def test_a_config_alone_refuses_what_it_cannot_mean(make, message: str):
    with pytest.raises(UserError, match=message):
        make()
