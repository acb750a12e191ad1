"""Which of a model's variables learn and which are frozen, as operations on nested dicts."""

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, assert_never, cast

import jax.numpy as jnp
from flax import traverse_util

from dsvla_jax.types import Array

PROJECTOR = "projector"
CAMERA_EMBEDDING = "camera_embedding"
# What answers with poses instead of text.
POSE_HEAD = "pose_head"

# Parameters that are cast to the model's dtype before anything is computed with them. Norms and positions are not.
MATRICES = ("kernel", "embedding", "output", "projection", "patch_kernel")

Variables: TypeAlias = dict[str, Any]
"""Nested dicts of arrays. Of no single depth, so that what a key gives cannot be annotated."""

FlatVariables: TypeAlias = dict[tuple[str, ...], Array]
"""The arrays of variables by their paths."""

Regime = Literal["full", "lora", "adapters"]
"""What is trained."""


def flat_variables(variables: Mapping) -> FlatVariables:
    """The arrays by their paths; `traverse_util.unflatten_dict` is the inverse."""
    return cast(FlatVariables, traverse_util.flatten_dict(variables))


def split_variables(variables: Variables, regime: Regime) -> tuple[Variables, Variables]:
    """The variables as (trainable, frozen).

    `full`: everything learns. `lora`: the "lora" collection and the projector learn (paper, section 3.1). `adapters`:
    the "lora" collection alone, on a base whose projector is pretrained (as in the authors' released training code).
    The embeddings of several cameras and a pose head learn always: no pretrained model has them.
    """
    flat = flat_variables(variables)

    def learns(path: tuple[str, ...]) -> bool:
        if path[-1] == CAMERA_EMBEDDING or path[1] == POSE_HEAD:
            return True
        match regime:
            case "full":
                return True
            case "lora":
                return path[0] == "lora" or path[1] == PROJECTOR
            case "adapters":
                return path[0] == "lora"
            case _:
                assert_never(regime)

    trainable = {path: leaf for path, leaf in flat.items() if learns(path)}
    frozen = {path: leaf for path, leaf in flat.items() if not learns(path)}
    return traverse_util.unflatten_dict(trainable), traverse_util.unflatten_dict(frozen)


def narrow_frozen(frozen: Variables, dtype: jnp.dtype) -> Variables:
    """The frozen variables with those that the model only ever reads in ``dtype`` kept in it: no result changes."""
    narrow = {
        path: leaf.astype(dtype) if path[-1] in MATRICES and leaf.dtype != jnp.int8 else leaf
        for path, leaf in flat_variables(frozen).items()
    }
    return traverse_util.unflatten_dict(narrow)


def join_variables(trainable: Variables, frozen: Variables) -> Variables:
    """The inverse of `split_variables`."""
    return traverse_util.unflatten_dict(flat_variables(frozen) | flat_variables(trainable))
