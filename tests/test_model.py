"""The network: towers, adapters, initialisation. Tiny random weights throughout."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.model.attention import attend
from dsvla_jax.model.clip import patchify
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig
from dsvla_jax.model.llama import rotary_tables, rotate
from dsvla_jax.model.lora import LoraDense, adapted_product, merge_lora, unmerge_lora
from dsvla_jax.model.vla import VLA, embed_numbers, initialize, number_embeddings
from dsvla_jax.types import ModelInputs
from tests.random_data import random_inputs

VOCAB = 60
LORA = LoraConfig(rank=3, alpha=7.0)
CONFIG = ModelConfig(
    vision=VisionConfig(image_size=32, patch_size=8, width=32, layers=2, heads=4),
    language=LanguageConfig(vocab_size=VOCAB, width=32, layers=2, heads=4, kv_heads=2, ffn=48, tie_embeddings=True),
    lora=LORA,
)
PATCHES = CONFIG.vision.num_patches


def make_inputs(batch=2, points=6, text=8, seed=0) -> ModelInputs:
    return random_inputs(CONFIG.vision, range(VOCAB), np.full(batch, text), text, points, seed)


def randomise(tree, seed=1, scale=0.2):
    leaves, structure = jax.tree.flatten(tree)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(structure, [jnp.asarray(rng.normal(size=x.shape) * scale, jnp.float32) for x in leaves])


@pytest.fixture(scope="module")
def variables():
    return initialize(CONFIG, jax.random.key(0))


@pytest.fixture(scope="module")
def adapted(variables):
    return {"params": variables["params"], "lora": randomise(variables["lora"])}


@pytest.fixture(scope="module")
def forward():
    return jax.jit(VLA(CONFIG).apply)


def test_logits_are_float32_for_the_text_positions(forward, variables):
    logits = forward(variables, make_inputs())
    assert logits.shape == (2, 8, VOCAB)
    assert logits.dtype == jnp.float32
    assert np.isfinite(logits).all()
    tail = jax.jit(lambda v, i: VLA(CONFIG).apply(v, i, 5))(variables, make_inputs())
    np.testing.assert_allclose(tail, logits[:, 5:], atol=1e-5)


def test_layers_axis_leads_every_scanned_variable(variables):
    assert variables["params"]["language"]["layers"]["q"]["kernel"].shape == (2, 32, 32)
    assert variables["lora"]["vision"]["layers"]["up"]["b"].shape == (2, 3, 128)
    kernel = variables["params"]["vision"]["layers"]["q"]["kernel"]
    assert not np.allclose(kernel[0], kernel[1])


def test_without_3d_tokens(forward, variables):
    logits = forward(variables, make_inputs(points=0))
    assert np.isfinite(logits).all()


def test_future_text_does_not_change_earlier_logits(forward, variables):
    inputs = make_inputs()
    changed = dataclasses.replace(
        inputs, text=dataclasses.replace(inputs.text, tokens=inputs.text.tokens.at[:, 5:].set(1))
    )
    np.testing.assert_allclose(forward(variables, inputs)[:, :5], forward(variables, changed)[:, :5], atol=1e-6)
    assert np.abs(forward(variables, inputs)[:, 5:] - forward(variables, changed)[:, 5:]).max() > 1e-3


def test_image_and_3d_tokens_reach_the_logits(forward, variables):
    inputs = make_inputs()
    logits = forward(variables, inputs)
    for changed in (
        dataclasses.replace(inputs, images=inputs.images + 1.0),
        dataclasses.replace(inputs, point_tokens=inputs.point_tokens * 2),
        dataclasses.replace(inputs, point_patches=(inputs.point_patches + 1) % PATCHES),
    ):
        assert np.abs(forward(variables, changed) - logits).max() > 1e-4


def test_permuting_3d_tokens_with_their_patches_permutes_only_them(variables):
    encode = jax.jit(lambda inputs: VLA(CONFIG).apply(variables, inputs, method="encode_vision"))
    inputs = make_inputs()
    order = np.random.default_rng(3).permutation(6)
    permuted = dataclasses.replace(
        inputs, point_tokens=inputs.point_tokens[:, order], point_patches=inputs.point_patches[:, order]
    )
    before, after = encode(inputs), encode(permuted)
    np.testing.assert_allclose(after[:, : 1 + PATCHES], before[:, : 1 + PATCHES], atol=1e-5)
    np.testing.assert_allclose(after[:, 1 + PATCHES :], before[:, 1 + PATCHES :][:, order], atol=1e-5)


def test_3d_token_carries_its_patch_positional_embedding(variables):
    # Giving every token patch 0, and the difference of the embeddings to the token itself, is the same input.
    inputs = make_inputs()
    params = variables["params"]
    positions = params["vision"]["positional_embedding"]
    encode = jax.jit(lambda p, i: VLA(CONFIG).apply({"params": p}, i, method="encode_vision"))
    moved = dataclasses.replace(
        inputs,
        point_tokens=inputs.point_tokens + positions[1 + inputs.point_patches] - positions[1 + 0],
        point_patches=jnp.zeros_like(inputs.point_patches),
    )
    np.testing.assert_allclose(encode(params, moved), encode(params, inputs), atol=1e-5)


def test_patch_product_is_the_strided_convolution():
    rng = np.random.default_rng(0)
    image = jnp.asarray(rng.normal(size=(2, 16, 16, 3)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(4, 4, 3, 5)), jnp.float32)
    expected = jax.lax.conv_general_dilated(
        image, kernel, (4, 4), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"), precision="highest"
    )
    np.testing.assert_allclose(patchify(image, 4) @ kernel.reshape(-1, 5), expected.reshape(2, 16, 5), atol=1e-4)


def test_attention_equals_loops_in_numpy():
    rng = np.random.default_rng(0)
    query, key, value = (rng.normal(size=s).astype(np.float32) for s in ((2, 4, 3, 8), (2, 2, 5, 8), (2, 2, 5, 8)))
    mask = rng.random((2, 3, 5)) < 0.7
    mask[..., 0] = True
    expected = np.zeros_like(query)
    for b, h, t in np.ndindex(2, 4, 3):
        scores = key[b, h // 2] @ query[b, h, t] / np.sqrt(8)
        weights = np.where(mask[b, t], np.exp(scores), 0)
        expected[b, h, t] = weights @ value[b, h // 2] / weights.sum()
    for implementation in ("auto", "explicit", "fused", "cudnn"):
        arrays = jnp.asarray(query), jnp.asarray(key), jnp.asarray(value), jnp.asarray(mask)
        result = attend(*arrays, implementation)
        np.testing.assert_allclose(result, expected, atol=1e-5)


def test_rotation_is_relative_and_pairs_halves():
    language = CONFIG.language
    rng = np.random.default_rng(0)
    query, key = (jnp.asarray(rng.normal(size=(1, 1, 8)), jnp.float32) for _ in range(2))

    def product(p, q):
        tables = [rotary_tables(jnp.array([[n]]), language, 15) for n in (p, q)]
        return (rotate(query, tables[0]) * rotate(key, tables[1])).sum()

    np.testing.assert_allclose(product(7, 3), product(14, 10), atol=1e-5)
    assert abs(product(7, 3) - product(7, 4)) > 1e-4
    # The slowest pair of a head of 8 is (3, 7), at theta^(-3/4).
    basis = jnp.zeros((1, 1, 8)).at[..., 3].set(1.0)
    angle = 100 * 10000.0**-0.75
    rotated = rotate(basis, rotary_tables(jnp.array([[100]]), language, 101))[0, 0]
    np.testing.assert_allclose(rotated[jnp.array([3, 7])], [np.cos(angle), np.sin(angle)], atol=1e-5)


def lora_gradient(config, variables):
    """Value and gradient of some loss with respect to the adapters."""

    @jax.jit
    def run(variables, inputs):
        def loss(lora):
            logits: Any = VLA(config).apply({"params": variables["params"], "lora": lora}, inputs)
            return jnp.square(logits).mean()

        return jax.value_and_grad(loss)(variables["lora"])

    return run(variables, make_inputs())


@pytest.mark.parametrize("change", [{"remat": "full"}, {"remat": "dots"}, {"attention": "fused", "scan_unroll": 2}])
def test_execution_switches_change_nothing(change, adapted):
    expected, actual = lora_gradient(CONFIG, adapted), lora_gradient(dataclasses.replace(CONFIG, **change), adapted)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-4), expected, actual)


def test_bfloat16_runs_and_stays_near(variables, forward):
    inputs = make_inputs()
    config = dataclasses.replace(CONFIG, dtype="bfloat16")
    logits = jax.jit(VLA(config).apply)(variables, inputs)
    assert logits.dtype == jnp.float32
    np.testing.assert_allclose(logits, forward(variables, inputs), atol=0.15)


# Adapters


def test_fresh_adapters_change_nothing(forward, variables):
    inputs = make_inputs()
    np.testing.assert_array_equal(forward(variables, inputs), forward({"params": variables["params"]}, inputs))


@pytest.mark.parametrize(("init", "std"), [("kaiming", (3 * 48) ** -0.5), ("normal", 0.02)])
def test_a_is_random_and_b_zero(init, std):
    layer = LoraDense(20, lora=LoraConfig(rank=30, init=init), name="q")
    adapter: Any = layer.init(jax.random.key(1), jnp.zeros((1, 48)))["lora"]
    assert adapter["a"].shape == (48, 30)
    np.testing.assert_allclose(adapter["a"].std(), std, rtol=0.1)
    assert adapter["b"].shape == (30, 20)
    assert not adapter["b"].any()


def test_adapter_is_scaled_by_alpha_over_rank(adapted, forward):
    # alpha 7, rank 3: adding 7/3 A B to the kernels by hand gives the adapted outputs.
    params = jax.tree.map(np.array, adapted["params"])
    for tower in ("vision", "language"):
        for name, adapter in adapted["lora"][tower]["layers"].items():
            params[tower]["layers"][name]["kernel"] += 7 / 3 * np.asarray(adapter["a"]) @ np.asarray(adapter["b"])
    inputs = make_inputs()
    expected = forward({"params": params}, inputs)
    np.testing.assert_allclose(forward(adapted, inputs), expected, atol=2e-4)
    assert np.abs(expected - forward({"params": adapted["params"]}, inputs)).max() > 0.05


def test_merge_and_unmerge(adapted, forward):
    inputs = make_inputs()
    merged = merge_lora(adapted, LORA)
    assert "lora" not in merged
    np.testing.assert_allclose(forward(merged, inputs), forward(adapted, inputs), atol=2e-4)
    back = unmerge_lora(merged, adapted["lora"], LORA)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), back, adapted)


def test_adapted_product_and_its_gradients_are_those_of_the_sum():
    keys = jax.random.split(jax.random.key(0), 5)
    shapes = ((40, 12), (12, 20), (12, 3), (3, 20), (40, 20))
    *arguments, weights = (jax.random.normal(key, shape) for key, shape in zip(keys, shapes, strict=True))

    def formed(*arguments):
        return jnp.sum(weights * jnp.tanh(adapted_product(*arguments)))

    def added(x, kernel, a, b):
        return jnp.sum(weights * jnp.tanh(x @ kernel + (x @ a) @ b))

    for ours, expected in zip(
        jax.grad(formed, (0, 1, 2, 3))(*arguments), jax.grad(added, (0, 1, 2, 3))(*arguments), strict=True
    ):
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4)


def test_merging_adapters_of_another_model_names_the_layer(adapted):
    alien = {"params": adapted["params"], "lora": {"language": {"layers": {"z": {"a": jnp.ones(1), "b": jnp.ones(1)}}}}}
    with pytest.raises(ValueError, match="language/layers/z has no kernel"):
        merge_lora(alien, LORA)


def test_targets_and_towers_are_chosen():
    lora = LoraConfig(rank=2, targets=("q", "v"), towers=("language",))
    config = dataclasses.replace(CONFIG, lora=lora)
    adapters = jax.eval_shape(lambda key: initialize(config, key), jax.random.key(0))["lora"]
    assert set(adapters) == {"language"}
    assert set(adapters["language"]["layers"]) == {"q", "v"}


def test_gradient_with_respect_to_adapters_alone(variables):
    _, gradient = lora_gradient(CONFIG, variables)
    assert jax.tree.structure(gradient) == jax.tree.structure(variables["lora"])
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        # B = 0 stops the gradient of A at the start, and only that one.
        assert bool(jnp.any(leaf != 0)) == (path[-1].key == "b"), path


# Initialisation


@pytest.mark.parametrize("tied", [True, False])
def test_numbers_start_near_their_neighbours(tied, variables):
    values = np.full(VOCAB, np.nan, np.float32)
    values[10:50] = np.arange(-20, 20)
    language = dataclasses.replace(CONFIG.language, tie_embeddings=tied)
    plain = variables["params"]["language"]
    if not tied:
        plain = {**plain, "output": plain["embedding"][::-1].T}
    aware = embed_numbers({"language": plain}, language, values)["language"]
    np.testing.assert_array_equal(aware["embedding"][:10], plain["embedding"][:10])
    tables = [aware["embedding"]] if tied else [aware["embedding"], aware["output"].T]
    for table in tables:
        rms = jnp.sqrt(jnp.square(table).mean(axis=1))
        np.testing.assert_allclose(rms[10:50].mean(), rms[:10].mean(), rtol=0.2)
        similarity = table[10:50] @ table[30]
        assert np.argmax(similarity) == 20
        assert similarity[20] > similarity[21] > similarity[24] > similarity[35]


def test_number_embeddings_depend_on_differences_only():
    table = np.asarray(number_embeddings(jnp.arange(-100.0, 201.0), 128))
    gram = table @ table.T / 128
    np.testing.assert_allclose(np.diag(gram), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.diag(gram, 7), gram[0, 7], atol=1e-4)
    assert gram[0, 1:].max() == gram[0, 1] < 0.97


def test_number_values_of_another_vocabulary_are_refused(variables):
    with pytest.raises(ValueError, match=r"expected \(60,\)"):
        embed_numbers(variables["params"], CONFIG.language, np.zeros(7))


def test_initialize_embeds_numbers():
    values = np.full(VOCAB, np.nan, np.float32)
    values[10:50] = np.arange(-20, 20)
    table = initialize(CONFIG, jax.random.key(0), values)["params"]["language"]["embedding"]
    np.testing.assert_allclose(table[10:50], number_embeddings(jnp.asarray(values[10:50]), 32) / 32**0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: VisionConfig(image_size=30, patch_size=8),
            "vision.image_size: expected a multiple of patch_size 8, got 30",
        ),
        (
            lambda: LanguageConfig(heads=32, kv_heads=5),
            "kv_heads: expected a divisor of heads 32, got 5",
        ),
        (
            lambda: LoraConfig(targets=("query",)),
            "model.lora.targets: expected some of q, .*, got 'query'",
        ),
        (lambda: dataclasses.replace(CONFIG, point_width=31), "model.point_width: expected the vision width 32"),
    ],
)
def test_impossible_configs_say_why(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_wrong_input_shapes_say_what_was_expected(variables):
    inputs = make_inputs()
    with pytest.raises(ValueError, match=r"images: expected \(B, 1, 32, 32, 3\), got \(2, 1, 16, 16, 3\)"):
        VLA(CONFIG).apply(variables, dataclasses.replace(inputs, images=jnp.zeros((2, 1, 16, 16, 3))))
    with pytest.raises(ValueError, match="point_tokens: expected width 32"):
        VLA(CONFIG).apply(variables, dataclasses.replace(inputs, point_tokens=jnp.zeros((2, 6, 16))))


def with_cameras(cameras: int) -> ModelConfig:
    return dataclasses.replace(CONFIG, cameras=cameras)


def test_only_a_model_of_several_cameras_has_an_embedding_for_each():
    one, two = (
        jax.eval_shape(lambda count=count: initialize(with_cameras(count), jax.random.key(0)))["params"]
        for count in (1, 2)
    )
    assert "camera_embedding" not in one["vision"]
    assert two["vision"].pop("camera_embedding").shape == (2, CONFIG.vision.width)
    assert jax.tree.map(lambda leaf: leaf.shape, two) == jax.tree.map(lambda leaf: leaf.shape, one)


def test_exchanging_cameras_with_their_embeddings_exchanges_their_outputs():
    config = with_cameras(2)
    variables = initialize(config, jax.random.key(0))
    vision = variables["params"]["vision"]
    embedding = jax.random.normal(jax.random.key(1), vision["camera_embedding"].shape)
    inputs = random_inputs(CONFIG.vision, range(4, 9), np.array([3, 3]), 3, points=5, cameras=2)
    swapped_patches = (inputs.point_patches + PATCHES) % (2 * PATCHES)
    exchanged = dataclasses.replace(inputs, images=inputs.images[:, ::-1], point_patches=swapped_patches)

    def outputs(inputs: ModelInputs, embedding: jax.Array) -> np.ndarray:
        params = {**variables["params"], "vision": {**vision, "camera_embedding": embedding}}
        tower: Any = VLA(config).apply({**variables, "params": params}, inputs, method=VLA.encode_vision)
        return np.asarray(tower)

    first, second = outputs(inputs, embedding), outputs(exchanged, embedding[::-1])
    order = np.concatenate(
        [[0], 1 + PATCHES + np.arange(PATCHES), 1 + np.arange(PATCHES), 1 + 2 * PATCHES + np.arange(5)]
    )
    np.testing.assert_allclose(second[:, order], first, atol=1e-5)
    # A 3D token has its camera's embedding: another camera's patch at the same place is another place.
    other = outputs(dataclasses.replace(inputs, point_patches=swapped_patches), embedding)
    assert np.abs(other - first)[:, 1 + 2 * PATCHES :].max() > 1e-3
    np.testing.assert_allclose(
        outputs(inputs, jnp.zeros_like(embedding))[:, 1 + 2 * PATCHES :],
        outputs(dataclasses.replace(inputs, point_patches=swapped_patches), jnp.zeros_like(embedding))[
            :, 1 + 2 * PATCHES :
        ],
        atol=1e-5,
    )
