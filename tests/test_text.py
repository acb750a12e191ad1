import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.prompts import ParseFailure, answer_pieces, format_answer, format_prompt, parse_answer
from dsvla_jax.encoding.text import WordTokenizer, check_words, unknown_words, vocabulary
from dsvla_jax.errors import UserError
from dsvla_jax.types import Action

ARMS_AND_STYLES = [(arms, style) for arms in (1, 2) for style in ("paper", "compact")]


def random_integers(arms: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.uniform(-1, 1, (arms, 2)), rng.uniform(0, 2, (arms, 1)), rng.normal(size=(arms, 4))], 1)
    return np.asarray(PoseCodec().encode(pose, rng.integers(0, 2, arms)))


@pytest.fixture(scope="module")
def tokenizer() -> WordTokenizer:
    return WordTokenizer(vocabulary(["close the red jar", "lift the tray with 2 hands"]))


def test_codec_is_the_identity_on_integers_of_positions_and_gripper():
    codec = PoseCodec()
    everything = np.zeros((201, 8), np.int32)
    everything[:, 0] = everything[:, 1] = np.arange(-100, 101)
    everything[:, 2] = np.arange(201)
    everything[:, 6], everything[:, 7] = 100, np.arange(201) % 2
    np.testing.assert_array_equal(codec.encode(codec.decode(everything)), everything)
    action = codec.decode(everything)
    np.testing.assert_allclose(action.pose[:, 2], np.arange(201) / 100, atol=1e-6)


@pytest.mark.parametrize("box", [((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0)), ((-0.4, -0.5, 0.6), (0.7, 0.5, 1.6))])
def test_codec_position_error_is_at_most_half_a_step(box):
    codec = PoseCodec(*box)
    position = np.random.default_rng(0).uniform(box[0], box[1], (1000, 3)).astype(np.float32)
    integers = codec.encode_position(position)
    assert (np.abs(integers * codec.step - position) <= codec.step / 2 + 1e-6).all()


def test_codec_rotation_error_and_sign():
    codec = PoseCodec()
    q = np.random.default_rng(0).normal(size=(5000, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    pose = np.concatenate([np.zeros((5000, 3)), q], 1).astype(np.float32)
    integers = codec.encode(pose, np.ones(5000))
    flipped = pose * np.array([1, 1, 1, -1, -1, -1, -1], np.float32)
    np.testing.assert_array_equal(integers, codec.encode(flipped, np.ones(5000)))
    assert (integers[:, 6] >= 0).all()
    decoded = codec.decode(integers).pose[:, 3:]
    degrees = np.degrees(2 * np.arccos(np.clip(np.abs((decoded * q).sum(-1)), 0, 1)))
    assert degrees.max() < 1.3
    assert np.abs(codec.encode(codec.decode(integers)) - integers).max() <= 1


def test_codec_text_of_a_downward_gripper_ignores_noise_of_its_real_part():
    noise = np.array([[0.002, 1, -0.003, 0.004], [-0.002, 1, 0.001, -0.004], [0.001, -1, 0.002, 0.0049]], np.float32)
    pose = np.concatenate([np.zeros((3, 3), np.float32), noise], 1)
    np.testing.assert_array_equal(PoseCodec().encode(pose, np.zeros(3))[:, 3:7], [[0, 100, 0, 0]] * 3)


def test_codec_moves_outside_positions_to_the_box():
    np.testing.assert_array_equal(PoseCodec().encode_position(np.array([-3.0, 0.0, 9.0])), [-100, 0, 200])


def test_codec_agrees_between_numpy_and_jit_and_takes_actions():
    codec = PoseCodec()
    integers = np.concatenate([random_integers(2, seed) for seed in range(20)])
    action = codec.decode(integers)
    jitted = jax.jit(codec.decode)(jnp.asarray(integers))
    np.testing.assert_allclose(action.pose, jitted.pose, atol=1e-6)
    both = jax.jit(codec.encode)(Action(jnp.asarray(action.pose), jnp.asarray(action.gripper_open)))
    np.testing.assert_array_equal(both, codec.encode(action.pose, action.gripper_open))
    with pytest.raises(ValueError, match="gripper_open is missing"):
        codec.encode(action.pose)


def test_prompts_read_as_documented():
    state = np.array([[28, -1, 140, 0, 100, 0, 0, 1]])
    assert (
        format_prompt("close the jar.", state, np.array([[25, 3, 80]]), "compact")
        == "close the jar state 28 -1 140 0 100 0 0 1 near 25 3 80:"
    )
    paper = format_prompt("close the jar", state, np.array([[25, 3, 80]]), "paper")
    assert (
        "Determine the gripper's position, orientation, and operational state for the next step in the task: "
        "close the jar. The current gripper position is [28, -1, 140]. The current gripper rotation is [0, 100, 0, 0]. "
        "The current gripper state is 1. The target position is within or near the point: [25, 3, 80].\n" in paper
    )
    assert paper.endswith("### Response:")
    assert format_answer(state, "compact") == "28 -1 140 0 100 0 0 1"
    assert format_answer(state, "paper") == (
        "The gripper position is [28, -1, 140]. The gripper rotation quaternion is [0, 100, 0, 0]. "
        "The gripper open status is 1."
    )


@pytest.mark.parametrize("style", ["paper", "compact"])
def test_keypoints_can_be_left_out_and_the_left_arm_comes_first(style):
    state = random_integers(2)
    without = format_prompt("lift", state, None, style)
    assert "near" not in without
    with_keypoints = format_prompt("lift", state, np.array([[1, 2, 3], [4, 5, 6]]), style)
    assert with_keypoints.index("left") < with_keypoints.index("right")
    with pytest.raises(ValueError, match="one row for each of 2 arms, got 1"):
        format_prompt("lift", state, np.array([[1, 2, 3]]), style)


@pytest.mark.parametrize(("arms", "style"), ARMS_AND_STYLES)
def test_answers_round_trip_as_text_and_as_tokens(arms, style, tokenizer):
    for seed in range(50):
        integers = random_integers(arms, seed)
        text = format_answer(integers, style)
        np.testing.assert_array_equal(parse_answer(text, arms, style), integers)
        np.testing.assert_array_equal(parse_answer(tokenizer.decode(tokenizer.encode(text)), arms, style), integers)


@pytest.mark.parametrize(
    ("text", "arms", "style"),
    [
        ("", 1, "compact"),
        ("1 2 3 0 100 0 0", 1, "compact"),
        ("1 2 3 0 100 0 0 1 1", 1, "compact"),
        ("1 2 3 0 100 0 0 2", 1, "compact"),
        ("1 2 3 0 100 0 -1 1", 1, "compact"),
        ("1 2 3 0 0 0 0 1", 1, "compact"),
        ("1 2 3 0 100 0 0 1", 2, "compact"),
        ("1 2 3 0 100 0 0 1", 1, "paper"),
        ("The gripper position is [1, 2]. The gripper rotation quaternion is [0, 0, 0, 1]. ", 1, "paper"),
    ],
)
def test_malformed_answers_fail_to_parse(text, arms, style):
    with pytest.raises(ParseFailure):
        parse_answer(text, arms, style)


def test_answers_outside_their_slots_are_not_written():
    with pytest.raises(ValueError, match=r"0 to 1 at \[0, 7\], got 5.*PoseCodec"):
        format_answer(np.array([[0, 0, 0, 0, 0, 0, 100, 5]]), "compact")
    with pytest.raises(ValueError, match="style: expected one of paper, compact, got 'short'"):
        answer_pieces(1, "short")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"expected integers of shape \(arms, 8\), got float64"):
        format_answer(np.zeros((1, 8)), "compact")


def test_word_tokenizer_gives_one_token_to_each_integer_and_word(tokenizer):
    assert len(tokenizer.encode("close the jar, -12 and 200:")) == 8
    assert len({tuple(tokenizer.encode(str(n))) for n in range(-100, 201)}) == 301
    assert tokenizer.decode(tokenizer.encode("Close the JAR at -12.")) == "close the jar <unk> -12 ."
    for arms in (1, 2):
        for style in ("paper", "compact"):
            prompt = format_prompt("close the red jar", random_integers(arms), np.zeros((arms, 3), int), style)
            assert tokenizer.unk_id not in tokenizer.encode(prompt)
    with pytest.raises(ValueError, match="number 201 has no token"):
        tokenizer.encode("go to 201")


def test_word_tokenizer_number_values(tokenizer):
    values = tokenizer.number_values
    assert values.shape == (tokenizer.vocab_size,)
    assert values.dtype == np.float32
    for number in (-100, -1, 0, 200):
        assert values[tokenizer.encode(str(number))[0]] == number
    assert np.isnan(values).sum() == tokenizer.vocab_size - 301
    assert np.isnan(values[[tokenizer.pad_id, tokenizer.bos_id, tokenizer.eos_id, tokenizer.encode("the")[0]]]).all()


def test_word_tokenizer_does_not_depend_on_the_order_of_instructions_and_survives_a_file(tokenizer, tmp_path):
    again = WordTokenizer(vocabulary(["lift the tray with 2 hands", "close the red jar", "close the red jar"]))
    assert again == tokenizer
    tokenizer.save(tmp_path)
    assert WordTokenizer.load(tmp_path / "tokenizer.json") == tokenizer
    (tmp_path / "other.json").write_text(json.dumps({"words": []}))
    with pytest.raises(ValueError, match=r"other\.json: expected .*format"):
        WordTokenizer.load(tmp_path / "other.json")


def test_words_and_numbers_without_a_token_are_named_and_digits_that_are_no_integers_are_words(tokenizer):
    text = "Close the red JAR, lift 2 trays to 450 or -101 degrees: ② ³ ٣ 0007"
    assert unknown_words([text], tokenizer) == ["-101", "450", "degrees", "to", "trays", "³", "②"]
    assert unknown_words(["close 200 -100 -0 ٣ 0007"], tokenizer) == []
    assert tokenizer.encode("٣ 0007") == tokenizer.encode("3 7")
    assert unknown_words(["9" * 5000], tokenizer) == ["9" * 5000]
    assert WordTokenizer(vocabulary(["press button ②"])).encode("②") != [tokenizer.unk_id]
    with pytest.raises(UserError, match=r"mine: .*no token for '450': integers from -100 to 200 .*in words"):
        check_words("mine", ["set the oven to 450 degrees"], tokenizer, "command")
    with pytest.raises(UserError, match=r"mine: .*no token for 'frobnicate', 'xyzzy'; write one with `command`"):
        check_words("mine", ["xyzzy frobnicate"], tokenizer, "command")
    for text in ("close 450", "9" * 5000):
        with pytest.raises(UserError, match="has no token"):
            tokenizer.encode(text)
