"""Every dataset of the registry: a build with its own features and a known motion, read back as that motion."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipelines.oxe.dataset import View
from data_pipelines.oxe.fixtures.fixture import episode_of, features_of
from data_pipelines.oxe.fixtures.known_motion import known_episode
from data_pipelines.oxe.fixtures.write import FIXTURES, write_fixture, write_fixtures
from data_pipelines.oxe.registry import DATASETS, DESCRIBED_IN, MIXTURES, get_dataset, get_mixture
from data_pipelines.rlds import writing
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.features import decode_image, image_format
from data_pipelines.rlds.writing import write_build
from dsvla_jax.errors import DataError, UserError

# What the published data tell, by hand.
NO_POSE = {
    "berkeley_cable_routing", "roboturk", "nyu_door_opening_surprising_effectiveness", "toto",
    "cmu_franka_exploration_dataset_converted_externally_to_rlds", "berkeley_rpt_converted_externally_to_rlds",
    "imperialcollege_sawyer_wrist_cam", "cmu_play_fusion", "mujoco_manip", "roboset",
    "aloha_static_dataset", "aloha_dagger_dataset", "aloha_mobile_dataset",
}  # fmt: skip
CONSTANT_GRIPPER = {
    "berkeley_cable_routing": 0, "kaist_nonprehensile_converted_externally_to_rlds": 0, "uiuc_d3field": 0,
    "language_table": 1, "gnm_dataset": 0, "berkeley_gnm_recon": 0, "berkeley_gnm_cory_hall": 0,
    "berkeley_gnm_sac_son": 0,
}  # fmt: skip
# Of those that octo and openvla train on, by kpertsch/rlds_dataset_mod; cmu_playing_with_food by its own builder.
EXCHANGED = {
    "berkeley_autolab_ur5": ("wrist",), "utaustin_mutex": ("primary", "wrist"),
    "stanford_hydra_dataset_converted_externally_to_rlds": ("primary", "wrist"),
    "berkeley_fanuc_manipulation": ("primary", "wrist"), "cmu_playing_with_food": ("primary", "wrist"),
}  # fmt: skip
# Versions in the bucket: tfds' rtx.py, and Open X-Embodiment's notebook for robo_net and language_table.
VERSIONS = {"aloha_mobile": "0.0.1", "dobbe": "0.0.1", "fmb": "0.0.1", "robo_set": "0.0.1", "language_table": "0.0.1",
            "robo_net": "1.0.0", "droid": "1.0.0"}  # fmt: skip
JOINTS = {"berkeley_rpt_converted_externally_to_rlds", "roboset", "aloha_static_dataset", "aloha_dagger_dataset",
          "aloha_mobile_dataset"}  # fmt: skip
NAVIGATION = {"gnm_dataset", "berkeley_gnm_recon", "berkeley_gnm_cory_hall", "berkeley_gnm_sac_son"}
EVERY_FIFTH = slice(None, None, 5)
KEPT_STEPS = {
    "bridge_orig": slice(1, None),
    "bridge_oxe": slice(1, None),
    "iamlab_cmu_pickup_insert_converted_externally_to_rlds": slice(1, None),
    "berkeley_rpt_converted_externally_to_rlds": slice(None, None, 3),
    "aloha_static_dataset": EVERY_FIFTH,
    "aloha_dagger_dataset": EVERY_FIFTH,
    "aloha_mobile_dataset": EVERY_FIFTH,
}


def episodes_of(folder):
    build = RldsBuild(folder)
    for shard in build.shards("train"):
        records = build.open_shard(shard)
        for number in range(len(records)):
            yield build.parse(records.read(number), f"{shard.path}, record {number}")


def known_displacement(arm):
    """(T, 6), base frame, zero at the last step: the oracle, from the motion itself."""
    moved = np.zeros((len(arm.open), 6))
    moved[:-1, :3] = np.diff(arm.position, axis=0)
    matrices = arm.rotation.as_matrix()
    moved[:-1, 3:] = Rotation.from_matrix(matrices[1:] @ matrices[:-1].transpose(0, 2, 1)).as_rotvec()
    return moved


def angle_between(one, other):
    return (Rotation.from_quat(one) * Rotation.from_quat(other).inv()).magnitude()


@pytest.mark.parametrize("name", sorted(DATASETS))
def test_the_known_motion_is_read_back(name, tmp_path):
    known = write_fixture(tmp_path, name, episodes=2, steps=8, shards=2)
    dataset = get_dataset(name)
    kept = KEPT_STEPS.get(name, slice(None))
    features = RldsBuild(tmp_path / name).features
    seen = list(episodes_of(tmp_path / name))
    assert len(seen) == len(known) == 2
    for episode, truth in zip(seen, known, strict=True):
        motion = dataset.motion(episode)
        assert motion.instruction == truth.instruction
        assert motion.num_arms == len(truth.arms)
        assert (motion.pose is None) == (name in NO_POSE)
        assert (motion.joints is not None) == (name in JOINTS)
        for i, arm in enumerate(truth.arms):
            constant = CONSTANT_GRIPPER.get(name)
            command = arm.open if constant is None else np.full(len(arm.open), constant)
            state = arm.was if constant is None else command
            np.testing.assert_allclose(motion.gripper_command[:, i], command[kept], atol=1e-5)
            np.testing.assert_allclose(motion.gripper_open[:, i], state[kept], atol=1e-5)
            if motion.pose is not None:
                np.testing.assert_allclose(motion.pose[:, i, :3], arm.pose[kept, :3], atol=1e-5)
                assert angle_between(motion.pose[:, i, 3:], arm.pose[kept, 3:]).max() < 1e-4
            if motion.action is not None:
                expected = known_displacement(arm)[kept]
                if dataset.frame == "tool":
                    inverse = arm.rotation[kept].inv()
                    expected = np.concatenate([inverse.apply(expected[:, :3]), inverse.apply(expected[:, 3:])], axis=1)
                if name in NAVIGATION:
                    expected[:, 3:] = 0  # their actions are waypoints without a heading
                np.testing.assert_allclose(motion.action[:, i], expected, atol=2e-5)
            if motion.joints is not None:
                turned = arm.rotation.as_rotvec() if len(truth.arms) == 2 else arm.rotation.as_quat()
                written = np.concatenate([arm.position, turned], axis=1)
                np.testing.assert_allclose(motion.joints[:, i], written[kept], atol=1e-5)
        views: tuple[View, ...] = ("primary", "wrist")
        for step, view in itertools.product(dataset.steps(episode)[:2], views):
            if view not in dataset.images:
                continue
            path = f"steps/observation/{dataset.images[view]}"
            kind = image_format(features[path], view in dataset.bgr)
            picture = decode_image(episode.encoded(path)[step], kind, path)
            assert np.abs(picture.reshape(-1, 3).astype(int) - truth.colour(int(step))).max() <= 3


def test_the_table_names_every_dataset_and_its_module():
    described = {dataset.name: module for module in DESCRIBED_IN.values() for dataset in module.DATASETS}
    assert described == DESCRIBED_IN
    assert FIXTURES.keys() == DATASETS.keys()


def test_descriptions_are_values():
    # Functions would print their addresses, and an index could not tell whether they still say the same.
    assert not [name for name, dataset in DATASETS.items() if " at 0x" in repr(dataset)]
    assert DATASETS["kuka"].arms == get_dataset("kuka").arms


def test_only_the_program_and_tests_use_fixtures():
    root = Path(__file__).parents[1]
    files = [*(root / "data_pipelines").rglob("*.py"), *(root / "dsvla_jax").rglob("*.py"), *root.glob("configs/*.py")]
    users = {
        str(file.relative_to(root))
        for file in files
        if "oxe.fixtures" in file.read_text()
        and file.relative_to(root).parts[:3] != ("data_pipelines", "oxe", "fixtures")
    }
    assert users == {"data_pipelines/oxe/__main__.py"}


def test_sources_are_versions_that_are_published():
    for dataset in DATASETS.values():
        bucket, _, place = dataset.source.partition("gs://gresearch/robotics/")
        if not bucket:
            folder, version = place.split("/")
            assert version == VERSIONS.get(folder, "0.1.0"), dataset.name


def test_fixtures_whose_writing_was_interrupted_are_written_again(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(writing, "_write_shard", stop)
        with pytest.raises(KeyboardInterrupt):
            write_fixtures(tmp_path, ["viola"])
    with pytest.raises(DataError, match=r"viola: build: expected features\.json here"):
        RldsBuild(tmp_path / "viola")
    write_fixtures(tmp_path, ["viola"])
    (build,) = (tmp_path / "viola").iterdir()
    written = build.stat().st_mtime_ns
    write_fixtures(tmp_path, ["viola"])
    assert len(list(episodes_of(build))) == 4
    assert build.stat().st_mtime_ns == written


def test_every_dataset_tells_a_hand_or_says_why_not():
    assert len(DATASETS) == 77 == len(FIXTURES)
    assert {name for name, dataset in DATASETS.items() if dataset.encoding == "joints"} == JOINTS
    assert {name for name, dataset in DATASETS.items() if dataset.encoding == "navigation"} == NAVIGATION
    assert {name: dataset.bgr for name, dataset in DATASETS.items() if dataset.bgr} == EXCHANGED
    for name, dataset in DATASETS.items():
        assert dataset.has_pose or dataset.encoding == "joints" or all(arm.action for arm in dataset.arms), name
        assert dataset.source.startswith(("gs://", "https://", "python -m data_pipelines.rlds.export")), name


@pytest.mark.parametrize(("mixture", "size"), [("rtx", 10), ("oxe_magic_soup", 23), ("oxe_magic_soup_plus", 27),
                                               ("oxe_magic_soup_plus_minus", 25)])  # fmt: skip
def test_named_mixtures(mixture, size):
    weights = get_mixture((mixture,))
    assert len(weights) == size
    assert not set(weights) - set(DATASETS)
    assert not {name for name in weights if DATASETS[name].encoding != "end_effector"}
    assert weights == MIXTURES[mixture]


def test_own_mixtures():
    assert get_mixture(("toto", "viola=2.5")) == {"toto": 1.0, "viola": 2.5}
    for names, message in (
        (("totto",), "unknown dataset or mixture 'totto': did you mean 'toto'"),
        (("rtx", "toto"), "rtx is a mixture and stands alone"),
        (("toto=heavy",), "expected NAME=WEIGHT with a number, got 'toto=heavy'"),
        (("toto=-1",), "expected a positive weight"),
        ((), "expected datasets or one of rtx"),
    ):
        with pytest.raises(UserError, match=message):
            get_mixture(names)


def rewritten(tmp_path, name, change):
    """The first episode of a fixture with one value of its first steps changed."""
    fixture = FIXTURES[name]
    episode = episode_of(fixture, known_episode(fixture.kind, fixture.arms, 5, 1))
    change(episode["steps"])
    write_build(tmp_path, name, features_of(fixture), {"train": [episode]}, 1)
    return next(episodes_of(tmp_path / name))


def test_not_finite_and_empty_episodes_are_refused(tmp_path):
    def spoil(steps):
        steps[2]["action"]["world_vector"] = np.array([0, np.nan, 0], np.float32)

    episode = rewritten(tmp_path, "toto", spoil)
    message = "record 0: steps/action/world_vector: expected finite numbers, got 1 NaN or infinite, the first at step 2"
    with pytest.raises(DataError, match=message):
        get_dataset("toto").motion(episode)
    episode = rewritten(tmp_path, "viola", lambda steps: steps.clear())
    with pytest.raises(DataError, match="record 0: steps: expected more than 0, got 0; leave it out with --skip-bad"):
        get_dataset("viola").motion(episode)


def test_relative_grippers_hold_their_state(tmp_path):
    def commands(steps):
        for step, value in zip(steps, (0.0, 0.0, -1.0, 0.05, 1.0), strict=True):
            step["action"]["gripper_closedness_action"] = np.array([value], np.float32)

    episode = rewritten(tmp_path, "fractal20220817_data", commands)
    # The first command opens, so it was closed before.
    np.testing.assert_array_equal(
        get_dataset("fractal20220817_data").motion(episode).gripper_command[:, 0], [0, 0, 1, 1, 0]
    )
