"""A small client, for robots whose Python has NumPy 2; openpi's `openpi-client` speaks the same protocol."""

import contextlib
from typing import Any

import websockets.sync.client

from dsvla_jax.errors import UserError
from dsvla_jax.serving.messages import pack, unpack


class ServerError(UserError):
    """What the server replied instead of an answer."""


class PolicyClient:
    """One robot's connection: ``with PolicyClient("127.0.0.1", 8000) as policy: reply = policy.infer(observation)``.

    metadata: what the server said of itself on connecting, which it does when it is ready. timeout: seconds to wait
    for a reply. token: where the server asks for one.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8000, token: str | None = None, timeout: float = 60.0):
        headers = {"Authorization": f"Bearer {token}"} if token else None
        self._timeout = timeout
        self._open = contextlib.ExitStack()
        self._socket = self._open.enter_context(
            websockets.sync.client.connect(
                f"ws://{host}:{port}", compression=None, max_size=None, additional_headers=headers, proxy=None
            )
        )
        self.metadata: dict[str, Any] = unpack(self._socket.recv(decode=False))

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The reply to one request. Raises ServerError with the server's message where it could not answer."""
        self._socket.send(pack(observation))
        reply = self._socket.recv(self._timeout)
        if isinstance(reply, str):
            raise ServerError(reply)
        return unpack(reply)

    def close(self) -> None:
        """Ends the connection."""
        self._open.close()

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
