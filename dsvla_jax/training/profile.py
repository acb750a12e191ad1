"""Where the time of a step goes: a trace of some of them, written by JAX's profiler."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import jax
from tqdm import tqdm

from dsvla_jax.policies.interface import Metrics
from dsvla_jax.training.loop import Step
from dsvla_jax.training.state import TrainState

# The first call compiles, and the second may wait for what the first has left behind.
FIRST = 3


@contextlib.contextmanager
def trace_steps(step: Step, folder: Path, count: int) -> Iterator[Step]:
    """The step; its calls from the third on, `count` of them or as many as there are, leave a trace in the folder."""
    calls, tracing = 0, False

    def stop() -> None:
        nonlocal tracing
        tracing = False
        jax.profiler.stop_trace()
        if jax.process_index() == 0:
            tqdm.write(
                f"trace: {folder} (pip install xprof, and: xprof --logdir {folder}; or open the .trace.json.gz in it "
                "at https://ui.perfetto.dev)"
            )

    def traced(state: TrainState, batch: object) -> tuple[TrainState, Metrics]:
        nonlocal calls, tracing
        calls += 1
        if count and calls == FIRST:
            jax.block_until_ready(state)
            jax.profiler.start_trace(folder)
            tracing = True
        with jax.profiler.StepTraceAnnotation("train", step_num=calls):
            result = step(state, batch)
        if tracing and calls == FIRST + count - 1:
            jax.block_until_ready(result)
            stop()
        return result

    try:
        yield traced
    finally:
        if tracing:
            stop()
