"""Policies of run folders: what is saved beside the checkpoints, and the policy that comes of both."""

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Literal

import jax

from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.config_files import read_config
from dsvla_jax.encoding.pretrained_tokenizers import fits_rows, load_tokenizer, save_tokenizer, vocabulary_digest
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.model.decode import GREEDY, Decoding
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.unstacked import unstack_layers
from dsvla_jax.policies.config import PolicyConfig, uses_model
from dsvla_jax.policies.interface import Policy
from dsvla_jax.policies.registry import make_learner, make_policy


def save_policy_config(run: Path, config: PolicyConfig, tokenizer: Tokenizer) -> None:
    """Writes what `load_policy` needs besides a checkpoint."""
    config = dataclasses.replace(config, vocabulary=vocabulary_digest(tokenizer))
    (run / "policy.json").write_text(json.dumps(dataclasses.asdict(config), indent=2) + "\n")
    save_tokenizer(tokenizer, run)


def load_policy_config(run: Path) -> PolicyConfig:
    """What `save_policy_config` wrote. Raises CheckpointError where it did not, or for another version."""
    file = run / "policy.json"
    if not file.exists():
        raise CheckpointError(
            f"{run}: no run here (policy.json is missing); train one: python train.py CONFIG --run {run}"
        )
    try:
        return read_config(file, PolicyConfig, "a policy")
    except UserError as error:
        raise CheckpointError(str(error)) from error


def load_vocabulary(run: Path, config: PolicyConfig) -> Tokenizer:
    """The vocabulary of a run folder. Raises CheckpointError where it is not the one that the run was trained with."""
    tokenizer, rows = load_tokenizer(run), config.model.language.vocab_size
    fits = not uses_model(config.baseline) or fits_rows(tokenizer, rows)
    if not fits or config.vocabulary not in (None, vocabulary_digest(tokenizer)):
        raise CheckpointError(
            f"{run}: its tokenizer files are not those that it was trained with: {tokenizer.vocab_size} tokens for an "
            f"embedding of {rows} rows, or other tokens, or in another order; copy them from the original run folder"
        )
    return tokenizer


def load_policy(
    run: Path,
    mesh: jax.sharding.Mesh | None = None,
    decoding: Decoding = GREEDY,
    step: int | Literal["best"] | None = None,
) -> Policy:
    """The policy of a run folder, split over the mesh if there is one.

    step: the checkpoint whose weights it gets: a number, "best" by its score, or the newest if not given.
    Raises CheckpointError naming what is missing or does not fit.
    """
    config = load_policy_config(run)
    tokenizer = load_vocabulary(run, config)
    learner = make_learner(config, tokenizer)
    like = jax.eval_shape(learner.initialise, jax.random.key(0))
    if mesh is not None:
        like = jax.tree.map(lambda leaf, where: leaf.update(sharding=where), like, shardings(like, mesh))
    with contextlib.closing(RunCheckpoints(run, read_only=True)) as checkpoints:
        variables = checkpoints.restore_variables(like, step)
    # Decoding text reads the layers many times over.
    if config.baseline is None and mesh is None and jax.default_backend() == "cpu":
        variables = unstack_layers(variables)
    return make_policy(config, variables, tokenizer, decoding)
