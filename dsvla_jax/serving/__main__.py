"""Serve a trained run to robots: python -m dsvla_jax.serving RUN [--host 127.0.0.1] [--port 8000]

Speaks the websocket protocol of openpi-client. docs/serving.md describes requests and replies.
"""

import asyncio
import dataclasses
import ipaddress
import logging
import signal
from pathlib import Path
from typing import Literal

import tyro

from dsvla_jax import policy as policies
from dsvla_jax.command_line import configure_jax, fail_with_message, parse_options
from dsvla_jax.data_config import LearnedFrom
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import load_experiment
from dsvla_jax.perception.grounding import GroundingOptions
from dsvla_jax.perception.simulator import suite_phrases
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.registry import make_policy
from dsvla_jax.ranges import at_least, check_fields
from dsvla_jax.serving.server import Limits, Perception, PolicyServer
from dsvla_jax.sim.tasks import get_task, select_tasks

log = logging.getLogger("dsvla_jax.serving")

MAX_PIXELS = 8192  # a side of a picture


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, where, and for how many."""

    run: tyro.conf.Positional[Path]
    """The run folder that train.py wrote."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 lets other machines in, and should go with a token."""
    port: int = 8000
    """The TCP port."""
    image_size: tuple[str, ...] = ()
    """Sizes of the robots' pictures, as 480x640 (height x width); that of the run's demonstrations if not given."""
    arms: tuple[int, ...] = ()
    """Numbers of arms; those of the run's demonstrations if not given."""
    token_file: Path | None = None
    """A file with the secret that robots must show as `Authorization: Bearer`: one line of ASCII characters."""
    perception: Literal["off", "first", "refresh"] = "off"
    """Finds the keypoints of robots that send none: in the first picture of an episode, or again in every one."""
    grounding: tyro.conf.OmitArgPrefixes[GroundingOptions] = dataclasses.field(default_factory=GroundingOptions)
    limits: tyro.conf.OmitArgPrefixes[Limits] = dataclasses.field(default_factory=Limits)

    def __post_init__(self) -> None:
        check_fields(self, "", port=at_least(1, 65535), arms=at_least(1, 2))


def build_server(options: Options) -> PolicyServer:
    """The server of these options, with the policy loaded. Raises UserError, before it loads anything large."""
    token = None if options.token_file is None else _read_token(options.token_file)
    given = tuple(_parse_size(text) for text in options.image_size)
    config = policies.load_policy_config(options.run)
    config = dataclasses.replace(config, learned_from=config.learned_from or _learned_before(options.run, config))
    learned = config.learned_from
    if learned is None and not (given and options.arms):
        raise UserError(
            f"{options.run}: does not say what it learned from; give the size of the pictures and the number of arms, "
            "as with --image-size 480x640 --arms 1"
        )
    sizes = given or ((learned.image_size,) if learned else ())
    arms = options.arms or (learned.arms if learned else ())
    for size in sizes:
        _check_size(size, config)
    perception = None
    if options.perception != "off":
        if not config.wants_keypoints:
            raise UserError(f"--perception: {options.run} learned without keypoints; leave it out")
        grounding = options.grounding
        phrases = (*grounding.table(), *suite_phrases())
        perception = Perception(grounding.segmenter(), phrases, options.perception == "refresh")
    loaded = policies.load_policy(options.run)
    policy = make_policy(config, loaded.variables, loaded.tokenizer)
    return PolicyServer(policy, sizes, arms, options.limits, token, options.run.name, perception)


def _read_token(file: Path) -> str:
    expected = f"{file}: expected one line of printable ASCII characters as the token"
    try:
        token = file.read_text(encoding="utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise UserError(f"{expected}, got text that is not UTF-8; save it as ASCII or UTF-8") from error
    if not (token and token.isascii() and token.isprintable()):
        raise UserError(f"{expected}, got {'other characters' if token else 'an empty file'}")
    return token


def _parse_size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not all(part.isascii() and part.isdecimal() and 1 <= int(part[:6]) <= MAX_PIXELS for part in (height, width)):
        raise UserError(
            f"--image-size: expected HEIGHTxWIDTH of 1 to {MAX_PIXELS} pixels each, such as 480x640, got {text!r}"
        )
    return int(height), int(width)


def _check_size(size: tuple[int, int], config: PolicyConfig) -> None:
    encoding = config.encoding
    candidates = config.model.cameras * -(-size[0] // encoding.stride) * -(-size[1] // encoding.stride)
    if encoding.use_points and candidates < encoding.points.num_points:
        raise UserError(
            f"--image-size: {size[0]}x{size[1]} has {candidates} points at the policy's stride of {encoding.stride}; "
            f"expected at least the {encoding.points.num_points} that it takes: use larger pictures"
        )


def _learned_before(run: Path, config: PolicyConfig) -> LearnedFrom | None:
    """What a run of a version that did not keep it learned from; None unless that was the task suite."""
    if not (run / "config.json").exists():
        return None
    experiment = load_experiment(run / "config.json")
    data = experiment.data
    if experiment.oxe is not None or data.source != "simulator":
        return None
    tasks = select_tasks(data.tasks)
    return LearnedFrom(
        source="simulator",
        keypoints=data.keypoints if config.encoding.use_keypoints else "none",
        image_size=(data.image_size, data.image_size),
        arms=tuple(sorted({get_task(name).num_arms for name in tasks})),
        tasks=tasks,
        cameras=data.cameras,
    )


async def main(options: Options) -> None:
    """Serves until it is interrupted or told to end."""
    server = build_server(options)
    if options.token_file is None and not _is_loopback(options.host):
        log.warning("%s is reachable from other machines, and no --token-file is given", options.host)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    try:
        async with server.listen(options.host, options.port):
            log.info("ready: ws://%s:%d, /healthz, /metrics", options.host, options.port)
            await stop.wait()
    except OSError as error:
        raise UserError(f"cannot listen on {options.host}:{options.port} ({error}); choose another --port") from error


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


if __name__ == "__main__":
    with fail_with_message():
        parsed = parse_options(Options, prog="python -m dsvla_jax.serving", description=__doc__)
        logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", force=True)
        logging.getLogger("dsvla_jax").setLevel(logging.INFO)
        configure_jax()
        asyncio.run(main(parsed))
