"""The policy server: the wire format, answers that are never crossed, and requests that mean no good."""

import asyncio
import concurrent.futures
import contextlib
import dataclasses
import http.client
import socket
import struct
import time

import jax
import msgpack
import numpy as np
import pytest
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidStatus

from dsvla_jax.data_config import LearnedFrom
from dsvla_jax.encoding.prompts import parse_answer
from dsvla_jax.geometry.cameras import front_camera, unproject
from dsvla_jax.perception.keypoints import Sighting
from dsvla_jax.perception.simulator import suite_phrases
from dsvla_jax.serving.batching import answer_batch
from dsvla_jax.serving.client import ConnectionFailed, PolicyClient, ServerError
from dsvla_jax.serving.messages import MAX_CONTAINERS, MessageError, pack, unpack
from dsvla_jax.serving.requests import BadRequest, Expected, check_first_keypoints, parse_request
from dsvla_jax.serving.server import Perception
from dsvla_jax.serving.session import Session
from tests.golden import serving as golden
from tests.serving import SIZE, observation, running, small_server, tiny_policy


@pytest.fixture(scope="module")
def policy():
    return tiny_policy()


@pytest.fixture(scope="module")
def running_server(policy):
    with running(lambda: small_server(policy)) as server_and_port:
        yield server_and_port


@pytest.fixture
def client(running_server):
    with PolicyClient(port=running_server[1]) as connected:
        yield connected


def get(port: int, path: str, **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    return response.status, response.read().decode()


def ask(port: int, seed: int) -> dict:
    with PolicyClient(port=port) as client:
        return client.infer(observation(seed))


def expected_text(server, policy, seed: int) -> str:
    """What the policy answers by itself, without a server, to the first request of an episode."""
    request = parse_request(observation(seed), server.expected)
    question, _ = asyncio.run(server._question(request, Session()))
    return answer_batch(policy, [question])[0].text


def assert_same(got, expected) -> None:
    if isinstance(expected, dict):
        assert got.keys() == expected.keys()
        for key, value in expected.items():
            assert_same(got[key], value)
    elif isinstance(expected, np.ndarray | np.generic):
        assert got.dtype == expected.dtype
        np.testing.assert_array_equal(got, expected)
    else:
        assert got == expected


def test_messages_are_those_of_openpi_client():
    written = (golden.HERE / "openpi_message.msgpack").read_bytes()
    assert_same(unpack(written), golden.message())
    assert pack(golden.message()) == written


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"not msgpack at all",
        pack({"rgb": np.zeros(4)})[:-3],
        pack(1) + b"more",
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "O", b"shape": [0]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"1234", b"dtype": "<f4", b"shape": [2]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "<f4", b"shape": [2**40, 2**40, 0]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "<f4", b"shape": [-1]}),
        msgpack.packb({b"__ndarray__": True}),
        msgpack.packb({b"__npgeneric__": True, b"dtype": "<f4", b"data": "x"}),
        msgpack.packb({b"__npgeneric__": True, b"dtype": "u1", b"data": 300}),
        msgpack.packb([[]] * (MAX_CONTAINERS + 1)),
        b"\x91" * 4000 + b"\xc0",
        msgpack.packb(msgpack.ExtType(1, b"code")),
        b"\xdd\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
    ],
)
def test_what_is_no_message_is_refused(data):
    try:
        value = unpack(data)
    except MessageError:
        return
    # An empty array is well-formed, however large its other sizes.
    assert isinstance(value, np.ndarray)
    assert value.size == 0


def in_millimetres(camera):
    matrix = np.array(camera.world_from_camera)
    matrix[:3, 3] *= 1000
    return matrix


def upside_down(camera):
    """With the axes of OpenGL: y up, looking along -z."""
    return np.asarray(camera.world_from_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("prompt", "", "prompt: expected 1 to"),
        ("prompt", "x" * 2000, "prompt: expected 1 to"),
        ("prompt", 3, "prompt: expected 1 to"),
        ("rgb", np.zeros((SIZE, SIZE, 3), np.float32), r"rgb: expected a uint8 array \(32, 32, 3\), got float32"),
        ("rgb", np.zeros((64, 64, 3), np.uint8), "--image-size"),
        ("rgb", None, "rgb: expected a uint8 array"),
        ("depth", np.ones((SIZE, SIZE), np.uint16), "divide millimetres by 1000"),
        ("depth", np.ones((SIZE, SIZE + 1)), r"depth: .* got shape \(32, 33\)"),
        ("depth", np.zeros((SIZE, SIZE)), "depth: expected some readings.*check that the depth stream was on"),
        ("depth", np.full((SIZE, SIZE), np.nan), "depth: expected some readings"),
        ("depth", np.full((SIZE, SIZE), 1000.0), "depth: expected metres.*divide by 1000"),
        ("depth", np.full((SIZE, SIZE), -1.0), "depth: expected 0 to"),
        ("depth", np.pad([[1.2]], ((16, 15), (16, 15))), "depth: expected at least 4 points.*got 1 of 256 pixels"),
        ("depth", np.full((SIZE, SIZE), 6.0), "readings in the workspace.*got 0 of 256.*in front of the camera"),
        ("intrinsics", np.zeros((3, 3)), "intrinsics: expected"),
        ("intrinsics", np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1.0]]), "a centre in 32 x 32 pixels"),
        ("intrinsics", np.array([[-40, 0, 16], [5, -40, 16], [0, 0, 1.0]]), "intrinsics: expected a pinhole"),
        ("intrinsics", np.array([[-40, 0, 0], [0, -40, 0], [16, 16, 1.0]]), "intrinsics: expected a pinhole"),
        ("world_from_camera", in_millimetres(front_camera(SIZE)), "world_from_camera: expected a place in metres"),
        ("world_from_camera", upside_down(front_camera(SIZE)), "readings in the workspace"),
        ("intrinsics", np.eye(4), r"got shape \(4, 4\)"),
        ("world_from_camera", 2 * np.eye(4), "world_from_camera: expected a rotation"),
        ("world_from_camera", np.diag([1.0, 1.0, -1.0, 1.0]), "world_from_camera: expected a rotation"),
        ("pose", np.zeros((2, 7)), "expected 1 arm"),
        ("pose", [[0.2, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0]], "pose: expected a unit quaternion"),
        ("pose", [[0.2, 0.0, 1.0, 0.0, 0.0, 0.0, 1.05]], "pose: expected a unit quaternion"),
        ("pose", [[0.2, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]], "pose: expected a unit quaternion"),
        ("pose", [[200.0, 0.0, 1000.0, 0.0, 0.0, 0.0, 1.0]], "outside the workspace"),
        ("pose", [[np.nan] * 7], "pose: expected finite"),
        ("pose", [[0.2], [0.1, 0.3]], "pose: expected float"),
        ("pose", [["a"] * 7], "pose: expected float"),
        ("gripper_open", np.ones(2), r"gripper_open: .* got shape \(2,\)"),
        *[("gripper_open", [x], r"gripper_open: expected 0 \(closed\) or 1 \(open\)") for x in (7, -3, 255, 0.08)],
        ("keypoints", np.ones((1, 0, 3)), "K = 0"),
        ("keypoints", np.ones((1, 17, 3)), "K = 17"),
        ("keypoints", np.ones((2, 1, 3)), "keypoints: expected"),
        ("keypoints", [[[0.0, 0.0, 50.0]]], "outside the workspace"),
        ("rgb", np.zeros((1, SIZE, SIZE, 3), np.uint8), "send one picture of each camera, without an axis"),
        ("keypoint", np.ones((1, 3)), "missing none, unknown 'keypoint'"),
        ("reset", 1.5, "reset: expected"),
    ],
)
def test_a_bad_field_is_named_with_what_was_expected(running_server, field, value, complaint):
    with pytest.raises(BadRequest, match=complaint):
        parse_request({**observation(0), field: value}, running_server[0].expected)


def test_a_missing_field_is_named(running_server):
    request = observation(0)
    del request["depth"]
    with pytest.raises(BadRequest, match=r"missing depth, unknown none.*depth: float \(H, W\)"):
        parse_request(request, running_server[0].expected)


def test_poses_may_be_lists_and_any_float(running_server):
    request = observation(3)
    other = {**request, "pose": request["pose"].tolist(), "depth": request["depth"].astype(np.float64)}
    first, second = (parse_request(one, running_server[0].expected) for one in (request, other))
    assert_same(np.asarray(second.observation.robot.pose), np.asarray(first.observation.robot.pose))
    assert_same(np.asarray(second.observation.pictures.depth), np.asarray(first.observation.pictures.depth))


def test_a_robot_is_told_what_to_send_and_gets_the_policys_action(running_server, client, policy):
    server, _ = running_server
    assert client.metadata["image_sizes"] == [[SIZE, SIZE]]
    assert client.metadata["needs_keypoints"] is True
    reply = client.infer(observation(5))
    assert reply["text"] == expected_text(server, policy, 5)
    assert reply["actions"].shape == (1, 8)
    said = policy.codec.decode(parse_answer(reply["text"], 1, "compact"))
    np.testing.assert_allclose(reply["actions"][0], [*said.pose[0], *said.gripper_open], atol=1e-6)
    assert reply["server_timing"]["infer_ms"] > 0
    assert "prev_total_ms" in client.infer(observation(6))["server_timing"]


def test_answers_are_never_crossed(running_server, policy):
    """Robots that ask at the same time, in batches of different sizes, each get the answer to their own question."""
    server, port = running_server
    texts = [expected_text(server, policy, seed) for seed in range(12)]
    assert len(set(texts)) > 6

    def ask_often(seed: int) -> list[tuple[str, int]]:
        with PolicyClient(port=port) as client:
            replies = [client.infer({**observation(seed), "reset": True}) for _ in range(8)]
        return [(reply["text"], reply["server_timing"]["batch"]) for reply in replies]

    with concurrent.futures.ThreadPoolExecutor(12) as robots:
        answers = list(robots.map(ask_often, range(12)))
    for seed, replies in enumerate(answers):
        assert {text for text, _ in replies} == {texts[seed]}
    assert max(batch for replies in answers for _, batch in replies) > 1


def test_no_request_waits_for_a_compiler(running_server, caplog):
    """Batches of every size, and prompts of every length, run what was compiled before the server was ready."""
    _, port = running_server
    prompts = ["light", "turn on the light", "lift the red ball " * 4, "press the button"]
    with jax.log_compiles(), caplog.at_level("WARNING"):

        def ask_often(seed: int) -> None:
            with PolicyClient(port=port) as client:
                for prompt in prompts:
                    client.infer({**observation(seed), "prompt": prompt})

        with concurrent.futures.ThreadPoolExecutor(7) as robots:
            list(robots.map(ask_often, range(7)))
    assert [record.message for record in caplog.records if "ompil" in record.message] == []


def test_an_arm_that_has_come_near_its_keypoint_is_sent_to_the_next(client):
    request = observation(1)
    first, second = request["keypoints"][0]
    away = client.infer(request)
    assert (away["reached"], away["keypoint"]) == ([0], [first.tolist()])
    near = {**request, "pose": np.concatenate([first + 0.02, request["pose"][0, 3:]])[None]}
    assert client.infer(near)["keypoint"] == [second.tolist()]
    assert client.infer(request)["reached"] == [1]  # it never goes back
    assert client.infer({**request, "reset": True})["reached"] == [0]
    client.infer(near)
    assert client.infer({**request, "prompt": "lift the ball"})["reached"] == [0]


def from_above(request: dict) -> dict:
    """The request with a camera over the table that looks down on all of it but its corners."""
    turned = np.array([[0, -1, 0, 0.3], [-1, 0, 0, 0.0], [0, 0, -1, 3.3], [0, 0, 0, 1.0]])
    return {**request, "world_from_camera": turned, "depth": np.full((SIZE, SIZE), 2.0)}


def test_a_camera_that_sees_none_of_the_first_keypoints_is_refused(client):
    down = from_above(observation(1))
    assert client.infer({**down, "reset": True})["points"] == 256
    far = {**down, "keypoints": np.tile([-0.9, 0.9, 1.9], (1, 2, 1))}
    assert client.infer(far)["text"]  # a camera that moves may lose them later
    with pytest.raises(ServerError, match=r"keypoints: expected one in the first 32 x 32 picture.*not its inverse"):
        client.infer({**far, "reset": True})


def test_a_reply_says_how_many_points_were_used(client):
    whole, half = observation(2), observation(2)
    half["depth"] = np.where(np.arange(SIZE) < SIZE // 2, half["depth"], np.inf)
    counts = [client.infer(request)["points"] for request in (whole, half)]
    assert 64 < counts[0] <= 256
    assert 16 < counts[1] < 0.7 * counts[0]


def test_a_refused_request_changes_nothing_in_the_episode(client):
    request = observation(1)
    first, second = request["keypoints"][0]
    near = {**request, "pose": np.concatenate([first + 0.02, request["pose"][0, 3:]])[None]}
    assert client.infer(near)["keypoint"] == [second.tolist()]
    for bad in (
        {"prompt": "turn on the lihgt"},
        {"prompt": "the " * 40},
        {"depth": np.zeros((SIZE, SIZE))},
        {**from_above(request), "keypoints": np.tile([-0.9, 0.9, 1.9], (1, 3, 1))},
    ):
        with pytest.raises(ServerError, match=":"):
            client.infer({**request, **bad})
    assert client.infer(request)["reached"] == [1]


def test_a_bad_request_gets_an_error_and_the_connection_goes_on(client):
    for bad, complaint in (
        ({}, "missing"),
        ({**observation(0), "rgb": 3}, "rgb: expected"),
        ({**observation(0), "keypoints": None}, "trained with them"),
        ({**observation(0), "prompt": "press 450"}, "no token for '450'"),
        ({**observation(0), "prompt": "press ②"}, "no token for '②'"),
        ({**observation(0), "prompt": "turn on the lihgt"}, "no token for 'lihgt'"),
        ({**observation(0), "prompt": "xyzzy frobnicate"}, "no token for 'frobnicate', 'xyzzy'"),
        ({**observation(0), "prompt": "打开灯"}, "no token for '打开灯'"),
        ({**observation(0), "prompt": "\u202d"}, "no token for"),
        ({**observation(0), "prompt": "the " * 100}, "max_text_length"),
    ):
        with pytest.raises(ServerError, match=complaint):
            client.infer(bad)
    assert client.infer(observation(0))["text"]


def test_a_policy_without_keypoints_and_3d_input_needs_neither():
    policy = tiny_policy(use_keypoints=False, use_points=False)
    with running(lambda: small_server(policy, limits={"batch": 1})) as (_, port), PolicyClient(port=port) as client:
        assert set(client.metadata["request"]) == {"prompt", "rgb", "pose", "gripper_open"}
        request = observation(0)
        with_depth = client.infer(request)
        for name in ("keypoints", "depth", "intrinsics", "world_from_camera"):
            del request[name]
        reply = client.infer(request)
        assert (reply["keypoint"], reply["points"]) == (None, None)
        assert reply["text"] == with_depth["text"]
        with pytest.raises(ServerError, match=r"missing intrinsics, world_from_camera; .* send all"):
            client.infer({**request, "depth": np.ones((SIZE, SIZE))})


def test_a_policy_that_learned_without_keypoints_refuses_them():
    small = tiny_policy()
    learned = LearnedFrom("demonstrations", "none", (SIZE, SIZE), (1,), ("lift_box",), ("wrist",))
    policy = dataclasses.replace(small, config=dataclasses.replace(small.config, learned_from=learned))
    with running(lambda: small_server(policy, limits={"batch": 1})) as (_, port), PolicyClient(port=port) as client:
        assert client.metadata["needs_keypoints"] is False
        assert client.metadata["learned_from"]["keypoints"] == "none"
        assert client.metadata["learned_from"]["image_size"] == [SIZE, SIZE]
        assert client.metadata["vocabulary"] == "words of the training data"
        request = observation(0)
        with pytest.raises(ServerError, match="keypoints: this policy learned from demonstrations without any"):
            client.infer(request)
        del request["keypoints"]
        assert client.infer(request)["keypoint"] is None


def test_keypoints_are_found_in_the_picture_of_a_robot_that_sends_none(policy):
    """The "detector" finds what is brighter than the rest; the server remembers it for the episode."""

    def bright(rgb, phrases):
        mask = rgb.min(axis=-1) > 250
        return [Sighting(phrase, mask if mask.any() else None, problem="it is dark") for phrase in phrases]

    request = observation(0)
    del request["keypoints"]
    dark = {**request, "rgb": np.zeros((SIZE, SIZE, 3), np.uint8), "depth": np.full((SIZE, SIZE), 1.0)}
    lit = {**dark, "rgb": dark["rgb"].copy()}
    lit["rgb"][20:25, 8:13] = 255
    looking = Perception(bright, suite_phrases())
    with (
        running(lambda: small_server(policy, limits={"batch": 1}, perception=looking)) as (_, port),
        PolicyClient(port=port) as client,
    ):
        assert client.metadata["needs_keypoints"] is False
        with pytest.raises(ServerError, match="keypoints not found: 'little green light switch': it is dark"):
            client.infer(dark)
        (point,) = client.infer(lit)["keypoint"]
        expected = np.asarray(unproject(dark["depth"], front_camera(SIZE)))[22, 10]
        np.testing.assert_allclose(point, expected, atol=1e-5)
        assert client.infer(dark)["keypoint"] == [point]
        with pytest.raises(ServerError, match="it is dark"):
            client.infer({**dark, "reset": True})
        with pytest.raises(ServerError, match="no object phrases for the instruction 'lift'"):
            client.infer({**lit, "prompt": "lift"})


def test_messages_with_bytes_changed_are_answered_or_refused_and_nothing_else(running_server):
    whole, rng = pack(observation(0)), np.random.default_rng(0)
    outcomes = set()
    for _ in range(1000):
        changed = bytearray(whole)
        for place in rng.integers(0, 300 if rng.random() < 0.7 else len(whole), 3):
            changed[place] = rng.integers(256)
        try:
            parse_request(unpack(bytes(changed[: rng.integers(1, 2 * len(whole))])), running_server[0].expected)
            outcomes.add("answered")
        except (MessageError, BadRequest) as error:
            outcomes.add(type(error))
    assert outcomes == {"answered", MessageError, BadRequest}


def test_health_and_metrics(running_server):
    _, port = running_server
    ask(port, 0)
    assert get(port, "/healthz") == (200, "OK\n")
    status, page = get(port, "/metrics")
    assert status == 200
    assert 'dsvla_requests_total{outcome="answered"}' in page
    assert "dsvla_ready 1.0" in page
    assert "dsvla_batch_robots_bucket" in page


def test_a_token_keeps_others_out(policy):
    with running(lambda: small_server(policy, token="secret", limits={"batch": 1})) as (_, port):
        for wrong in (None, "other"):
            with pytest.raises(ConnectionFailed, match=r"HTTP status 401 .*--token-file"):
                PolicyClient(port=port, token=wrong)
        assert get(port, "/metrics")[0] == 401
        assert get(port, "/metrics", Authorization="Bearer secret")[0] == 200
        assert get(port, "/healthz")[0] == 200
        openpis = {"Authorization": "Api-Key secret"}
        with websockets.sync.client.connect(f"ws://127.0.0.1:{port}", additional_headers=openpis) as connection:
            metadata = unpack(connection.recv(decode=False))
            assert isinstance(metadata, dict)
            assert metadata["name"] == "policy"
        with PolicyClient(port=port, token="secret") as client:
            assert client.infer(observation(0))["text"]


def test_web_pages_are_kept_out(running_server):
    page = {"Origin": "http://example.com"}
    with (
        pytest.raises(InvalidStatus, match="403"),
        websockets.sync.client.connect(f"ws://127.0.0.1:{running_server[1]}", additional_headers=page),
    ):
        pass


def test_more_robots_than_the_limit_are_turned_away(policy):
    with running(lambda: small_server(policy, limits={"batch": 1, "clients": 1})) as (_, port):
        with PolicyClient(port=port), pytest.raises(ConnectionFailed, match=r"HTTP status 503 \(1 robots .*--clients"):
            PolicyClient(port=port)
        ask(port, 0)


def send_raw(port: int, data: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    connection.sendall(data)
    return connection


HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def closed_within(connection: socket.socket, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    connection.settimeout(seconds)
    try:
        while time.monotonic() < deadline:
            if not connection.recv(65536):
                return True
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return False


def test_slow_and_half_open_connections_are_dropped_while_others_are_served(running_server, policy):
    server, port = running_server
    frame = bytes([0x82, 0xFE]) + struct.pack("!H", 5000) + b"\0\0\0\0" + b"x" * 10  # of 5,000 bytes, ten
    fragment = bytes([0x02, 0x81]) + b"\0\0\0\0x"  # more are announced, and never come
    slow = [send_raw(port, data) for data in (b"GET / HT", b"", HANDSHAKE + frame, HANDSHAKE + fragment)]
    assert ask(port, 7)["text"] == expected_text(server, policy, 7)
    assert all(closed_within(connection, 20) for connection in slow)
    assert ask(port, 7)["text"] == expected_text(server, policy, 7)


def test_messages_that_are_too_large_close_their_own_connection(running_server):
    server, port = running_server
    with PolicyClient(port=port) as other:
        for message in (b"x" * (server.expected.max_message_bytes + 1), [b"x"] * 5000):
            with websockets.sync.client.connect(f"ws://127.0.0.1:{port}", max_size=None) as connection:
                connection.recv()
                with contextlib.suppress(ConnectionClosed):
                    connection.send(message)
                with pytest.raises(ConnectionClosed):
                    connection.recv()
        assert other.infer(observation(2))["text"]


def test_text_frames_and_garbage_get_an_error(running_server):
    with websockets.sync.client.connect(f"ws://127.0.0.1:{running_server[1]}") as connection:
        connection.recv()
        for message, complaint in (("hello", "binary frame"), (b"\xc1", "expected msgpack"), (b"", "expected msgpack")):
            connection.send(message)
            reply = connection.recv()
            assert isinstance(reply, str)
            assert complaint in reply
        connection.send(pack(observation(0)))
        assert isinstance(connection.recv(), bytes)


CAMERAS = ("front", "wrist")


def seen_by_two(seed: int) -> dict:
    """A request with two pictures, the second from 20 cm beside the first."""
    first, second = observation(seed), observation(seed + 100)
    pose = first["world_from_camera"].copy()
    pose[1, 3] += 0.2
    both = {name: np.stack([first[name], second[name]]) for name in ("rgb", "depth", "intrinsics")}
    return {**first, **both, "world_from_camera": np.stack([first["world_from_camera"], pose])}


def test_a_policy_of_two_cameras_is_asked_with_both_pictures():
    policy = tiny_policy(cameras=CAMERAS)
    with running(lambda: small_server(policy)) as (server, port), PolicyClient(port=port) as client:
        assert client.metadata["cameras"] == list(CAMERAS)
        assert client.metadata["learned_from"]["cameras"] == list(CAMERAS)
        assert client.metadata["request"]["rgb"] == "uint8 (2, H, W, 3), of each of front, wrist"
        request = seen_by_two(1)
        parsed = parse_request(request, server.expected)
        question, _ = asyncio.run(server._question(parsed, Session()))
        reply = client.infer(request)
        assert reply["text"] == answer_batch(policy, [question])[0].text
        alone = [
            parse_request({**request, **{k: request[k][c] for k in TAKEN}}, one_camera()).points or 0 for c in range(2)
        ]
        assert reply["points"] == sum(alone)
        changed = {**request, "rgb": request["rgb"][::-1]}
        assert client.infer(changed)["log_probs"] != reply["log_probs"]
        refused = {
            r"rgb: expected a uint8 array \(2, 32, 32, 3\) of front, wrist, got uint8 \(32, 32, 3\)": {
                "rgb": request["rgb"][0]
            },
            r"request, camera wrist: intrinsics: expected a centre in 32 x 32 pixels": {
                "intrinsics": request["intrinsics"] * np.array([1, 3])[:, None, None] ** np.array([1, 1, 0])[:, None]
            },
            r"request, camera front: world_from_camera: .*mirror image": {
                "world_from_camera": request["world_from_camera"]
                * np.array([-1, 1, 1, 1])
                * np.array([[1], [0]])[:, None]
                + request["world_from_camera"] * np.array([[0], [1]])[:, None]
            },
            r"depth: expected float \(2, H, W\).*, of each of front, wrist, got shape \(32, 32\)": {
                "depth": request["depth"][0]
            },
        }
        for complaint, changes in refused.items():
            with pytest.raises(ServerError, match=complaint):
                client.infer({**request, **changes})


TAKEN = ("rgb", "depth", "intrinsics", "world_from_camera")


def one_camera() -> Expected:
    return Expected(((SIZE, SIZE),), (1,), tiny_policy().config.encoding)


def test_one_of_two_cameras_must_see_a_keypoint_at_first():
    expected = dataclasses.replace(one_camera(), cameras=CAMERAS)
    request = seen_by_two(1)
    request["world_from_camera"][0] = request["world_from_camera"][0] @ np.diag([1, -1, -1, 1])
    turned = parse_request(
        {**request, "depth": request["depth"] * 0 + 1}, dataclasses.replace(expected, encoding=BLIND)
    )
    assert turned.keypoints is not None
    check_first_keypoints(turned, turned.keypoints)
    both = request["world_from_camera"].copy()
    both[1] = both[0]
    away = parse_request({**request, "world_from_camera": both}, dataclasses.replace(expected, encoding=BLIND))
    with pytest.raises(BadRequest, match="keypoints"):
        check_first_keypoints(away, turned.keypoints)


BLIND = dataclasses.replace(tiny_policy().config.encoding, use_points=False)
