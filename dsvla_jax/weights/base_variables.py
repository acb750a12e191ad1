"""The variables that a run starts from: those of a finished run, or of imported weights."""

from pathlib import Path

import jax

from dsvla_jax.checkpoints.storage import require_same_shapes
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.policy import load_policy
from dsvla_jax.weights.backbones import is_imported, load_for_model, with_cameras_of


def base_variables(
    base: str, model: ModelConfig, tokenizer: Tokenizer, frozen: bool, mesh: jax.sharding.Mesh
) -> Variables:
    """Loads the variables that a base has for a model, split over the mesh; none without a base.

    base: a run folder, a folder of imported weights, or empty. tokenizer: the new run's. frozen: whether the base is
    not trained. Raises UserError or CheckpointError if vocabulary or shapes differ.
    """
    if not base:
        return {}
    folder = Path(base)
    if is_imported(folder):
        return load_for_model(folder, model, mesh, frozen=frozen)
    policy = load_policy(folder, mesh)
    if policy.tokenizer != tokenizer:
        raise UserError(
            f"base: {folder} was trained with another vocabulary, whose tokens its embedding stands for; train with "
            f"that one: --tokenizer {folder}"
        )
    params = policy.variables["params"]
    like = with_cameras_of(model, policy.config.model.cameras)
    expected = jax.eval_shape(lambda: initialize(like, jax.random.key(0)))
    require_same_shapes(params, expected["params"], folder)
    return {"params": params}
