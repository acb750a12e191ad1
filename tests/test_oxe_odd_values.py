"""Values of RLDS builds that are whole but say little: no words, a component that does not vary, a hand half-way."""

import numpy as np
import pytest

from data_pipelines.inspect.rlds import describe_build, find_dataset
from data_pipelines.oxe.__main__ import prepare
from data_pipelines.oxe.columns import Settled
from data_pipelines.oxe.fixtures.fixture import episode_of, features_of
from data_pipelines.oxe.fixtures.write import FIXTURES, known_episodes
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.oxe.mixture import open_mixture
from data_pipelines.oxe.motion import Motion
from data_pipelines.oxe.registry import get_dataset
from data_pipelines.oxe.scale import MixtureScale
from data_pipelines.oxe.targets import keyframes
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.writing import write_build
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.suite_vocabulary import suite_tokenizer

BRIDGE, EPISODES, STEPS = "bridge_dataset", 10, 8
ENCODING = EncodingConfig(image_size=32, patch_size=16, style="compact", max_text_length=64, use_points=False)


def write(folder, change, name=BRIDGE):
    """A fixture whose stored episodes were changed: change(number, steps)."""
    episodes = [episode_of(FIXTURES[name], known) for known in known_episodes(name, EPISODES, STEPS)]
    for number, episode in enumerate(episodes):
        change(number, episode["steps"])
    write_build(folder, name, features_of(FIXTURES[name]), {"train": episodes}, 2)


def config_for(folder, **options):
    return OxeConfig(**{"folder": str(folder), "mixture": (BRIDGE,), "image_size": 32, "streams": 1, **options})


def load(folder, **options):
    config = config_for(folder, **options)
    return OxeLoader(config, ENCODING, suite_tokenizer(), batch_size=8, seed=0, num_threads=0, progress=False)


def inspect(folder, **options):
    config = config_for(folder, **options)
    return describe_build(*find_dataset(BRIDGE, config, ""), config, 1, ENCODING)


WORDLESS = ("", "", "", "", " \n", "NaN")


@pytest.fixture(scope="module")
def wordless(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wordless")

    def change(number, steps):
        for step in steps if number < len(WORDLESS) else ():
            step["language_instruction"] = WORDLESS[number]

    write(folder, change)
    return folder


def test_episodes_without_words_are_left_out_kept_or_refused(wordless, capsys):
    lengths = np.array([episode.num_steps - 1 for episode in known_episodes(BRIDGE, EPISODES, STEPS)])
    loader = load(wordless)
    assert loader.num_samples == lengths[6:].sum()
    assert all(loader.source[i].instruction for i in range(2 * loader.num_samples))

    kept = load(wordless, unlabelled="keep")
    assert kept.num_samples == lengths.sum()
    assert sum(kept.source[i].instruction == "" for i in range(kept.num_samples)) == lengths[:6].sum()
    assert "nan" not in kept.source.words
    next(kept)

    with pytest.raises(DataError, match="instructions: expected one an episode, got 6 of 10 without; set unlabelled"):
        load(wordless, unlabelled="refuse")
    with pytest.raises(UserError, match="unlabelled: expected one of leave_out, keep, refuse, got 'drop'"):
        OxeConfig(unlabelled="drop")  # pyright: ignore[reportArgumentType]

    prepare(config_for(wordless))
    assert f"{BRIDGE}: 4 of 10 episodes have an instruction; the others are left out" in capsys.readouterr().out


def test_inspection_counts_episodes_without_words(wordless):
    said = "6 of 10 episodes have no instruction"
    assert [warning for warning in inspect(wordless).warnings if said in warning] == [f"{said}: they are left out"]
    kept = [warning for warning in inspect(wordless, unlabelled="keep").warnings if said in warning]
    assert kept == [f"{said}: they are learned from with prompts that ask for nothing"]


def test_a_build_without_any_words_says_what_to_set(tmp_path):
    def change(_, steps):
        for step in steps:
            step["language_instruction"] = " "

    write(tmp_path, change)
    with pytest.raises(
        DataError, match="at least one usable episode, got none; 10 have no instruction: set unlabelled"
    ):
        load(tmp_path)
    assert load(tmp_path, unlabelled="keep").num_samples > 0


def still_hand(rng):
    """Roll and pitch zero, yaw that trembles by a billionth."""

    def change(_, steps):
        for step in steps:
            state = step["observation"]["state"]
            state[3:6] = 0, 0, 1e-9 * rng.normal()

    return change


def test_a_component_that_only_trembles_is_constant(tmp_path):
    write(tmp_path, still_hand(np.random.default_rng(0)))
    opened, weights = open_mixture(config_for(tmp_path), progress=False)
    assert opened[0].index.constant == ("rx", "ry", "rz")
    scale = MixtureScale(opened, weights).scale
    assert scale.varies.tolist() == [True] * 3 + [False] * 3
    moved = np.array([sample.displacement for sample in opened[0].read(0)])
    # The numbers of the answer say no turn, and read back they are none.
    codec = PoseCodec()
    bins = codec.encode(scale.to_pose(moved, codec), np.zeros(moved.shape[:2]))
    assert np.unique(np.asarray(bins)[..., 3:7].reshape(-1, 4), axis=0).tolist() == [[0, 0, 0, 100]]
    assert np.abs(scale.from_pose(scale.to_pose(moved, codec), codec)[..., 3:]).max() < 1e-6
    (warning,) = [warning for warning in inspect(tmp_path).warnings if "vary" in warning]
    assert warning.startswith("rx, ry, rz of the targets do not vary")


def test_ranges_that_mean_something_are_binned_as_they_were():
    low, high = (-0.1, 0, 0, 0, 0, 0), (0.1, 2e-6, 1e-6, 1e-9, 0, 0)
    assert DisplacementScale(low, high).varies.tolist() == [True, True, False, False, False, False]


def test_a_hand_that_only_trembles_comes_to_no_rest():
    rng = np.random.default_rng(0)
    pose = np.zeros((30, 1, 7), np.float32)
    pose[:, 0, :3], pose[:, 0, 6] = 1e-8 * rng.normal(size=(30, 3)), 1
    command = np.ones((30, 1), np.float32)
    assert keyframes(Motion("", pose, command, None, command)) == [29]


@pytest.mark.parametrize(
    ("readings", "command"),
    [
        # An end that is reached is where the motion was going.
        ((1.0, 0.6, 0.4, 0.0, 0.3, 1.0), (1, 0, 0, 0, 1, 1)),
        # None is reached any more: the last reading stands for the readings since the last end.
        ((1.0, 0.0, 0.3, 0.6, 0.7), (1, 0, 0.7, 0.7, 0.7)),
        ((0.4, 0.5, 0.3), (0.3, 0.3, 0.3)),
        ((0.95, 0.05), (0.05, 0.05)),
    ],
)
def test_a_gripper_on_its_way_counts_as_the_end_that_it_reaches(readings, command):
    values = np.array(readings, np.float32).astype(np.float64)
    told = Settled(lambda _: values[:, None])(None)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(told, command, atol=1e-7)


@pytest.mark.parametrize("name", [BRIDGE, "bridge_orig", "tdroid_carrot_in_bowl"])
def test_undecided_tails_stay_undecided_in_every_dataset_that_settles(tmp_path, name):
    def change(_, steps):
        for step, value in zip(steps[-3:], (0.2, 0.9, 0.6), strict=True):
            step["action"][-1] = value

    write(tmp_path, change, name)
    build = RldsBuild(tmp_path / name)
    episode = build.parse(build.open_shard(build.shards("train")[0]).read(0), "record 0")
    np.testing.assert_allclose(get_dataset(name).motion(episode).gripper_command[-3:, 0], 0.6, atol=1e-6)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 2), (0, 0, 0, 0.5), (0, 0, 0, 1e-20), (0, 0, 0, 0)])
@pytest.mark.parametrize(
    ("name", "path"),
    [("fractal20220817_data", ("observation", "base_pose_tool_reached")), ("cmu_play_fusion", ("action", None))],
)
def test_quaternions_of_another_length_are_refused_with_record_and_step(tmp_path, name, path, quaternion):
    group, column = path

    def change(number, steps):
        if number == 1:
            values = steps[3][group][column] if column else steps[3][group]
            values[3:7] = quaternion

    write(tmp_path, change, name)
    config = config_for(tmp_path, mixture=(name,))
    if column is None and not any(quaternion):
        # A displacement of four zeros is a step without a turn.
        open_mixture(config, progress=False)
        return
    length = f"{np.linalg.norm(np.float32(quaternion)):.4g}"
    message = f"record 1: rotation: expected unit quaternions, got length {length} at step 3"
    with pytest.raises(DataError, match=f"00000-of-00002, {message}"):
        open_mixture(config, progress=False)
    ((opened,), _) = open_mixture(config_for(tmp_path, mixture=(name,), skip_bad=True), progress=False)
    assert len(opened.index.samples) == EPISODES - 1
    (left_out,) = opened.index.left_out
    assert "record 1" in left_out[0]
    assert "at step 3" in left_out[1]


def test_a_dataset_named_twice_is_refused():
    with pytest.raises(UserError, match=r"mixture: bridge_dataset stands there twice; name it once, with a weight"):
        open_mixture(OxeConfig(mixture=(BRIDGE, f"{BRIDGE}=2")))
