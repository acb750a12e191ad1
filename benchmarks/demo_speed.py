"""100 demonstrations of every task at 128 px: at most 45 minutes on two cores and 0.5 GB (up to 45 minutes).

Usage: python -m benchmarks.demo_speed [FOLDER] [EPISODES]; without a folder, in a temporary one.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

from data_pipelines.demos import generate_demonstrations
from data_pipelines.episodes import read_index
from dsvla_jax.command_line import configure_jax
from dsvla_jax.sim.tasks import TASKS

MINUTES, BYTES = 45, 0.5e9


def main(folder: Path, episodes: int) -> int:
    configure_jax()
    start = time.monotonic()
    generate_demonstrations(folder, tuple(TASKS), episodes, image_size=128, workers=os.cpu_count() or 1)
    minutes = (time.monotonic() - start) / 60
    index = read_index(folder)
    size = sum(shard["bytes"] for shard in index["shards"])
    share = episodes * len(TASKS) / 2600
    print(
        f"{len(TASKS)} tasks x {episodes}: {minutes:.1f} minutes (at most {MINUTES * share:.1f}), "
        f"{size / 1e6:.0f} MB (at most {BYTES * share / 1e6:.0f}), {index['frames']} frames"
    )
    return int(minutes > MINUTES * share or size > BYTES * share)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        target = Path(sys.argv[1] if len(sys.argv) > 1 else temporary)
        sys.exit(main(target, int(sys.argv[2]) if len(sys.argv) > 2 else 100))
