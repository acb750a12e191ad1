"""A small client, for robots whose Python has NumPy 2; openpi's `openpi-client` speaks the same protocol."""

import contextlib
import socket
import threading
from typing import NoReturn, cast

import numpy as np
import websockets.sync.client
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from dsvla_jax.errors import UserError
from dsvla_jax.serving.messages import Message, MessageError, pack, unpack

_START = "start a server (python -m dsvla_jax.serving RUN), or give another host and port"
_AGAIN = (
    "connect again with a new PolicyClient and begin the episode again with reset=True: the server has forgotten which "
    "keypoints were reached"
)


class ServerError(UserError):
    """What the server replied instead of an answer. The connection stays open."""


class ConnectionFailed(UserError):
    """The server cannot be reached, or no longer: names the address, the cause and the fix."""


class PolicyClient:
    """One robot's connection: ``with PolicyClient("127.0.0.1", 8000) as policy: reply = policy.infer(observation)``.

    Raises ConnectionFailed if the server cannot be reached. A connection on which a reply is overdue is closed and
    stays closed, so that `infer` never returns the answer to an earlier request.

    metadata: what the server said of itself on connecting, which it does when it is ready.
    token: the one that the server asks for.
    timeout: seconds to connect and receive the metadata, and then seconds for each reply.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 8000, token: str | None = None, timeout: float = 60.0
    ) -> None:
        self.address = f"ws://{host}:{port}"
        if not timeout > 0:
            raise UserError(f"timeout: expected more than 0 seconds, got {timeout}")
        if not 1 <= port <= 65535:
            raise UserError(f"port: expected 1 to 65535, got {port}")
        if token is not None and not (token.isascii() and token.isprintable()):
            raise UserError("token: expected printable ASCII characters, as in the server's --token-file")
        self._timeout = timeout
        self._why_closed = ""
        self._one_at_a_time = threading.Lock()
        self._open = contextlib.ExitStack()
        self._socket = self._connect(token)
        self.metadata = self._receive_metadata()

    def infer(self, observation: Message) -> Message:
        """The reply to one request.

        Raises ServerError with the server's message if it refuses the request, and ConnectionFailed if no reply comes
        within ``timeout`` or the connection ends; every later call then raises ConnectionFailed, too.
        """
        request = pack(observation)
        most = self.metadata.get("max_message_bytes", len(request))
        if len(request) > most:
            arrays = {key: value for key, value in observation.items() if isinstance(value, np.ndarray | np.generic)}
            kinds = ", ".join(f"{key} {value.dtype}" for key, value in arrays.items())
            raise UserError(
                f"request: {len(request):,} bytes are more than the {most:,} that {self.address} takes; send pictures"
                f" of {self.metadata.get('image_sizes')}, rgb as uint8 and depth as float32 (got {kinds})"
            )
        with self._one_at_a_time:
            if self._why_closed:
                raise self._closed()
            # Cutting the line ends whatever waits for it, also a request that the server does not read.
            alarm = threading.Timer(self._timeout, self._cut, [f"since no reply came within {self._timeout:g} s"])
            alarm.daemon = True
            alarm.start()
            try:
                self._socket.send(request)
                reply = self._socket.recv()
            except (WebSocketException, OSError) as error:
                self._cut(f"since it ended ({_cause(error)})")
                raise self._closed() from error
            except BaseException:
                self._cut("since a request was interrupted")
                raise
            finally:
                alarm.cancel()
        if isinstance(reply, str):
            raise ServerError(reply)
        return cast(Message, unpack(reply))

    def close(self) -> None:
        """Ends the connection."""
        self._why_closed = self._why_closed or "by this program"
        self._open.close()

    def __enter__(self) -> "PolicyClient":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _cut(self, why: str) -> None:
        """Drops the connection at once, with nothing said to the server."""
        self._why_closed = self._why_closed or why
        with contextlib.suppress(OSError):  # the other side was quicker
            self._socket.socket.shutdown(socket.SHUT_RDWR)

    def _closed(self) -> ConnectionFailed:
        return ConnectionFailed(f"{self.address}: the connection is closed, {self._why_closed}; {_AGAIN}")

    def _connect(self, token: str | None) -> websockets.sync.client.ClientConnection:
        try:
            return self._open.enter_context(
                websockets.sync.client.connect(
                    self.address,
                    compression=None,
                    max_size=None,
                    additional_headers={"Authorization": f"Bearer {token}"} if token else None,
                    proxy=None,
                    open_timeout=self._timeout,
                    close_timeout=min(self._timeout, 1.0),
                )
            )
        except InvalidStatus as error:
            self._refused(error)
        except TimeoutError as error:
            raise ConnectionFailed(
                f"{self.address}: no answer within {self._timeout:g} s; expected a policy server there: {_START}"
            ) from error
        except (WebSocketException, OSError, ValueError) as error:
            raise ConnectionFailed(
                f"{self.address}: no policy server can be reached ({_cause(error)}); {_START}"
            ) from error

    def _refused(self, error: InvalidStatus) -> NoReturn:
        status, body = error.response.status_code, bytes(error.response.body or b"").decode(errors="replace").strip()
        fix = {401: "give the token of its --token-file", 503: "disconnect another robot, or raise its --clients"}
        raise ConnectionFailed(
            f"{self.address}: the server refused the connection with HTTP status {status} ({body[:100]}); "
            + fix.get(status, f"expected a policy server there: {_START}")
        ) from error

    def _receive_metadata(self) -> Message:
        try:
            received = self._socket.recv(self._timeout)
            metadata = unpack(received) if isinstance(received, bytes) else received
        except TimeoutError as error:
            self._cut("")
            raise ConnectionFailed(
                f"{self.address}: no metadata within {self._timeout:g} s; if the server is still compiling (its "
                "/healthz answers 503 then), wait or give a longer timeout; if not, it is no policy server"
            ) from error
        except (ConnectionClosed, OSError) as error:
            raise ConnectionFailed(
                f"{self.address}: the server closed the connection ({_cause(error)}); {_START}"
            ) from error
        except MessageError as error:
            metadata = error
        if not isinstance(metadata, dict):
            self._cut("")
            raise ConnectionFailed(
                f"{self.address}: expected a policy server's metadata, got {str(metadata)[:100]!r}; {_START}"
            )
        return metadata


def _cause(error: BaseException) -> str:
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        return f"the server closed it: {error.rcvd.reason or error.rcvd.code}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__
