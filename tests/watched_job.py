"""A job of several processes under a `Watchdog`, one of which goes wrong: python -m tests.watched_job FOLDER HOW.

HOW is what process 1 does at step 3: kill, raise, stall or nothing.
"""

import os
import signal
import sys
import threading
from pathlib import Path

import jax
import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.experiment import MeshConfig
from dsvla_jax.training.distributed import Watchdog, start_processes
from dsvla_jax.training.sharding import make_mesh, put_batch


def main(folder: Path, how: str) -> None:
    start_processes()
    mesh = make_mesh(MeshConfig())
    total = jax.jit(lambda batch: batch["x"].sum())
    with Watchdog(folder, silence=4, limit=12, interval=0.5).watching() as watchdog:
        for step in range(6):
            watchdog.doing(f"reading data for step {step}")
            if jax.process_index() == 1 and step == 3:
                if how == "kill":
                    # Notes are written from time to time: one that the others can read says what it died of.
                    while "step 3" not in (folder / "process-1.json").read_text():
                        os.sched_yield()
                    os.kill(os.getpid(), signal.SIGKILL)
                if how == "raise":
                    raise UserError("episode 17: truncated")
                if how == "stall":
                    threading.Event().wait()
            batch = put_batch({"x": np.full(4, step, np.float32)}, mesh)
            watchdog.doing(f"computing step {step}")
            print("sum", float(total(batch)), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
