"""Pretraining on Open X-Embodiment and finetuning in simulation, as docs/data_oxe.md tells it, on fixtures."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from configs import get_config
from dsvla_jax.encoding.displacement import displace
from dsvla_jax.policies.three_ds_vla import TextPolicy
from dsvla_jax.policy import load_policy, load_policy_config
from dsvla_jax.types import Camera, Observation, Picture, RobotState

ROOT = Path(__file__).parent.parent
DATASETS = ["nyu_rot_dataset_converted_externally_to_rlds", "utokyo_xarm_bimanual_converted_externally_to_rlds"]


def run(folder: Path, *arguments: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    result = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=1200
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


def losses(folder: Path) -> dict[int, float]:
    """By step; of a step written twice the later one."""
    return {line["step"]: line["loss"] for line in map(json.loads, (folder / "metrics.jsonl").open())}


def test_the_two_configs_share_one_base():
    pretraining, finetuning = get_config("tiny_oxe"), get_config("tiny_oxe_sim")
    assert finetuning.base == "runs/tiny_oxe"
    assert pretraining.oxe is not None
    assert finetuning.oxe is None
    assert pretraining.model.vision == finetuning.model.vision
    assert pretraining.model.language == finetuning.model.language
    assert not pretraining.encoding.use_points
    assert not pretraining.encoding.use_keypoints


@pytest.mark.slow
def test_the_documented_sequence(tmp_path: Path):
    small = ["--batch-size", "4", "--log-every", "1"]
    run(tmp_path, "-m", "data_pipelines.oxe", "fixtures", "data/oxe_fixtures", "--datasets", *DATASETS)
    pretrain = [str(ROOT / "train.py"), "tiny_oxe", "--oxe.mixture", *DATASETS, "--oxe.target", "relative", *small]
    pretrain += ["--steps", "4", "--checkpoint-every", "2"]
    run(tmp_path, *pretrain)
    folder = tmp_path / "runs" / "tiny_oxe"
    # Without its last checkpoint the run goes on from the one before, on the same samples.
    whole = losses(folder)
    shutil.rmtree(folder / "checkpoints" / "4")
    assert "resuming runs/tiny_oxe at step 2" in run(tmp_path, *pretrain)
    assert losses(folder)[4] == pytest.approx(whole[4], rel=1e-5)

    # The scale is in the policy and in every checkpoint, and the policy needs no dataset's name to use it.
    policy, scale = load_policy(folder), load_policy_config(folder).displacement
    assert scale is not None
    saved = json.loads((folder / "checkpoints" / "4" / "iterator" / "metadata").read_text())
    assert saved["scale"] == {"low": list(scale.low), "high": list(scale.high)}
    pose = np.array([[[0.3, -0.1, 1.1, 0, 1, 0, 0]]], np.float32)
    observation = Observation(
        Picture(
            jnp.zeros((1, 1, 96, 96, 3), jnp.uint8),
            jnp.zeros((1, 1, 1, 1)),
            Camera(jnp.eye(3)[None, None], jnp.eye(4)[None, None]),
        ),
        RobotState(jnp.asarray(pose), jnp.ones((1, 1))),
    )
    bare = TextPolicy(dataclasses.replace(policy.config, displacement=None), policy.variables, policy.tokenizer)
    told, answered = (one.decide(observation, ["lift the ball"], None).action for one in (policy, bare))
    np.testing.assert_allclose(
        told.pose, displace(pose, scale.from_pose(answered.pose, policy.config.encoding.codec)), atol=1e-6
    )
    assert np.all(np.abs(np.asarray(told.pose)[..., :3] - pose[..., :3]) < 0.5)

    finetune = [str(ROOT / "train.py"), "tiny_oxe_sim", "--data.tasks", "lamp_on", "--data.episodes", "4", *small]
    run(tmp_path, *finetune, "--steps", "2")
    assert "lamp_on" in run(
        tmp_path, str(ROOT / "eval.py"), "runs/tiny_oxe_sim", "--tasks", "lamp_on", "--episodes", "2"
    )
