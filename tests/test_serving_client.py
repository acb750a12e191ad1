"""The robot's side of a connection: late replies, servers that are silent, gone or something else."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import websockets.sync.server

from dsvla_jax.errors import UserError
from dsvla_jax.serving.client import ConnectionFailed, PolicyClient, ServerError
from dsvla_jax.serving.messages import pack
from tests.serving import observation, running, small_server, tiny_policy


@pytest.fixture(scope="module")
def running_server():
    with running(lambda: small_server(tiny_policy())) as server_and_port:
        yield server_and_port


@contextlib.contextmanager
def stranger(speak: Callable[[websockets.sync.server.ServerConnection], None]) -> Iterator[int]:
    """A websocket server that is no policy server; yields its port."""
    server = websockets.sync.server.serve(speak, "127.0.0.1", 0, compression=None)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.socket.getsockname()[1]
    finally:
        server.shutdown()
        thread.join(10)


def test_a_late_reply_is_never_taken_for_the_answer_to_a_later_picture(running_server):
    server, port = running_server
    with PolicyClient(port=port) as other:
        texts = [other.infer({**observation(seed), "reset": True})["text"] for seed in (1, 2)]
    assert texts[0] != texts[1]
    release = threading.Event()
    with PolicyClient(port=port, timeout=0.3) as robot:
        server._batcher._thread.submit(release.wait)
        try:
            with pytest.raises(ConnectionFailed, match=r"no reply came within 0.3 s; connect again .* reset=True"):
                robot.infer(observation(1))
        finally:
            release.set()
        for _ in range(2):
            with pytest.raises(ConnectionFailed, match=r"no reply came within 0\.3 s"):
                robot.infer(observation(2))
    with PolicyClient(port=port) as again:
        assert again.infer(observation(2))["text"] == texts[1]


def test_an_interrupted_request_leaves_no_reply_behind(running_server, monkeypatch):
    with PolicyClient(port=running_server[1]) as robot:
        with monkeypatch.context() as patch:
            patch.setattr(robot._socket, "recv", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                robot.infer(observation(1))
        with pytest.raises(ConnectionFailed, match="a request was interrupted"):
            robot.infer(observation(2))


def test_threads_that_share_a_client_get_their_own_answers(running_server):
    with PolicyClient(port=running_server[1]) as robot:
        alone = [robot.infer({**observation(seed), "reset": True})["text"] for seed in range(4)]
        answers: dict[int, str] = {}

        def ask(seed: int) -> None:
            answers[seed] = robot.infer({**observation(seed), "reset": True})["text"]

        threads = [threading.Thread(target=ask, args=[seed]) for seed in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert [answers[seed] for seed in range(4)] == alone


def never_speaks(connection):
    connection.recv(10)


@pytest.mark.parametrize(
    ("speak", "complaint"),
    [
        (never_speaks, "no metadata within 0.3 s; if the server is still compiling"),
        (lambda connection: connection.send("hello"), "expected a policy server's metadata, got 'hello'"),
        (lambda connection: connection.send(b"\xc1"), "expected a policy server's metadata, got 'message: expected"),
        (lambda connection: connection.close(1008, "go away"), r"the server closed the connection \(.*go away\)"),
    ],
)
def test_a_server_of_another_kind_is_named_in_time(speak, complaint):
    with stranger(speak) as port:
        began = time.monotonic()
        with pytest.raises(ConnectionFailed, match=rf"ws://127.0.0.1:{port}: {complaint}"):
            PolicyClient(port=port, timeout=0.3)
        assert time.monotonic() - began < 5


def test_a_port_that_accepts_and_says_nothing_is_given_up():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(ConnectionFailed, match=rf"ws://127.0.0.1:{port}: no answer within 0.2 s"):
            PolicyClient(port=port, timeout=0.2)


def test_no_server_is_a_message_with_the_address_and_the_fix():
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    with pytest.raises(ConnectionFailed, match=rf"ws://127.0.0.1:{port}: .*refused.*; start a server"):
        PolicyClient(port=port)
    with pytest.raises(ConnectionFailed, match=r"ws://no\.such\.host\.invalid:8000: .*; start a server"):
        PolicyClient("no.such.host.invalid")


def test_a_request_that_the_server_does_not_read_ends_in_time():
    done = threading.Event()

    def reads_nothing(connection):
        connection.send(pack({}))
        with connection.recv_flow_control:
            done.wait(20)

    with stranger(reads_nothing) as port, PolicyClient(port=port, timeout=0.3) as robot:
        try:
            with pytest.raises(ConnectionFailed, match=r"no reply came within 0\.3 s"):
                robot.infer({"rgb": np.zeros(20_000_000, np.uint8)})
        finally:
            done.set()


def test_a_server_that_stops_or_restarts_ends_the_connection_with_a_message():
    policy = tiny_policy()
    with running(lambda: small_server(policy, limits={"batch": 1})) as (_, port):
        robot = PolicyClient(port=port)
        robot.infer(observation(0))
    with running(lambda: small_server(policy, limits={"batch": 1})), robot:
        for _ in range(2):
            with pytest.raises(ConnectionFailed, match=rf"ws://127.0.0.1:{port}: .*closed.*begin the episode again"):
                robot.infer(observation(0))


def test_pictures_of_another_kind_than_uint8_are_named_before_they_are_sent(running_server):
    with PolicyClient(port=running_server[1]) as robot:
        floats = {**observation(0), "rgb": observation(0)["rgb"] / 255.0}
        with pytest.raises(ServerError, match=r"rgb: expected a uint8 array \(32, 32, 3\), got float64"):
            robot.infer(floats)
        large = {**observation(0), "rgb": np.zeros((300, 300, 3))}
        with pytest.raises(UserError, match=r"bytes are more than .*\[\[32, 32\]\], rgb as uint8 .*rgb float64"):
            robot.infer(large)
        assert robot.infer(observation(0))["text"]


@pytest.mark.parametrize("wrong", [{"timeout": 0}, {"timeout": float("nan")}, {"port": 70000}, {"token": "ö\n"}])
def test_settings_that_cannot_be_meant_are_named(wrong):
    with pytest.raises(UserError, match=f"{next(iter(wrong))}: expected"):
        PolicyClient(**wrong)
