"""The policy server: openpi's websocket protocol, and over HTTP /healthz and /metrics.

On connecting a robot is sent the metadata, a map; then each of its requests gets one reply. A reply is a binary frame;
an error is a text frame that says what was wrong, and the connection stays open, unlike openpi's.
"""

import asyncio
import contextlib
import dataclasses
import hmac
import http
import logging
import time
from collections.abc import AsyncIterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response

from dsvla_jax.errors import UserError
from dsvla_jax.perception.keypoints import KeypointTracker, Segmenter
from dsvla_jax.perception.phrases import ObjectPhrases, phrases_for
from dsvla_jax.policies.interface import BATCH_SIZES, Policy
from dsvla_jax.ranges import at_least, check_fields
from dsvla_jax.serving.batching import (
    Answer,
    MicroBatcher,
    Question,
    Timing,
    answer_batch,
    batch_sizes,
    blank_question,
    prompt_length,
)
from dsvla_jax.serving.messages import Message, pack, unpack
from dsvla_jax.serving.metadata import camera_names, describe
from dsvla_jax.serving.metrics import Metrics
from dsvla_jax.serving.requests import (
    OPTIONAL_FIELDS,
    BadRequest,
    Expected,
    Request,
    check_first_keypoints,
    parse_request,
)
from dsvla_jax.serving.session import Progress, Session
from dsvla_jax.types import TABLE_HEIGHT

log = logging.getLogger(__name__)

MAX_FRAGMENTS = 4096  # of one message; each costs more memory than the bytes it brings


@dataclasses.dataclass(frozen=True)
class Limits:
    """What one robot may ask of a server that others depend on."""

    clients: int = 64
    """Connections at a time."""
    batch: int = 16
    """Robots answered together at most."""
    instruction_tokens: int = 64
    """Of the longest instruction. All prompts are padded to it, since another length would compile again."""
    request_seconds: float = 30.0
    """From a request to its answer."""
    message_seconds: float = 10.0
    """For a message to arrive once it has begun; a silent peer is asked for a sign of life as often."""
    idle_seconds: float = 3600.0
    """Between two requests of a robot."""

    def __post_init__(self) -> None:
        seconds = at_least(0.001, 1e9)
        check_fields(
            self,
            "",
            clients=at_least(1, 10_000),
            batch=at_least(1, BATCH_SIZES[-1]),
            instruction_tokens=at_least(1, 100_000),
            request_seconds=seconds,
            message_seconds=seconds,
            idle_seconds=seconds,
        )


@dataclasses.dataclass(frozen=True)
class Perception:
    """How keypoints are found for robots that send none.

    phrases: what objects an instruction names. refresh: at every request, not only at the first of an episode.
    """

    segment: Segmenter
    phrases: Sequence[ObjectPhrases]
    refresh: bool = False


class PolicyServer:
    """Serves one policy. ``async with PolicyServer(...).listen(host, port) as socket_server: ...``

    token: what robots must show as ``Authorization: Bearer`` (or openpi's ``Api-Key``); None lets anyone in.
    name: of the policy, told to robots. perception: None for a server whose robots know their keypoints.
    """

    def __init__(
        self,
        policy: Policy,
        image_sizes: Sequence[tuple[int, int]],
        arms: Sequence[int],
        limits: Limits | None = None,
        token: str | None = None,
        name: str = "policy",
        perception: Perception | None = None,
    ) -> None:
        self.limits = limits or Limits()
        encoding = policy.config.encoding
        self.expected = Expected(
            tuple(image_sizes),
            tuple(arms),
            encoding,
            keypoints=policy.config.wants_keypoints or not encoding.use_keypoints,
            depth=encoding.use_points or perception is not None,
            cameras=camera_names(policy.config),
        )
        self.metrics = Metrics()
        self._policy, self._token, self._name = policy, token, name
        self._prompt_tokens = {n: prompt_length(policy, n, self.limits.instruction_tokens) for n in arms}
        self._batcher = MicroBatcher(self._answer, batch_sizes(self.limits.batch)[-1])
        self._perception, self._perception_thread = perception, ThreadPoolExecutor(1, thread_name_prefix="perception")
        self._ready = asyncio.Event()
        self._clients = 0

    @property
    def metadata(self) -> Message:
        """What a robot is told on connecting."""
        return describe(self._name, self._policy, self.expected, self._perception is not None)

    @contextlib.asynccontextmanager
    async def listen(self, host: str = "127.0.0.1", port: int = 8000) -> AsyncIterator[Server]:
        """Listens, compiles everything, then lets requests in. Yields the websockets server, ready."""
        seconds = self.limits.message_seconds
        async with contextlib.AsyncExitStack() as stack:
            server: Server = await stack.enter_async_context(
                serve(
                    self._handle,
                    host,
                    port,
                    process_request=self._http,
                    origins=[None],  # no web page: a browser would let any site on the internet reach a robot
                    compression=None,
                    max_size=self.expected.max_message_bytes,
                    max_queue=1,
                    open_timeout=seconds,
                    ping_interval=seconds,
                    ping_timeout=seconds,
                    close_timeout=seconds,
                )
            )
            answering = asyncio.create_task(self._batcher.run())
            stack.callback(answering.cancel)
            await self._warm_up()
            self._ready.set()
            self.metrics.ready.set(1)
            yield server

    def _answer(self, questions: Sequence[Question]) -> list[Answer]:
        return answer_batch(self._policy, questions, self._prompt_tokens[questions[0].shape[0]])

    async def _warm_up(self) -> None:
        # From the largest on: what does not fit into memory shows first.
        sizes = batch_sizes(self.limits.batch)[::-1]
        self._warm_up_checks()
        log.info("compiling for batches of %s", ", ".join(map(str, sizes)))
        for arms in self.expected.arms:
            for height, width in self.expected.image_sizes:
                for size in sizes:
                    started = time.monotonic()
                    question = blank_question(arms, len(self.expected.cameras), height, width)
                    await asyncio.to_thread(self._answer, [question] * size)
                    log.info(
                        "%d arm(s), %d x %d pixels, batch of %d: compiled in %.1f s",
                        *(arms, height, width, size, time.monotonic() - started),
                    )

    def _warm_up_checks(self) -> None:
        for arms in self.expected.arms:
            question = blank_question(arms, len(self.expected.cameras), *self.expected.image_sizes[0])
            blank = Request("", question.observation, None, True)
            check_first_keypoints(blank, np.full((arms, 1, 3), (0.3, 0.0, TABLE_HEIGHT), np.float32))

    def _http(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """Answers what is not a websocket; None lets a websocket in."""
        path = request.path.partition("?")[0]
        if path == "/healthz":
            if self._ready.is_set():
                return connection.respond(http.HTTPStatus.OK, "OK\n")
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "compiling\n")
        if not self._may_enter(request.headers.get_all("Authorization")):
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "expected the header Authorization: Bearer TOKEN\n")
        if path == "/metrics":
            response = connection.respond(http.HTTPStatus.OK, self.metrics.text())
            del response.headers["Content-Type"]
            response.headers["Content-Type"] = "text/plain; version=0.0.4; charset=utf-8"
            return response
        if self._clients >= self.limits.clients:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{self._clients} robots are connected\n")
        return None

    def _may_enter(self, credentials: Sequence[str]) -> bool:
        if self._token is None:
            return True
        scheme, _, token = (credentials[0] if len(credentials) == 1 else "").partition(" ")
        known = scheme.lower() in ("bearer", "api-key")
        return known and hmac.compare_digest(token.strip().encode(), self._token.encode())

    async def _handle(self, connection: ServerConnection) -> None:
        """One robot, from its connection to its end."""
        if self._clients >= self.limits.clients:
            await connection.close(CloseCode.TRY_AGAIN_LATER, f"{self._clients} robots are connected")
            return
        self._clients += 1
        self.metrics.connections.set(self._clients)
        try:
            await self._ready.wait()
            await connection.send(pack(self.metadata))
            await self._converse(connection)
        except ConnectionClosed:
            pass
        finally:
            self._clients -= 1
            self.metrics.connections.set(self._clients)

    async def _converse(self, connection: ServerConnection) -> None:
        looking = self._perception
        session = Session(looking and KeypointTracker(looking.segment, looking.refresh))
        previous = None
        while True:
            try:
                message = await self._receive(connection)
            except (TimeoutError, _TooManyFragments) as error:
                await connection.close(CloseCode.POLICY_VIOLATION, str(error))
                return
            started = time.monotonic()
            outcome, reply = await self._reply(message, session, previous)
            self.metrics.requests.labels(outcome).inc()
            async with asyncio.timeout(self.limits.message_seconds):
                await connection.send(reply)
            previous = time.monotonic() - started
            self.metrics.latency.observe(previous)

    async def _receive(self, connection: ServerConnection) -> str | bytes:
        """The next message, which may take long to begin, but not to arrive."""
        fragments: list[str | bytes] = []
        try:
            async with asyncio.timeout(self.limits.idle_seconds) as limit:
                async for fragment in connection.recv_streaming():
                    if not fragments:
                        limit.reschedule(asyncio.get_running_loop().time() + self.limits.message_seconds)
                    fragments.append(fragment)
                    if len(fragments) > MAX_FRAGMENTS:
                        raise _TooManyFragments(f"a message of more than {MAX_FRAGMENTS} fragments")
        except TimeoutError as error:
            what = "a message took too long to arrive" if fragments else "no request for too long"
            raise TimeoutError(what) from error
        text = [fragment for fragment in fragments if isinstance(fragment, str)]
        return "".join(text) if text else b"".join(part for part in fragments if not isinstance(part, str))

    async def _reply(self, message: str | bytes, session: Session, previous: float | None) -> tuple[str, str | bytes]:
        """(outcome for the metrics, frame to send)."""
        try:
            if isinstance(message, str):
                raise BadRequest("expected a binary frame of msgpack, got a text frame")
            async with asyncio.timeout(self.limits.request_seconds):
                # In a thread, so that large pictures hold up nobody else's connection.
                request = await asyncio.to_thread(lambda: parse_request(unpack(message), self.expected))
                question, progress = await self._question(request, session)
                answer, timing = await self._batcher.ask(question)
        except UserError as error:
            return "bad", str(error)
        except TimeoutError:
            return "timed_out", f"no answer within {self.limits.request_seconds:g} s: the server is overloaded"
        except Exception:
            # The policy failed on this batch. Its robots are told, the log has the traceback, the others go on.
            log.exception("the policy failed")
            return "failed", "internal error: the policy failed on this request; the server's log says why"
        self.metrics.answering.observe(timing.answering)
        self.metrics.batch.observe(timing.batch)
        reached = None if progress is None else progress.reached
        return "answered", pack(_reply_map(question, answer, timing, reached, request.points, previous))

    async def _question(self, request: Request, session: Session) -> tuple[Question, Progress | None]:
        """The request as the policy is asked it. What the policy would refuse is refused here, for one robot alone."""
        keypoints = progress = None
        begins = False
        self._check_prompt(request, None)  # before anything is looked for in the picture
        if self._policy.config.wants_keypoints:
            known = await self._all_keypoints(request, session)
            begins = session.begins(request, known)
            if begins:
                await asyncio.to_thread(check_first_keypoints, request, known)
            keypoints, progress = session.advance(request, known)
            self._check_prompt(request, keypoints)
            session.keep(progress)
        observation = dataclasses.replace(request.observation, past=session.look_back(request, begins))
        return Question(request.instruction, observation, keypoints), progress

    def _check_prompt(self, request: Request, keypoints: np.ndarray | None) -> None:
        """Raises BadRequest if the policy does not know a word, or the prompt is longer than what is compiled."""
        robot = request.observation.robot
        try:
            text = self._policy.encode_prompt(request.instruction, robot, keypoints)
        except ValueError as error:
            raise BadRequest(f"prompt: {error}") from error
        tokens, most = int(text.mask.sum()), self._prompt_tokens[len(robot.pose)]
        if tokens > most:
            raise BadRequest(
                f"prompt: {tokens} tokens with pose and keypoints are more than the {most} that the server is compiled "
                "for; shorten it, or start the server with more --instruction-tokens"
            )

    async def _all_keypoints(self, request: Request, session: Session) -> np.ndarray:
        """float32 (A, K, 3), those that the robot sent or those that are seen."""
        if request.keypoints is not None:
            return request.keypoints
        if self._perception is None:
            raise BadRequest(
                f"keypoints: this policy was trained with them; send {OPTIONAL_FIELDS['keypoints']}, "
                "or start the server with --perception first"
            )
        arms, count = phrases_for(request.instruction, self._perception.phrases), request.shape[0]
        if len(arms) not in (1, count):
            raise BadRequest(f"prompt: its objects are for {len(arms)} arms, the pose has {count}")
        arms = arms * (count // len(arms))
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._perception_thread, session.look, request, arms)


class _TooManyFragments(Exception):
    pass


def _reply_map(
    question: Question,
    answer: Answer,
    timing: Timing,
    reached: np.ndarray | None,
    points: int | None,
    previous: float | None,
) -> Message:
    # Arrays have the length of an action chunk in front, because openpi's ActionChunkBroker indexes every array by it.
    server_timing = {
        "infer_ms": timing.answering * 1000,
        "queue_ms": timing.waited * 1000,
        "batch": timing.batch,
    }
    if previous is not None:
        server_timing["prev_total_ms"] = previous * 1000
    return {
        "actions": np.concatenate([answer.pose, answer.gripper_open[:, None]], axis=-1).reshape(1, -1),
        "text": answer.text,
        "log_probs": answer.log_probs,
        "keypoint": None if question.keypoints is None else question.keypoints.tolist(),
        "reached": None if reached is None else reached.tolist(),
        "points": points,
        "server_timing": server_timing,
    }
