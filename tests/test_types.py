"""The structs: shapes are checked while tests run, and pytrees of them hold anything."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from dsvla_jax.encoding.encode import example_spec
from dsvla_jax.types import Camera, Picture, Text, named_arrays
from tests.random_data import random_example
from tests.small import small_encoding


def camera(*batch: int) -> Camera[np.ndarray]:
    return Camera(np.zeros((*batch, 3, 3), np.float32), np.zeros((*batch, 4, 4), np.float32))


def test_a_wrong_shape_or_dtype_is_refused():
    right = camera()
    with pytest.raises(TypeCheckError, match="intrinsics"):
        Camera(np.zeros((3, 4), np.float32), right.world_from_camera)
    with pytest.raises(TypeCheckError, match="intrinsics"):
        dataclasses.replace(right, intrinsics=np.zeros((3, 3), np.int32))
    with pytest.raises(TypeCheckError, match="rgb"):
        Picture(np.zeros((8, 8, 3), np.float32), np.zeros((8, 8), np.float32), right)
    wrong: Any = right.intrinsics.tolist()
    with pytest.raises(TypeCheckError, match="intrinsics"):
        Camera(wrong, right.world_from_camera)


def test_fields_with_different_batch_axes_are_refused():
    with pytest.raises(TypeCheckError, match="world_from_camera"):
        Camera(camera(2).intrinsics, camera(3).world_from_camera)
    with pytest.raises(TypeCheckError, match="mask"):
        Text(np.zeros((2, 5), np.int32), np.ones(5, bool))
    assert camera(2, 7).intrinsics.shape == (2, 7, 3, 3)


def test_shapes_are_checked_while_a_function_is_traced():
    with pytest.raises(TypeCheckError, match="mask"):
        jax.jit(lambda tokens: Text(tokens, tokens[:, :2] > 0))(jnp.zeros((2, 5), jnp.int32))


def test_pytrees_of_placeholders_pass():
    example = random_example(np.random.default_rng(0), np.ones((2, 5), bool), 40)
    leaves, structure = jax.tree.flatten(example)
    for placeholders in ([None] * len(leaves), [object()] * len(leaves), [leaf.shape for leaf in leaves]):
        jax.tree.unflatten(structure, placeholders)
    names: Any = jax.tree_util.tree_map_with_path(lambda path, _: jax.tree_util.keystr(path), example)
    assert names.pictures.camera.intrinsics == ".pictures.camera.intrinsics"
    assert jax.vmap(lambda one: one, in_axes=0)(example).text.tokens.shape == (2, 5)
    assert jax.tree.structure(example_spec(small_encoding(), 2, 1, 32, 32)) == structure


def test_arrays_are_named_by_their_place():
    arrays = named_arrays(camera(2))
    assert {name: array.shape for name, array in arrays.items()} == {
        "intrinsics": (2, 3, 3),
        "world_from_camera": (2, 4, 4),
    }
