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
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.errors import UserError
from dsvla_jax.perception.grounding import GroundingOptions
from dsvla_jax.rollout_keypoints import suite_phrases
from dsvla_jax.serving.server import Limits, Perception, PolicyServer
from dsvla_jax.sim.tasks import get_task, select_tasks
from dsvla_jax.training.experiment import load_experiment

log = logging.getLogger("dsvla_jax.serving")


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, where, and for how many."""

    run: tyro.conf.Positional[Path]
    """The run folder that train.py wrote."""
    host: str = "127.0.0.1"
    """The address to listen on; 0.0.0.0 lets other machines in, and should go with a token."""
    port: int = 8000
    image_size: tuple[str, ...] = ()
    """Sizes of the robots' pictures, as 480x640 (height x width); that of the run's demonstrations if not given."""
    arms: tuple[int, ...] = ()
    """Numbers of arms; those of the run's tasks if not given."""
    token_file: Path | None = None
    """A file with the secret that robots must show as `Authorization: Bearer`."""
    perception: Literal["off", "first", "refresh"] = "off"
    """Finds the keypoints of robots that send none: in the first picture of an episode, or again in every one."""
    grounding: tyro.conf.OmitArgPrefixes[GroundingOptions] = dataclasses.field(default_factory=GroundingOptions)
    limits: tyro.conf.OmitArgPrefixes[Limits] = dataclasses.field(default_factory=Limits)


def build_server(options: Options) -> PolicyServer:
    """The server of these options, with the policy loaded. Raises UserError."""
    sizes = tuple(_parse_size(text) for text in options.image_size)
    arms = options.arms
    if not sizes or not arms:
        data = load_experiment(options.run / "config.json").data
        sizes = sizes or ((data.image_size, data.image_size),)
        arms = arms or tuple(sorted({get_task(name).num_arms for name in select_tasks(data.tasks)}))
    token = None
    if options.token_file is not None:
        token = options.token_file.read_text().strip()
        if not token:
            raise UserError(f"{options.token_file}: expected a token, the file is empty")
    perception = None
    if options.perception != "off":
        grounding = options.grounding
        phrases = (*grounding.table(), *suite_phrases())
        perception = Perception(grounding.segmenter(), phrases, options.perception == "refresh")
    policy = policies.load(options.run)
    return PolicyServer(policy, sizes, arms, options.limits, token, options.run.name, perception)


def _parse_size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise UserError(f"--image-size: expected HEIGHTxWIDTH in pixels, such as 480x640, got {text!r}")
    return int(height), int(width)


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
        parsed = tyro.cli(Options, prog="python -m dsvla_jax.serving", description=__doc__)
        logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", force=True)
        logging.getLogger("dsvla_jax").setLevel(logging.INFO)
        configure_jax()
        asyncio.run(main(parsed))
