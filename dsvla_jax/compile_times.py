"""Tells a waiting person what is being compiled, and how long that took the last time."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from dsvla_jax.command_line import cache_folder


@contextlib.contextmanager
def first_use(what: str, say: Callable[[str], None]) -> Iterator[None]:
    """Wrap the first call of something compiled: says so, and notes how long it takes for the next time.

    what: names the program and its shapes. say: shows one short sentence.
    """
    file = cache_folder() / "first_use_seconds.json"
    key = f"{what} ({jax.default_backend()})"
    last = _read(file).get(key)
    say("compiling" if last is None else f"compiling or loading, {last:.0f} s last time")
    start = time.monotonic()
    yield
    times = {**_read(file), key: round(time.monotonic() - start, 1)}
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(times, indent=1))
    partial.replace(file)


def _read(file: Path) -> dict[str, float]:
    try:
        return json.loads(file.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return {}
