"""The box of the cloud follows the data: fitted, or refused with the box that fits, before a run holds anything."""

import dataclasses
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import tyro
from tensorflow_datasets.proto import tf_example_pb2

import train
from data_pipelines.episodes import EpisodeReader, write_episodes
from data_pipelines.first_look import (
    dataset_views,
    fit_workspace,
    frames_of,
    look_at_demonstrations,
    look_at_mixture,
    views_of,
)
from data_pipelines.oxe.fixtures.write import write_fixture
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.oxe.mixture import open_mixture
from data_pipelines.recording import Recording, make_demonstration
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.tfrecord import write_records
from data_pipelines.rlds.writing import encode_image
from data_pipelines.training_data import open_training_data, with_workspace
from data_pipelines.workspace import View, count_points, fit_box, require_points
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.experiment import Experiment, save_experiment
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.observation_checks import MIN_WORKSPACE_SHARE
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training.distributed import Watchdog
from dsvla_jax.training.run_folder import require_same_experiment
from dsvla_jax.training.sharding import BatchPart
from tests import rlbench_files as files
from tests.small import small_encoding, small_language, small_vision

MANISKILL = "maniskill_dataset_converted_externally_to_rlds"
DEFAULT = EncodingConfig()


def episode(raised=0.0, task="lamp_on", **changes):
    """The synthetic RLBench episode, its table `raised` metres above RLBench's."""
    pose, gripper, _ = files.trajectory(frames=12)
    rgb, depth = files.render(48)
    up = np.array([0, 0, raised, 0, 0, 0, 0])
    recording = Recording(
        task=task,
        instruction="close the box",
        rgb=[rgb] * 12,
        depth=[np.where(depth < 3, depth, 0)] * 12,
        intrinsics=files.intrinsics(48),
        world_from_camera=files.CAMERA + np.pad([[raised]], ((2, 1), (3, 0))),
        pose=pose + up,
        gripper_open=gripper,
    )
    return make_demonstration(dataclasses.replace(recording, **changes), [(0, 4), (4, 9), (9, 11)], 0)


def views(folder, episodes):
    write_episodes(folder, episodes)
    return [view for _, some in views_of(frames_of(EpisodeReader(folder))) for view in some]


@pytest.mark.parametrize("raised", [0.0, -files.TABLE])
def test_a_fitted_box_begins_above_the_table_and_holds_the_hands_and_the_object(tmp_path, raised):
    seen = views(tmp_path, [episode(raised)])
    box = fit_box(seen)
    assert box is not None
    low, high = map(np.array, box)
    table = files.TABLE + raised
    assert table < low[2] <= table + 0.01
    hands = np.concatenate([view.hands for view in seen])
    assert np.all(hands > low)
    assert np.all(hands < high)
    fitted = dataclasses.replace(DEFAULT, workspace_low=box[0], workspace_high=box[1])
    standard = count_points(views(tmp_path / "standard", [episode()]), DEFAULT)
    # The same thing is seen, wherever the world's origin is.
    assert count_points(seen, fitted).inside == pytest.approx(standard.inside, rel=0.1)


def test_no_box_is_offered_where_the_camera_is_wrong():
    depth, inverse = np.full((20, 20), 1.0), np.linalg.inv(files.CAMERA)
    inverse[:3, 3] += 3
    view = View(depth, files.intrinsics(20), inverse, np.array([[0.3, 0.0, 0.9]]))
    assert fit_box([view]) is None
    with pytest.raises(UserError, match=r"No box around the hands holds as many: hands are between .* readings are"):
        require_points("mine", [view], DEFAULT)


def test_each_task_of_a_folder_must_be_in_the_workspace(tmp_path):
    write_episodes(tmp_path, [episode(), episode(-files.TABLE, task="push_box")])
    reader = EpisodeReader(tmp_path)
    assert [len(reader.frames_of(task)) for task in reader.tasks] == [3, 3]
    with pytest.raises(UserError, match=rf"{tmp_path}, push_box: depth: expected at least 2% .*got 0 of \d+ readings"):
        look_at_demonstrations(reader, DEFAULT)
    flat = dataclasses.replace(DEFAULT, use_points=False)
    assert "points" not in look_at_demonstrations(reader, flat)


def test_the_first_line_tells_words_components_and_points(tmp_path):
    write_episodes(tmp_path, [episode(), episode()])
    line = look_at_demonstrations(EpisodeReader(tmp_path), DEFAULT)
    expected = count_points(views(tmp_path / "again", [episode(), episode()]), DEFAULT)
    assert line == (
        f"{tmp_path}: 2 of 2 episodes have an instruction; 2 of 8 components of the targets vary (constant: x, y, qx, "
        f"qy, qz, qw); {expected.inside / expected.views:.0f} of 576 points in the workspace (mean of 6 samples)"
    )


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"depth_png": "zeros"}, "depth: expected some readings, got 0 everywhere"),
        ({"intrinsics": 10.0}, "intrinsics: expected a centre in 48 x 48 pixels"),
        ({"world_from_camera": 2.0}, "world_from_camera: expected a rotation"),
    ],
)
def test_pictures_and_cameras_of_a_folder_are_checked_before_training(tmp_path, damage, message):
    good = episode()
    ((field, change),) = damage.items()
    value = getattr(good, field)
    if field == "depth_png":
        value = tuple(encode_image(np.zeros((48, 48, 1), np.uint16), ".png").getvalue() for _ in value)
    else:
        value = value.copy()
        value[..., :2, 0 if field == "world_from_camera" else 2] *= change
    write_episodes(tmp_path, [dataclasses.replace(good, **{field: value})])
    with pytest.raises(DataError, match=message):
        look_at_demonstrations(EpisodeReader(tmp_path), DEFAULT)


@pytest.fixture(scope="module")
def oxe(tmp_path_factory):
    folder = tmp_path_factory.mktemp("oxe")
    write_fixture(folder, MANISKILL, 9, 9)
    return OxeConfig(str(folder), (MANISKILL,), image_size=32, streams=1)


def test_an_oxe_dataset_is_refused_outside_of_the_workspace_and_fitted_on_request(oxe):
    datasets, _ = open_mixture(oxe, progress=False)
    with pytest.raises(UserError, match=r"got 0 of \d+ readings") as caught:
        look_at_mixture(datasets, DEFAULT)
    fitted = fit_workspace(DataConfig(), oxe, DEFAULT, suite_tokenizer())
    (line,) = look_at_mixture(datasets, fitted)
    assert line.startswith(f"{MANISKILL}: 9 of 9 episodes have an instruction; ")
    assert line.endswith(" of 256 points in the workspace (mean of 64 samples)")
    # What the message says can be pasted.
    pasted = str(caught.value).partition("The box around the hands is ")[2].partition(", which")[0].split()
    arguments = [word.replace("--encoding.", "--") for word in pasted]
    assert tyro.cli(EncodingConfig, args=arguments) == fitted
    count = require_points(MANISKILL, dataset_views(datasets[0]), fitted)
    assert count.inside >= MIN_WORKSPACE_SHARE * count.readings


def test_without_calibrated_depth_there_is_nothing_to_fit(tmp_path):
    write_fixture(tmp_path, "cmu_stretch", 2, 6)
    config = OxeConfig(str(tmp_path), ("cmu_stretch",), streams=1)
    with pytest.raises(UserError, match="expected one dataset with calibrated depth, got 0"):
        fit_workspace(DataConfig(), config, DEFAULT, suite_tokenizer())


@pytest.mark.parametrize("counts", [0, 65535])
def test_depth_without_readings_or_in_other_units_stops_or_is_left_out(tmp_path, counts):
    write_fixture(tmp_path, MANISKILL, 6, 6)
    build = RldsBuild(tmp_path / MANISKILL)
    shard = build.shards("train")[0]
    opened = build.open_shard(shard)
    records = [opened.read(number) for number in range(len(opened))]
    example = tf_example_pb2.Example.FromString(records[1])  # pyright: ignore[reportAttributeAccessIssue]
    picture = encode_image(np.full((256, 256, 1), counts, np.uint16), ".png").getvalue()
    example.features.feature["steps/observation/depth"].bytes_list.value[2] = picture
    write_records(Path(shard.path), [records[0], example.SerializeToString(), *records[2:]])
    config = OxeConfig(str(tmp_path), (MANISKILL,), image_size=32, streams=1)
    encoding = EncodingConfig(image_size=32, patch_size=16, style="compact", max_text_length=64)

    def make(**options):
        changed = dataclasses.replace(config, **options)
        return OxeLoader(changed, encoding, suite_tokenizer(), batch_size=4, seed=0, num_threads=0, progress=False)

    loader = make()
    with pytest.raises(DataError, match=r"record 1, step 2, .*: depth: expected (some readings|metres)"):
        list(islice(loader, 20))
    loader = make(skip_bad=True)
    for _ in range(20):
        assert (next(loader).pictures.depth > 0).any(axis=(1, 2, 3)).all()
    assert len(loader.left_out) == 1


def experiment_for(folder, **changes):
    tokenizer = suite_tokenizer()
    return Experiment(
        encoding=small_encoding(max_text_length=56),
        model=ModelConfig(vision=small_vision(), language=small_language(tokenizer.vocab_size)),
        data=DataConfig(source="episodes", folder=str(folder), tasks=("all",)),
        **{"steps": 1, "batch_size": 2, **changes},
    )


def test_a_run_is_refused_before_it_has_a_config_and_keeps_the_box_that_was_fitted(tmp_path, capsys):
    write_episodes(tmp_path / "low", [episode(-files.TABLE)])
    run, tokenizer = tmp_path / "run", suite_tokenizer()
    with pytest.raises(UserError, match=r"--encoding.workspace-low .* --encoding.workspace-high"):
        train.main(experiment_for(tmp_path / "low"), run, Watchdog(run / "processes"))
    assert not (run / "config.json").exists()

    asked = experiment_for(tmp_path / "low", fit_workspace=True)
    fitted = with_workspace(asked, run, tokenizer)
    assert 0 < fitted.encoding.workspace_low[2] < 0.01
    open_training_data(fitted, tokenizer, BatchPart(0, 1, 2))
    assert "points in the workspace (mean of 3 samples)" in capsys.readouterr().out
    (run / "checkpoints" / "1").mkdir(parents=True)
    save_experiment(run / "config.json", fitted)

    # The same command resumes with the same box, though the data have grown.
    write_episodes(tmp_path / "low", [episode(-files.TABLE), episode(-files.TABLE - 0.3)])
    again = with_workspace(asked, run, tokenizer)
    assert again == fitted
    require_same_experiment(run, again)
    assert with_workspace(asked, tmp_path / "another", tokenizer) != fitted
