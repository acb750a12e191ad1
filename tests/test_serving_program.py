"""`python -m dsvla_jax.serving` and examples/robot_client.py: options, and obeying what a run learned from."""

import contextlib
import dataclasses
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from configs.tiny import config as tiny_config
from data_pipelines.learned_from import learned_from, learned_from_oxe
from data_pipelines.rlbench.__main__ import Settings, import_demonstrations
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.command_line import parse_options
from dsvla_jax.data_config import DataConfig, LearnedFrom, OxeConfig
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import save_experiment
from dsvla_jax.perception.simulator import SegmentationKeypoints
from dsvla_jax.policy import load_policy_config, save_policy_config
from dsvla_jax.serving.__main__ import Options, build_server
from dsvla_jax.serving.requests import Expected, parse_request
from dsvla_jax.sim.seeds import episode_keys
from examples.robot_client import simulated_robot
from tests import rlbench_files as files
from tests.run_folders import NO_NOTES, variables_only
from tests.serving import tiny_policy

OWN = LearnedFrom("demonstrations", "recorded", (48, 64), (2,), ("lift_box",))


def write_run(run: Path, learned: LearnedFrom | None) -> Path:
    policy = tiny_policy()
    run.mkdir()
    with contextlib.closing(RunCheckpoints(run)) as checkpoints:
        checkpoints.save(1, variables_only(policy.variables), NO_NOTES)
    save_policy_config(run, dataclasses.replace(policy.config, learned_from=learned), policy.tokenizer)
    return run


@pytest.fixture(scope="module")
def run_of_own_demonstrations(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "mine", OWN)


def test_a_run_of_own_demonstrations_is_served_with_their_size_and_arms(run_of_own_demonstrations):
    server = build_server(Options(run_of_own_demonstrations))
    assert server.expected.image_sizes == ((48, 64),)
    assert server.expected.arms == (2,)
    assert server.metadata["learned_from"]["tasks"] == ("lift_box",)
    assert server.metadata["frame"] == "the world frame of the demonstrations"
    other = build_server(Options(run_of_own_demonstrations, image_size=("32x32", "40x40"), arms=(1,)))
    assert (other.expected.image_sizes, other.expected.arms) == (((32, 32), (40, 40)), (1,))


def test_a_run_of_an_older_version_is_served_as_its_config_says(tmp_path):
    run = write_run(tmp_path / "old", None)
    stored = (run / "policy.json").read_text()
    assert '"learned_from": null' in stored
    (run / "policy.json").write_text(stored.replace(',\n  "learned_from": null', ""))
    assert load_policy_config(run).learned_from is None
    with pytest.raises(UserError, match=r"does not say what it learned from; .*--image-size 480x640 --arms 1"):
        build_server(Options(run))
    assert build_server(Options(run, image_size=("48x48",), arms=(1,))).metadata["learned_from"] is None
    save_experiment(run / "config.json", tiny_config())
    metadata = build_server(Options(run)).metadata
    assert metadata["image_sizes"] == [[96, 96]]
    assert metadata["arms"] == [1, 2]
    assert metadata["learned_from"]["keypoints"] == "segmentation"
    own = dataclasses.replace(tiny_config(), data=DataConfig(source="episodes", tasks=("lift_box",)))
    save_experiment(run / "config.json", own)
    with pytest.raises(UserError, match="does not say what it learned from"):
        build_server(Options(run))


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--batch", "0"], "batch: expected at least 1, at most 128, got 0"),
        (["--clients", "0"], "clients: expected at least 1"),
        (["--instruction-tokens", "0"], "instruction_tokens: expected at least 1"),
        (["--request-seconds", "-1"], "request_seconds: expected"),
        (["--idle-seconds", "nan"], "idle_seconds: expected"),
        (["--port", "70000"], "port: expected at least 1, at most 65535, got 70000"),
        (["--port", "0"], "port: expected at least 1"),
        (["--arms", "3"], r"arms: expected at least 1, at most 2, got \(3,\)"),
        (["--box-threshold", "7"], "box_threshold: expected at least 0, at most 1"),
    ],
)
def test_an_option_out_of_its_range_is_named(options, complaint):
    with pytest.raises(UserError, match=complaint):
        parse_options(Options, args=["runs/none", *options])


@pytest.mark.parametrize("size", ["0x0", "96", "96x", "-1x5", "99999x10", "²x5", "8x8"])
def test_a_size_that_pictures_cannot_have_is_named(size, run_of_own_demonstrations):
    with pytest.raises(UserError, match="--image-size: "):
        build_server(Options(run_of_own_demonstrations, image_size=(size,)))


def test_a_token_file_is_read_as_people_write_it(tmp_path, run_of_own_demonstrations):
    file = tmp_path / "token"
    options = Options(run_of_own_demonstrations, token_file=file)
    file.write_bytes(b"\xef\xbb\xbfsecret\r\n")  # Windows' editors begin so
    assert build_server(options)._may_enter(["Bearer secret"])
    for content in ("schlüssel".encode("latin-1"), "schlüssel".encode(), "secret".encode("utf-16"), b"", b"a\nb"):
        file.write_bytes(content)
        with pytest.raises(UserError, match=r"token: expected one line of printable ASCII"):
            build_server(options)


def test_demonstrations_say_what_a_policy_learns_from(tmp_path):
    files.write_dataset(tmp_path / "source", ["lamp_on"], episodes=1, size=24, frames=12, descriptions=["press it"])
    for settings, expected in (
        (Settings(), LearnedFrom("demonstrations", "recorded", (24, 24), (1,), ("lamp_on",), ("front",))),
        (Settings(keypoints="none"), LearnedFrom("demonstrations", "none", (24, 24), (1,), ("lamp_on",), ("front",))),
    ):
        folder = tmp_path / settings.keypoints
        import_demonstrations(tmp_path / "source", folder, settings, progress=False)
        data = DataConfig(source="episodes", folder=str(folder), tasks=("all",))
        assert learned_from(data, use_keypoints=True) == expected
        assert learned_from(data, use_keypoints=False).keypoints == "none"
    assert learned_from_oxe(OxeConfig(mixture=("viola",)), [1, 2, 1]) == LearnedFrom(
        "oxe", "none", (224, 224), (1, 2), ("viola",)
    )


def metadata_of(**changes):
    learned = {"source": "simulator", "keypoints": "segmentation", "tasks": ["lamp_on"], **changes}
    return {
        "name": "r",
        "learned_from": learned,
        "arms": [1],
        "image_sizes": [[48, 64], [64, 64]],
        "needs_keypoints": True,
    }


def test_the_example_sends_the_keypoints_that_the_policy_learned_with():
    found = simulated_robot(metadata_of(), "close_fridge", 0)
    first, again = found.observe(), found.observe()
    assert first["rgb"].shape == (64, 64, 3)
    np.testing.assert_array_equal(first["keypoints"], again["keypoints"])
    state = found.environment.reset(episode_keys(0, "eval", "close_fridge", 0, 1))
    own = np.asarray(found.environment.keypoints(state))[0]
    assert np.abs(first["keypoints"] - own).max() > 0.05
    seen, _ = SegmentationKeypoints(found.environment, state)(state, found.environment.observe(state))
    np.testing.assert_array_equal(first["keypoints"], seen[0])
    # What the simulator sends passes every check of the server.
    expected = Expected(((64, 64),), (1,), tiny_config().encoding)
    assert parse_request({**first, "prompt": found.prompt}, expected).points


@pytest.mark.parametrize(
    ("changes", "task", "complaint"),
    [
        ({"source": "oxe", "tasks": ["viola"]}, "lamp_on", r"learned from oxe \(viola\), not in the simulator"),
        ({"source": "demonstrations", "tasks": ["lift_box"]}, "lamp_on", "write a class with `observe` and `move`"),
        ({}, "bimanual_lift_ball", r"bimanual_lift_ball is for 2 arm\(s\), the server's policy for 1"),
        ({}, "lamp_onn", "lamp_onn"),
    ],
)
def test_the_example_refuses_what_the_policy_did_not_learn(changes, task, complaint):
    with pytest.raises(UserError, match=complaint):
        simulated_robot(metadata_of(**changes), task, 0)


def test_the_example_runs_as_a_script_from_anywhere(tmp_path):
    """As README says, in a clone that is not installed; without a server it ends in one line with the fix."""
    script = Path(__file__).parent.parent / "examples" / "robot_client.py"
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, str(script), "--port", str(port)]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"error: ws://127.0.0.1:{port}: ")
    assert "start a server (python -m dsvla_jax.serving RUN)" in ended.stderr


def test_the_only_camera_has_the_name_that_it_had(tmp_path):
    """In the metadata of a server, and in a policy.json of an earlier version."""
    run = write_run(tmp_path / "run", dataclasses.replace(OWN, cameras=("wrist",)))
    metadata = build_server(Options(run)).metadata
    assert metadata["learned_from"]["camera"] == "wrist"
    assert metadata.keys() & {"cameras"} == metadata["learned_from"].keys() & {"cameras"} == set()
    stored = json.loads((run / "policy.json").read_text())
    for earlier, names in (("wrist", ("wrist",)), ("", ())):
        stored["learned_from"].pop("cameras", None)
        stored["learned_from"]["camera"] = earlier
        (run / "policy.json").write_text(json.dumps(stored))
        learned = load_policy_config(run).learned_from
        assert learned is not None
        assert learned.cameras == names


def test_the_example_sends_the_pictures_of_the_policys_cameras():
    robot = simulated_robot({**metadata_of(), "cameras": ["wrist", "front"]}, "close_fridge", 0)
    sent = robot.observe()
    assert (sent["rgb"].shape, sent["intrinsics"].shape) == ((2, 64, 64, 3), (2, 3, 3))
    expected = Expected(((64, 64),), (1,), tiny_config().encoding, cameras=("wrist", "front"))
    assert parse_request({**sent, "prompt": robot.prompt}, expected).points
