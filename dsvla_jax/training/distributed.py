"""One program on many hosts: finding the others, and ending with a message where one of them dies or falls behind.

JAX runs the same program in every process, and a step needs all of them: one that is gone leaves the others waiting.
Each process therefore notes in a shared folder what it does, and looks there at what the others do.
"""

import contextlib
import json
import os
import re
import socket
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypedDict

import jax
import numpy as np
from jax.experimental import multihost_utils

from dsvla_jax.errors import UserError
from dsvla_jax.files import replacing

EXPLICIT = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")

# Status of a process that ended because another one did: EX_TEMPFAIL, starting the job again may help.
PEER_FAILED = 75


class LaunchArguments(TypedDict, total=False):
    """Arguments of ``jax.distributed.initialize``: either the first three, or the last."""

    coordinator_address: str
    num_processes: int
    process_id: int
    cluster_detection_method: str


def launch_arguments(environment: Mapping[str, str]) -> LaunchArguments | None:
    """Arguments of ``jax.distributed.initialize``; None for a program that runs alone.

    The three ``EXPLICIT`` variables say who takes part (cluster/jobset.yaml sets them); a Slurm step of several tasks
    says it itself. Raises UserError where the variables are incomplete or contradict each other.
    """
    given = {name: environment[name] for name in EXPLICIT if name in environment}
    if given:
        missing = [name for name in EXPLICIT if name not in given]
        if missing:
            raise UserError(f"{', '.join(given)} without {', '.join(missing)}: set all three, or none to run alone")
        address, count, index = given.values()
        if not count.isdigit() or not index.isdigit() or not int(index) < int(count):
            raise UserError(
                f"JAX_PROCESS_ID: expected a number from 0 to JAX_NUM_PROCESSES - 1, got {index!r} of {count!r}"
            )
        if not address.rpartition(":")[2].isdigit() or ":" not in address:
            raise UserError(f"JAX_COORDINATOR_ADDRESS: expected host:port of process 0, got {address!r}")
        return {"coordinator_address": address, "num_processes": int(count), "process_id": int(index)}
    if int(environment.get("SLURM_STEP_NUM_TASKS", "1")) > 1:
        return {"cluster_detection_method": "slurm"}
    return None


def start_processes(timeout: int = 300) -> None:
    """Joins the other processes of the job, if there are any. Has to come before JAX is used.

    Raises UserError where they are not all there within ``timeout`` seconds.
    """
    arguments = launch_arguments(os.environ)
    if arguments is None:
        return
    try:
        jax.distributed.initialize(**arguments, initialization_timeout=timeout)
    except jax.errors.JaxRuntimeError as error:
        who = ", ".join(f"{name} {value}" for name, value in arguments.items())
        raise UserError(
            f"the processes of this job did not find each other within {timeout} s ({who}); check that all of them "
            f"started, and that the coordinator's port is open between the hosts: {str(error).splitlines()[0]}"
        ) from error


@contextlib.contextmanager
def first_process_first(what: str) -> Iterator[None]:
    """The body runs in process 0, and then in all others: for files that only one of them should make."""
    if jax.process_index() > 0:
        multihost_utils.sync_global_devices(what)
    yield
    if jax.process_index() == 0:
        multihost_utils.sync_global_devices(what)


class Watchdog:
    """Ends this process where the job cannot go on: another one failed, fell silent, or holds everybody up.

    folder: one that all processes see; each keeps a small file there. silence: seconds after which a process that
    notes nothing counts as dead. limit: seconds without progress after which the job ends, from the first `doing` on.
    Does nothing in a program that runs alone.
    """

    def __init__(self, folder: Path, silence: float = 60.0, limit: float = 1800.0, interval: float = 5.0) -> None:
        self._folder, self._silence, self._limit, self._interval = folder, silence, limit, interval
        self._index, self._count = jax.process_index(), jax.process_count()
        # Files of an earlier job in the same folder mean nothing: all processes agree on a number for this one.
        job = int(multihost_utils.broadcast_one_to_all(np.int32(time.time() % 2**31))) if self._count > 1 else 0
        self._note: dict[str, object] = {"job": job, "host": socket.gethostname(), "doing": "starting", "error": ""}
        self._since: float | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def doing(self, what: str) -> None:
        """Notes progress: what this process does from now on, in words that name the step."""
        self._note["doing"] = what
        self._since = time.monotonic()

    @contextlib.contextmanager
    def watching(self) -> Iterator["Watchdog"]:
        """Around the work of the job. An error in it is told to the other processes and ends this one at once."""
        if self._count == 1:
            yield self
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        self._write()
        self._thread.start()
        try:
            yield self
        except BaseException as error:
            self._stop.set()
            self._fail(error)
        self._stop.set()
        self._thread.join()
        self._file(self._index).unlink(missing_ok=True)

    def _fail(self, error: BaseException) -> None:
        """Tells it here and to the others. Does not return: the end of a whole job would wait for all its processes."""
        if re.match(r"[A-Z_]+: ", str(error)):
            # The runtime's own errors start with a status. A collective broke, most likely because another process did:
            # say which, once its silence shows.
            deadline = time.monotonic() + self._silence + 2 * self._interval
            problem = self._problem()
            while time.monotonic() < deadline and not problem:
                time.sleep(self._interval / 5)
                self._write()
                problem = self._problem()
            if problem:
                self._end(problem)
        if isinstance(error, UserError):
            print(f"error: {error}", file=sys.stderr, flush=True)
        else:
            traceback.print_exception(error)
        self._note["error"] = f"{type(error).__name__}: {error}".splitlines()[0][:500]
        self._write()
        sys.stderr.flush()
        os._exit(130 if isinstance(error, KeyboardInterrupt) else 1)

    def _watch(self) -> None:
        while not self._stop.wait(self._interval):
            self._write()
            if problem := self._problem():
                self._end(problem)

    def _end(self, problem: str) -> None:
        self._note["error"] = f"ended because {problem}"
        self._write()
        message = f"error: process {self._index} of {self._count} ends: {problem}; what is saved can be resumed"
        print(message, file=sys.stderr, flush=True)
        os._exit(PEER_FAILED)

    def _problem(self) -> str:
        """Why the job cannot go on, empty while it can."""
        now = self._file(self._index).stat().st_mtime  # by the clock of the file system that all files are on
        notes = {}
        for index in range(self._count):
            with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
                file = self._file(index)
                note, silent = json.loads(file.read_text()), now - file.stat().st_mtime
                if note["job"] == self._note["job"]:
                    notes[index] = note, silent
        for index, (note, silent) in notes.items():
            who = f"process {index} on {note['host']}"
            if index != self._index and note["error"]:
                return f"{who} failed with {note['error']}"
            if silent > self._silence:
                return f"{who} has been silent for {silent:.0f} s while {note['doing']}: it died, or is cut off"
        waited = 0.0 if self._since is None else time.monotonic() - self._since
        if waited > self._limit:
            each = "; ".join(f"process {one} on {note['host']}: {note['doing']}" for one, (note, _) in notes.items())
            return f"there was no progress for {waited:.0f} s ({each}). Whoever is behind holds the others up"
        return ""

    def _file(self, index: int) -> Path:
        return self._folder / f"process-{index}.json"

    def _write(self) -> None:
        # The watching thread and the one that fails may write at once.
        with replacing(self._file(self._index), shared=True) as partial:
            partial.write_text(json.dumps(self._note))
