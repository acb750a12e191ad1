"""Jobs in other processes, which report as they go on and end when the program that started them ends."""

import contextlib
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.managers import SyncManager

from dsvla_jax.errors import UserError


def complete_in_processes(
    work: Callable[..., None],
    jobs: Sequence[tuple[object, ...]],
    workers: int,
    keep: Callable[..., None],
    start: Callable[[], None] | None = None,
) -> None:
    """Calls work(*job, report) for each job in one of `workers` processes; keep(*report) is called in this one.

    work, start: functions of a module; `start` is called in each process first. An error of a job is raised here and
    ends the others, as do Ctrl-C and, however this process ends, its end.
    """
    # Not forked: JAX has threads of its own.
    context = multiprocessing.get_context("spawn")
    manager = SyncManager(ctx=context)
    manager.start(_end_with_parent)
    with manager, ProcessPoolExecutor(workers, context, _start_worker, (start,)) as pool:
        finished = manager.Queue()
        waiting = [pool.submit(_work_and_report, work, job, finished) for job in jobs]
        try:
            while waiting or not finished.empty():
                with contextlib.suppress(queue.Empty):
                    keep(*finished.get(timeout=0.2))
                for future in [future for future in waiting if future.done()]:
                    waiting.remove(future)
                    future.result()
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            if isinstance(error, BrokenProcessPool):
                raise UserError(
                    "a worker process was ended from outside, most often for want of memory; use fewer workers, then "
                    "run the same command again"
                ) from error
            raise


def _start_worker(start: Callable[[], None] | None) -> None:
    # An interrupt is for the first process, which ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    if start is not None:
        start()


def _end_with_parent() -> None:
    """Ends this process when its parent is gone, even if that was killed and could not end its workers."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _work_and_report(work: Callable[..., None], job: tuple[object, ...], finished: queue.Queue) -> None:
    work(*job, lambda *report: finished.put(report))
