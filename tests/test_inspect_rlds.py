"""Looking at RLDS builds: what is printed and drawn of fixtures whose motions are known, and what is refused."""

import base64
import dataclasses
import re

import cv2
import fsspec
import numpy as np
import pytest
from tensorflow_datasets.core import features as tfds_features

from data_pipelines.inspect.__main__ import Options, describe, main
from data_pipelines.oxe.fixtures.builds.maniskill import camera_from_world
from data_pipelines.oxe.fixtures.write import known_episodes, write_fixture
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.rlds.writing import encode_image, write_build
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.suite_vocabulary import suite_tokenizer

NYU = "nyu_rot_dataset_converted_externally_to_rlds"
TWO_ARMS = "utokyo_xarm_bimanual_converted_externally_to_rlds"
MANISKILL = "maniskill_dataset_converted_externally_to_rlds"
EPISODES, STEPS = 5, 8
ENCODING = EncodingConfig(image_size=32, patch_size=16, style="compact", max_text_length=64, use_points=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("oxe")
    for name in (NYU, TWO_ARMS, MANISKILL, "cmu_stretch", "roboturk"):
        write_fixture(folder, name, EPISODES, STEPS)
    return folder


def config_for(folder, **changes):
    """Without variations, so that a sample is drawn alike wherever it is read."""
    plain = OxeConfig(folder=str(folder), mixture=(), image_size=32, crop=1.0, colour_variation=0.0)
    return dataclasses.replace(plain, **changes)


def look(folder, name, episodes=3, workspace_low=EncodingConfig.workspace_low, **changes):
    config = config_for(folder, **changes)
    return describe(Options(name, oxe=config, episodes=episodes, workspace_low=workspace_low))[0]


def table(page, caption):
    (found,) = [table for table in page.tables if table.caption.startswith(caption)]
    return {row[0]: dict(zip(found.columns[1:], row[1:], strict=True)) for row in found.rows}


def test_features_shards_counts_and_statistics_are_those_of_the_build(folder):
    page = look(folder, NYU)
    known = known_episodes(NYU, EPISODES, STEPS)
    steps = [episode.num_steps for episode in known]
    build = folder / NYU / "0.1.0"
    assert page.title == f"{build}: {EPISODES} usable episodes, {sum(steps) - EPISODES} samples"
    assert page.warnings == []
    features = table(page, "features")
    assert features["steps/action"] == {"type": "float32", "shape": "7"}
    assert features["steps/observation/image"] == {"type": "picture, uint8", "shape": "84 x 84 x 3"}
    assert features["steps/language_instruction"]["type"] == "text"
    shards = table(page, "shards, tfrecord")["train"]
    size = sum(path.stat().st_size for path in build.glob("*.tfrecord-*")) / 1e6
    assert (shards["shards"], shards["not there"], shards["episodes"]) == ("2", "0", str(EPISODES))
    assert (shards["episodes a shard"], shards["MB"]) == ("2 to 3", f"{size:.2f}")
    (counts,) = table(page, "counts of split train").values()
    assert counts["steps used"] == str(sum(steps))
    assert counts["least, median, most"] == f"{min(steps)}, {int(np.median(steps))}, {max(steps)}"
    assert counts["phrases"] == str(len({episode.instruction for episode in known}))
    statistics = table(page, "standardised state and action")
    heights = np.concatenate([episode.arms[0].position[:, 2] for episode in known])
    told = [float(statistics["pose z (m)"][name]) for name in ("mean", "deviation", "least", "median", "most")]
    truth = [heights.mean(), heights.std(), heights.min(), np.median(heights), heights.max()]
    np.testing.assert_allclose(told, truth, rtol=0.006)
    moves = np.concatenate([np.linalg.norm(np.diff(x.arms[0].position, axis=0), axis=1) for x in known])
    assert float(statistics["reached step (m)"]["mean"]) == pytest.approx(moves.mean(), rel=0.006)
    commands = np.concatenate([episode.arms[0].open for episode in known])
    assert float(statistics["gripper told to be open"]["mean"]) == pytest.approx(commands.mean(), rel=0.006)


def pictures_of(text):
    data = re.findall(r"base64,([^\"]+)\"", text)
    decoded = [cv2.imdecode(np.frombuffer(base64.b64decode(x), np.uint8), cv2.IMREAD_COLOR_RGB) for x in data]
    return [np.asarray(picture) for picture in decoded]


@pytest.mark.parametrize("target", ["relative", "absolute"])
def test_pictures_prompts_and_answers_are_those_of_training(folder, tmp_path, target):
    config = config_for(folder, target=target, mixture=(NYU, "cmu_stretch=0.5"), streams=1)
    main(Options(NYU, page=tmp_path / "page.html", episodes=EPISODES, oxe=config))
    text = (tmp_path / "page.html").read_text()
    loader = OxeLoader(config, ENCODING, suite_tokenizer(), batch_size=200, seed=0, num_threads=0, progress=False)
    batch, tokenizer, seen = next(loader), suite_tokenizer(), {}
    for row, (tokens, mask, answer) in enumerate(
        zip(batch.text.tokens, batch.text.mask, batch.answer_mask, strict=True)
    ):
        prompt = tokenizer.decode([int(token) for token in tokens[mask & ~answer]][1:])
        seen[prompt, tokenizer.decode([int(token) for token in tokens[answer]][:-1])] = batch.pictures.rgb[row, 0]
    lines = [
        tokenizer.decode(tokenizer.encode(line.strip()))
        for block in re.findall(r"<pre>(.*?)</pre>", text, re.S)
        for line in block.splitlines()
    ]
    shown = list(zip(lines[::2], lines[1::2], strict=True))
    assert len(shown) == sum(min(episode.num_steps - 1, 10) for episode in known_episodes(NYU, EPISODES, STEPS))
    strips = [picture for picture in pictures_of(text) if picture.shape[0] == 32]
    assert len(strips) == EPISODES
    frames = [strip[:, start : start + 32] for strip in strips for start in range(0, strip.shape[1], 34)]
    for sample, frame in zip(shown, frames, strict=True):
        np.testing.assert_array_equal(frame, seen[sample])


def test_the_range_of_displacements_is_that_of_the_mixture(folder):
    config = config_for(folder, mixture=(NYU, "cmu_stretch=0.5"), streams=1)
    loader = OxeLoader(config, ENCODING, suite_tokenizer(), batch_size=1, seed=0, progress=False)
    assert loader.scale is not None
    told = table(look(folder, NYU, mixture=config.mixture), "targets: displacements to the pose 1 s ahead")
    alone = table(look(folder, NYU), "targets: displacements")
    for row, low, high in zip(told, loader.scale.low, loader.scale.high, strict=True):
        assert told[row]["binned from"] == f"{low:.4f}"
        assert told[row]["binned to"] == f"{high:.4f}"
        assert alone[row]["binned from"] == alone[row]["1 %"] == told[row]["1 %"]
    assert told != alone
    with pytest.raises(UserError, match=r"mixture: .*roboturk/0.1.0 is none of .*cmu_stretch"):
        look(folder, "roboturk", mixture=("cmu_stretch",))


def test_two_arms_have_their_own_rows(folder):
    rows = table(look(folder, TWO_ARMS), "standardised")
    known = known_episodes(TWO_ARMS, EPISODES, STEPS)
    for arm, side in enumerate(("left", "right")):
        mean = np.concatenate([episode.arms[arm].position[:, 1] for episode in known]).mean()
        assert float(rows[f"{side} pose y (m)"]["mean"]) == pytest.approx(mean, rel=0.006)


def test_calibrated_depth_gives_clouds_and_rings(folder):
    page = look(folder, MANISKILL, image_size=64, workspace_low=(-2.0, -2.0, -0.5))
    assert page.warnings == []
    for section in page.sections:
        captions = [caption for caption, _ in section.pictures]
        assert [caption.split(":")[0] for caption in captions[2:]] == ["cloud from above", "cloud from the side"]
        assert captions[0].endswith("rings: where to go next")
    # All of the first episode's samples look ahead to its last pose, as long as an episode is shorter than a second.
    known = known_episodes(MANISKILL, EPISODES, STEPS)[0]
    place = camera_from_world() @ np.append(known.arms[0].position[-1], 1)
    u, v = ((np.array([200, 200]) * place[:2] / place[2] + 128.5) / 4 - 0.5).round().astype(int)
    strip = page.sections[0].pictures[0][1]
    np.testing.assert_allclose(strip[v, u].astype(int), (255, 0, 200), atol=2)
    low = look(folder, MANISKILL).warnings
    (warning,) = [warning for warning in low if warning.startswith("3D input: ")]
    assert "in the workspace from (-1.5, -1.5, 0.76) to (1.5, 1.5, 3.0), got 0 of" in warning
    assert "--encoding.workspace-low" in warning


def test_what_cannot_be_trained_on_is_still_shown(folder, tmp_path):
    page = look(folder, "roboturk", target="absolute")
    assert "roboturk cannot be trained on with absolute targets: it tells no poses" in page.warnings[0]
    assert "action x (m)" in table(page, "standardised state and action")
    assert len(page.sections) == 3

    image = tfds_features.Image(shape=(None, None, 3), encoding_format="png")
    step = {"view": image, "force": tfds_features.Tensor(shape=(2,), dtype=np.float32), "words": tfds_features.Text()}

    def episode():
        pictures = [encode_image(np.full((8 + i, 12, 3), 9, np.uint8), ".png") for i in range(4)]
        return {
            "steps": [
                {"view": x, "force": np.array([i, 2], np.float32), "words": "push"} for i, x in enumerate(pictures)
            ]
        }

    features = tfds_features.FeaturesDict({"steps": tfds_features.Dataset(step)})
    write_build(tmp_path, "own_robot", features, {"train": [episode(), episode()]}, 1)
    page = look(tmp_path, str(tmp_path / "own_robot"))
    assert page.title == f"{tmp_path}/own_robot/0.1.0: 2 episodes"
    assert "own_robot is not in the registry" in page.warnings[0]
    values = table(page, "stored values, of 2 episodes")
    assert values["steps/force [0]"]["mean"] == "1.5"
    assert values["steps/force [1]"]["deviation"] == "0"
    assert page.sections[0].lines == ["steps/words: push"]
    assert page.sections[0].pictures[0][1].shape == (8, 4 * 12 + 3 * 2, 3)


def test_a_renamed_folder_and_a_url_are_found(folder, tmp_path, monkeypatch):
    write_fixture(tmp_path, "bridge_dataset", EPISODES, STEPS)
    (tmp_path / "bridge_orig").symlink_to(tmp_path / "bridge_dataset", target_is_directory=True)
    for name in ("bridge_dataset", "bridge_orig"):
        page = look(tmp_path, str(tmp_path / name / "0.1.0"))
        assert table(page, f"what the registry knows of {name}")

    memory = fsspec.filesystem("memory")
    for file in (folder / "cmu_stretch" / "0.1.0").glob("*[!l]"):
        memory.pipe_file(f"/look/cmu_stretch/0.1.0/{file.name}", file.read_bytes())
    monkeypatch.chdir(tmp_path)
    main(Options("memory://look/cmu_stretch", oxe=config_for(folder, cache=str(tmp_path / "cache"))))
    assert "memory://look/cmu_stretch/0.1.0: 5 usable episodes" in (tmp_path / "inspect.html").read_text()


def test_damage_stops_or_is_listed(tmp_path):
    write_fixture(tmp_path, "cmu_stretch", EPISODES, STEPS)
    first, _ = sorted((tmp_path / "cmu_stretch" / "0.1.0").glob("*.tfrecord-*"))
    data = bytearray(first.read_bytes())
    data[500] ^= 255
    first.write_bytes(data)
    with pytest.raises(DataError, match="00000-of-00002, record 0: CRC of the record"):
        look(tmp_path, "cmu_stretch")
    page = look(tmp_path, "cmu_stretch", skip_bad=True)
    assert "4 usable episodes" in page.title
    assert re.search("left out: .*00000-of-00002, record 0: CRC of the record", page.warnings[0])


def test_what_is_not_there_is_said_in_words(folder, tmp_path):
    with pytest.raises(UserError, match=r"unknown dataset 'cmu_strech': did you mean 'cmu_stretch'\?"):
        look(folder, "cmu_strech")
    with pytest.raises(UserError, match="toto: no such dataset; copy it there from gs://gresearch/robotics/toto"):
        look(folder, "toto")
    with pytest.raises(DataError, match=r"nowhere: folder: expected demonstrations or an RLDS build, got no such fol"):
        look(folder, str(tmp_path / "nowhere"))
    with pytest.raises(DataError, match=r"got 5, such as cmu_stretch; name one of them: .*inspect cmu_stretch --oxe"):
        look(folder, str(folder))
    with pytest.raises(DataError, match="splits: expected test, got train; choose one of those there are"):
        look(folder, NYU, split="test")
