"""50 robots ask one server for 60 s: no wrong or crossed answer; p50 and p95 latency, and requests/s (3 minutes).

Usage: python -m benchmarks.serving_load [RUN] [--robots 50] [--seconds 60]

Every answer is compared with what the policy answers to the same observation by itself. The floor of a fair
comparison, one robot that asks alone, is measured in the same run.
"""

import collections
import concurrent.futures
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
import tyro

from benchmarks._server import Known, get, known_answers, server_process
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.serving.client import PolicyClient


@dataclasses.dataclass(frozen=True)
class Options:
    """Whom to ask, and how hard."""

    run: tyro.conf.Positional[Path] = Path("runs/tiny")
    robots: int = 50
    seconds: float = 60.0
    batch: int = 16


def ask_for(port: int, known: list[Known], seconds: float, start: int) -> tuple[list[float], int, list[int]]:
    """One robot: seconds of each round trip, wrong answers, and the size of the batch of each."""
    latencies, wrong, batches = [], 0, []
    with PolicyClient(port=port, timeout=seconds + 60) as client:
        end, i = time.monotonic() + seconds, start
        while time.monotonic() < end:
            one = known[i % len(known)]
            began = time.monotonic()
            reply = client.infer(one.request)
            latencies.append(time.monotonic() - began)
            wrong += reply["text"] != one.text
            batches.append(reply["server_timing"]["batch"])
            i += 7  # neighbours in the list are alike
    return latencies, wrong, batches


def measure(port: int, known: list[Known], robots: int, seconds: float) -> int:
    """Prints the figures of so many robots; the number of wrong answers."""
    with concurrent.futures.ThreadPoolExecutor(robots) as pool:
        results = list(pool.map(lambda i: ask_for(port, known, seconds, i), range(robots)))
    latencies = np.concatenate([result[0] for result in results])
    batches = collections.Counter(size for result in results for size in result[2])
    wrong = sum(result[1] for result in results)
    p50, p95 = 1000 * np.percentile(latencies, [50, 95])
    print(
        f"{robots} robot(s): {len(latencies)} requests in {seconds:g} s, {len(latencies) / seconds:.1f}/s, "
        f"p50 {p50:.0f} ms, p95 {p95:.0f} ms, {wrong} wrong; mean batch "
        f"{sum(size * n for size, n in batches.items()) / len(latencies):.1f}",
        flush=True,
    )
    return wrong


def main(options: Options) -> int:
    known = known_answers(options.run, 25)
    print(f"{len(known)} observations with {len({one.text for one in known})} different answers", flush=True)
    with server_process(options.run, "--batch", str(options.batch), "--arms", "1") as (port, _):
        wrong = measure(port, known, 1, min(10.0, options.seconds))
        wrong += measure(port, known, options.robots, options.seconds)
        print("\n".join(line for line in get(port, "/metrics")[1].splitlines() if line.startswith("dsvla_requests_t")))
    return int(wrong > 0)


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax()
        sys.exit(main(parsed))
