"""Tells a waiting person what is being compiled, and how long that took the last time."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from dsvla_jax.command_line import cache_folder
from dsvla_jax.errors import UserError
from dsvla_jax.files import write_bytes


@contextlib.contextmanager
def first_use(what: str, say: Callable[[str], None]) -> Iterator[None]:
    """Wrap the first call of something compiled: says so, and notes how long it takes for the next time.

    what: names the program and its shapes. say: shows one short sentence. Without a cache folder nothing is noted.
    """
    folder = cache_folder()
    key = f"{what} ({jax.default_backend()})"
    last = _read(folder).get(key)
    say("compiling" if last is None else f"compiling or loading, {last:.0f} s last time")
    start = time.monotonic()
    yield
    if folder is not None:
        times = {**_read(folder), key: round(time.monotonic() - start, 1)}
        # Only a convenience: what could not be noted is not said the next time.
        with contextlib.suppress(OSError, UserError):
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes(_file(folder), json.dumps(times, indent=1).encode())


def _file(folder: Path) -> Path:
    return folder / "first_use_seconds.json"


def _read(folder: Path | None) -> dict[str, float]:
    """What was noted; nothing if there is no file of numbers by name."""
    try:
        times = json.loads(_file(folder).read_text()) if folder is not None else {}
    except (OSError, ValueError):
        return {}
    if not isinstance(times, dict):
        return {}
    return {name: seconds for name, seconds in times.items() if isinstance(seconds, int | float)}
