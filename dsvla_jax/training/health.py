"""Whether training goes well: how fast it is, what it takes, and steps whose numbers are not finite."""

import contextlib
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from dsvla_jax.errors import UserError
from dsvla_jax.types import Array, named_arrays


class SkippedSteps:
    """Looks after each step whether it was skipped, keeps the batch of one that was, and ends the run past a limit.

    It looks one step late, so that it never waits for the device.

    folder: where the batches go. limit: skipped steps that a run may have. seen: those it had already.
    """

    def __init__(self, folder: Path, limit: int, seen: int) -> None:
        self._folder, self._limit, self._seen = folder, limit, seen
        self._pending: tuple[int, object, Array] | None = None

    def watch(self, step: int, batch: object, total: Array) -> None:
        """batch: this process's part, on the host. total: int32 (), skipped steps up to and with this one."""
        self.settle()
        self._pending = (step, batch, total)

    def settle(self) -> None:
        """Looks at the last step too. Raises UserError past the limit."""
        if self._pending is None:
            return
        step, batch, total = self._pending
        self._pending = None
        if int(total) <= self._seen:
            return
        self._seen = int(total)
        part = f"-process{jax.process_index()}" if jax.process_count() > 1 else ""
        file = self._folder / f"step-{step:08d}{part}.npz"
        self._folder.mkdir(parents=True, exist_ok=True)
        np.savez(file, allow_pickle=False, **named_arrays(batch))
        told = f"step {step}: loss or gradient was not finite; skipped ({self._seen} so far), its batch is in {file}"
        tqdm.write(told, file=sys.stderr)
        if self._seen > self._limit:
            raise UserError(
                f"{told}. That is more than max_skipped_steps {self._limit}: look for NaN in the data, lower the "
                "learning rate, or allow more with --max-skipped-steps; the newest checkpoint is from before"
            )


class Clock:
    """Measures speed, utilisation, and the share of the time that training waits for data.

    Counts from the end of the first step, which compiles.

    flops: of one example in one step. peak: what all chips could do a second; None if it is not known.
    """

    def __init__(self, flops: float, peak: float | None) -> None:
        self._flops, self._peak = flops, peak
        self._start: float | None = None
        self._reset()

    def _reset(self) -> None:
        self._steps = self._examples = self._tokens = 0
        self._waited = 0.0

    def started(self) -> bool:
        """Whether it counts yet."""
        return self._start is not None

    def start(self) -> None:
        """Counts from now on."""
        self._start = time.monotonic()
        self._reset()

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Around waiting for data."""
        start = time.monotonic()
        yield
        self._waited += time.monotonic() - start

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Around what is not training: validation, saving."""
        start = time.monotonic()
        yield
        if self._start is not None:
            self._start += time.monotonic() - start

    def count(self, examples: int, tokens: int) -> None:
        """One more step, of so many examples and text tokens in all processes together."""
        self._steps, self._examples, self._tokens = self._steps + 1, self._examples + examples, self._tokens + tokens

    def read(self) -> dict[str, float]:
        """The figures since the last reading; none where nothing was counted."""
        if self._start is None or self._steps == 0:
            return {}
        seconds = time.monotonic() - self._start
        figures = {
            "seconds_per_step": seconds / self._steps,
            "examples_per_second": self._examples / seconds,
            "tokens_per_second": self._tokens / seconds,
            "data_wait_share": self._waited / seconds,
            "model_tflops_per_second": self._examples * self._flops / seconds / 1e12,
        }
        if self._peak is not None:
            figures["model_flops_utilisation"] = self._examples * self._flops / seconds / self._peak
        self.start()
        return figures


def memory() -> dict[str, float]:
    """Peak memory in GiB: of this process on the host, and of its fullest device where the device tells."""
    # Linux counts kilobytes, macOS bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    figures = {"host_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30}
    peaks = [(device.memory_stats() or {}).get("peak_bytes_in_use") for device in jax.local_devices()]
    if known := [peak for peak in peaks if peak is not None]:
        figures["device_memory_gib"] = max(known) / 2**30
    return figures
