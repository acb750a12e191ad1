"""Writes run folders with random weights, as train.py leaves them, without training.

``python -m tests.run_folders FOLDER`` writes a run for each of `MESHES`, with all devices of its process.
"""

import sys
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dsvla_jax.checkpoints.run import Arrays, Notes, RunCheckpoints
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.experiment import MeshConfig
from dsvla_jax.model.config import LoraConfig, ModelConfig
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.variables import Regime, split_variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policy import save_policy_config
from dsvla_jax.training.sharding import make_mesh
from tests.small import small_language, small_vision

TOKENIZER = WordTokenizer(vocabulary(["close the box", "stack 2 red blocks"]))
MODEL = ModelConfig(small_vision(), small_language(TOKENIZER.vocab_size), lora=LoraConfig(rank=2))
NO_NOTES = Notes(iterator={}, config={})
MESHES = {"data": MeshConfig(-1, 1, 1), "fsdp": MeshConfig(1, -1, 1)}


def variables_only(trainable: Any) -> Arrays:
    """What a step holds for those who read variables only: the rest is as small as it can be."""
    one = jax.numpy.zeros(1, np.int32)
    return Arrays(trainable, optimizer={"count": one}, counters={"step": one}, rng={"key": one})


def write_run(
    run: Path, model: ModelConfig, regime: Regime = "lora", mesh: jax.sharding.Mesh | None = None
) -> dict[str, Any]:
    """Writes a run of ``model``, split over ``mesh`` if given, and returns its variables: no zeros, no ones, adapters
    that do something.

    Values are drawn from the variables' names, so runs with and without adapters have the same base.
    """
    variables = jax.eval_shape(lambda: initialize(model, jax.random.key(0)))

    def fill(path: Any, leaf: Any) -> np.ndarray:
        name = path[-1].key
        random = np.random.default_rng(zlib.crc32(jax.tree_util.keystr(path).encode()))
        noise = random.standard_normal(leaf.shape)
        if leaf.ndim > 1 and name not in ("bias", "scale", "gate"):
            noise = noise / leaf.shape[-2] ** 0.5
        else:
            noise = 0.2 * noise
        return np.asarray(noise + (name == "scale"), np.float32)

    variables = jax.tree_util.tree_map_with_path(fill, variables)
    if mesh is not None:
        variables = jax.device_put(variables, shardings(variables, mesh))
    trainable, frozen = split_variables(variables, regime)
    run.mkdir(parents=True)
    encoding = EncodingConfig(
        image_size=model.vision.image_size,
        patch_size=model.vision.patch_size,
        points=PointTokenizerConfig(num_points=64, group_sizes=(16, 8), neighbours=4, width=model.vision.width),
        max_text_length=64,
    )
    save_policy_config(run, PolicyConfig(encoding, model), TOKENIZER)
    checkpoints = RunCheckpoints(run)
    checkpoints.save_base(frozen)
    checkpoints.save(1, variables_only(trainable), NO_NOTES)
    checkpoints.close()
    return variables


if __name__ == "__main__":
    for name, config in MESHES.items():
        write_run(Path(sys.argv[1]) / name, MODEL, mesh=make_mesh(config))
