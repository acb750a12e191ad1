"""1,000 malformed, oversized, truncated and slow messages: the server answers the others, memory is flat (5 minutes).

Usage: python -m benchmarks.serving_abuse [RUN] [--messages 1000]

While they come, a robot asks and has its answers checked. The first half warms up allocators; between its end and the
end of the second half the server may not grow by more than 5 %. Linux only: it reads /proc.
"""

import concurrent.futures
import dataclasses
import socket
import struct
import sys
import threading
import time
from pathlib import Path

import msgpack
import numpy as np
import tyro
import websockets.sync.client
from websockets.exceptions import WebSocketException

from benchmarks._server import Known, get, known_answers, resident_megabytes, server_process
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.serving.client import PolicyClient
from dsvla_jax.serving.messages import pack

SLOW_SECONDS = 3.0  # how long a slow client may take with a message, in this benchmark
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Whom to torment, and how often."""

    run: tyro.conf.Positional[Path] = Path("runs/tiny")
    messages: int = 1000
    at_once: int = 40


def malformed(port: int, rng: np.random.Generator, known: Known) -> bool:
    """Garbage, and good requests with a field or some bytes changed; an error must come back, or an answer."""
    whole = pack(known.request)
    field = rng.choice(list(known.request))
    junk = [None, 7, "x", [], {}, np.zeros((3, 0)), np.full((2, 7), np.nan), b"\0" * 99, [[[]] * 9] * 9, 2**63]
    flipped = bytearray(whole)
    for place in rng.integers(0, min(len(flipped), 400), 5):
        flipped[place] = rng.integers(256)
    message = [
        rng.bytes(int(rng.integers(0, 2000))),
        msgpack.packb({**known.request, field: junk[rng.integers(len(junk))]}, default=_plain),
        bytes(flipped),
        b"\x91" * 50_000,
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [2**31, 2**31]}),
        msgpack.packb([{}] * 100_000),
    ][rng.integers(6)]
    with websockets.sync.client.connect(f"ws://127.0.0.1:{port}", max_size=None) as connection:
        connection.recv()
        connection.send(message)
        reply = connection.recv(60)
        connection.send(whole)  # the same connection is still good
        return isinstance(reply, str | bytes) and isinstance(connection.recv(60), bytes)


def _plain(value: object) -> object:
    return msgpack.unpackb(pack(value), strict_map_key=False)


def oversized(port: int, rng: np.random.Generator, known: Known) -> bool:
    """Larger than the largest picture, whole or in fragments: the connection must be closed."""
    message = b"x" * 4_000_000 if rng.random() < 0.5 else [b"x"] * 20_000
    try:
        with websockets.sync.client.connect(f"ws://127.0.0.1:{port}", max_size=None) as connection:
            connection.recv()
            connection.send(message)
            connection.recv(60)
    except (WebSocketException, OSError):
        return True
    return False


def truncated(port: int, rng: np.random.Generator, known: Known) -> bool:
    """A good request cut off, and the line dropped: nothing to answer."""
    whole = pack(known.request)
    frame = bytes([0x82, 0xFF]) + struct.pack("!Q", len(whole)) + b"\0\0\0\0" + whole
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(HANDSHAKE + frame[: rng.integers(1, len(frame))])
    return True


def slow(port: int, rng: np.random.Generator, known: Known) -> bool:
    """A byte now and then, of the handshake, of a frame or of fragments: must be hung up on."""
    kind = rng.integers(3)
    opening = [b"", HANDSHAKE + bytes([0x82, 0xFE, 0x40, 0x00, 0, 0, 0, 0]), HANDSHAKE + b"\x02\x81\0\0\0\0x"][kind]
    drip = [b"G", b"x", b"\x00\x81\0\0\0\0x"][kind]
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(opening)
        connection.settimeout(0.3)
        end = time.monotonic() + 10 * SLOW_SECONDS
        try:
            while time.monotonic() < end:
                try:
                    if not connection.recv(65536):
                        return True
                except TimeoutError:
                    connection.sendall(drip)
        except OSError:
            return True
    return False


def bystander(port: int, known: list[Known], stop: threading.Event) -> tuple[int, int, float]:
    """A robot that behaves: its answers, how many were wrong, and the longest it waited, seconds."""
    answers, wrong, longest = 0, 0, 0.0
    with PolicyClient(port=port) as client:
        while not stop.is_set():
            one, began = known[answers % len(known)], time.monotonic()
            wrong += client.infer(one.request)["text"] != one.text
            longest, answers = max(longest, time.monotonic() - began), answers + 1
    return answers, wrong, longest


def main(options: Options) -> int:
    known = known_answers(options.run, 8)
    kinds = [malformed, oversized, truncated, slow]
    flags = ("--batch", "4", "--arms", "1", "--message-seconds", str(SLOW_SECONDS), "--clients", "100")
    stop, failures, megabytes = threading.Event(), 0, []
    with server_process(options.run, *flags) as (port, pid), concurrent.futures.ThreadPoolExecutor(1) as aside:
        robot = aside.submit(bystander, port, known, stop)
        try:
            for half in range(2):
                count = options.messages // 2
                with concurrent.futures.ThreadPoolExecutor(options.at_once) as pool:
                    attacks = {
                        pool.submit(kind, port, np.random.default_rng([half, i]), known[i % len(known)]): kind.__name__
                        for i in range(count)
                        for kind in [kinds[i % len(kinds)]]
                    }
                    done = [(name, attack.exception(), attack) for attack, name in attacks.items()]
                bad = [(name, error) for name, error, attack in done if error is not None or not attack.result()]
                failures += len(bad)
                time.sleep(2 * SLOW_SECONDS)
                megabytes.append(resident_megabytes(pid))
                print(f"{count} messages, {len(bad)} not refused as they should; {megabytes[-1]:.0f} MB", flush=True)
                for name, error in bad[:3]:
                    print(f"  {name}: {error!r}")
        finally:
            stop.set()
        answers, wrong, longest = robot.result()
        page = get(port, "/metrics")[1]
    growth = megabytes[1] / megabytes[0] - 1
    print(f"the robot beside them: {answers} answers, {wrong} wrong, none later than {longest:.1f} s")
    print(f"memory from the first half to the second: {100 * growth:+.1f} %")
    print("\n".join(line for line in page.splitlines() if line.startswith("dsvla_requests_t")))
    return int(failures > 0 or wrong > 0 or answers == 0 or growth > 0.05)


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax()
        sys.exit(main(parsed))
