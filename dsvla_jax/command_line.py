"""What the two programs and the `python -m` commands have in common at their outermost edge."""

import contextlib
import ctypes
import errno
import io
import logging
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import jax
import tyro

from dsvla_jax.errors import UserError

Parsed = TypeVar("Parsed")

_UNREACHABLE = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH)


@contextlib.contextmanager
def fail_with_message() -> Iterator[None]:
    """Ends the program with one clear message and status 1 where the input, not the code, is at fault."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        if error.errno in _UNREACHABLE or isinstance(error, socket.gaierror):
            fix = "check its address, and that it runs and can be reached from here"
            print(f"error: no connection to the other machine or program: {error.strerror}; {fix}", file=sys.stderr)
            sys.exit(1)
        # Without a file's name it is no file that a user named, unless the disk is full.
        if error.filename is None and error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        where = "" if error.filename is None else f"{error.filename}: "
        fix = "choose another path, or mend this one (its name, permissions, free space)"
        print(f"error: {where}{error.strerror}; {fix}", file=sys.stderr)
        sys.exit(1)
    except jax.errors.JaxRuntimeError as error:
        if not str(error).startswith("RESOURCE_EXHAUSTED"):
            raise
        message = str(error).splitlines()[0][:200]
        print(f"error: out of memory: {message}; lower the batch size, or use more or larger devices", file=sys.stderr)
        sys.exit(1)
    except Exception as error:
        # array_record, tensorstore and other native libraries have their own errors for a full or read-only disk.
        if not any(os.strerror(number) in str(error) for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)):
            raise
        print(f"error: {str(error).splitlines()[0]}; free space, or choose another path", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("stopped; nothing that was finished is lost", file=sys.stderr)
        sys.exit(130)


def require_each_option_once(arguments: Sequence[str]) -> None:
    """Raises UserError if an option is given twice: tyro would silently drop what was given first."""
    names = [word.split("=")[0].replace("_", "-") for word in arguments if word.startswith("--")]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"{name} is given {names.count(name)} times; give it once, with all its values after it")


class _Ended(SystemExit):
    """SIGTERM came."""


@contextlib.contextmanager
def ended_by_sigterm(kept: str) -> Iterator[None]:
    """Within the block SIGTERM raises SystemExit, so that what the block began is ended too; a second one kills.

    The status is 75, as of a run that saved and stopped: schedulers may requeue. kept: said to people. Does nothing
    outside of the main thread, or in a job of several processes, whose SIGTERM JAX's preemption service notes.
    """
    if threading.current_thread() is not threading.main_thread() or jax.distributed.is_initialized():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        raise _Ended(os.EX_TEMPFAIL)

    previous = signal.signal(signal.SIGTERM, end)
    try:
        yield
    except _Ended:
        print(f"SIGTERM: {kept}", file=sys.stderr)
        raise
    finally:
        signal.signal(signal.SIGTERM, previous)


def cache_folder() -> Path | None:
    """Where things are kept that can be made again; None if the user has no home, or nothing can be written there.

    By the XDG standard a variable that is empty or names a relative path counts as not set.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        folder = (base if base.is_absolute() else Path.home() / ".cache") / "dsvla_jax"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 16))
    except (OSError, RuntimeError):
        return None
    return folder


# What decides random draws, with JAX's own defaults.
DRAWS = {"jax_enable_x64": False, "jax_threefry_partitionable": True, "jax_default_prng_impl": "threefry2x32"}


def require_usual_draws() -> None:
    """Raises UserError where JAX is set to draw other numbers from the same keys: episodes would start otherwise."""
    for name, value in DRAWS.items():
        if (found := getattr(jax.config, name)) != value:
            raise UserError(
                f"{name.upper()}: expected {value}, got {found}: the same seeds would give other episodes and losses, "
                "which compare with no other run's; unset it"
            )


def _require_platform() -> None:
    """Raises UserError where the user asked for devices that this machine or this installation lacks."""
    asked = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue]
    if not asked:
        return
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        reason = f" ({error})" if str(error) else ""
        raise UserError(
            f"JAX_PLATFORMS={asked}: no such device here, or jax is installed without support for it{reason}; install "
            "that (https://docs.jax.dev/en/latest/installation.html), or unset JAX_PLATFORMS"
        ) from error


def configure_jax(physics: str = "mujoco") -> None:
    """Keeps compiled programs on disk, so that the second run of anything starts at once. Call it before any array.

    physics: "mjx" if MJX will run. Raises UserError where JAX's settings would change results, or name devices that
    are not there.
    """
    require_usual_draws()
    if physics == "mjx" and jax.__version_info__ < (0, 11):
        # Among several threads, XLA's CPU client of jax 0.10 loses large programs of MJX (stack_blocks'), which then
        # never end. It reads this when it starts; MJX's arrays are too small to gain from threads.
        os.environ.setdefault("NPROC", "1")
    cached = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if cached is None:
        folder = cache_folder()
        if folder is not None:
            jax.config.update("jax_compilation_cache_dir", str(folder / "xla"))
        elif multiprocessing.parent_process() is None:
            print("compiled programs are not kept for the next time: no cache folder can be written", file=sys.stderr)
    # Orbax would log every item that it reads or writes, and warn of what it was asked for, such as reading only.
    logging.getLogger("absl").setLevel(logging.ERROR)
    # A cache whose disk fills up later costs time only, and JAX would say so for every program.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    _require_platform()


# From glibc's malloc.h: how many blocks may be pages of their own, the free memory at the end that is handed back, and
# how many heaps there are.
M_MMAP_MAX, M_TRIM_THRESHOLD, M_ARENA_MAX = -4, -1, -8


def keep_freed_memory() -> None:
    """Keeps freed memory for the process's next use instead of returning it to the system.

    Call it before threads start; without glibc it does nothing. XLA's CPU client allocates a program's temporaries anew
    at every call. As blocks of their own they would come as fresh pages each time, and to fault those in takes a fifth
    of a training step.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1), (M_ARENA_MAX, 1)):
            mallopt(parameter, value)


def parse_options(options: Callable[..., Parsed], **settings: Any) -> Parsed:  # noqa: ANN401, those of `tyro.cli`
    """`tyro.cli`, but for values that a config refuses: those end in the config's own message (UserError).

    options: what tyro makes an object of; if a function, one that only returns what it is given. settings: as tyro's.
    Raises UserError for an option that is given twice, too.
    """
    require_each_option_once(settings.get("args", sys.argv[1:]))
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            parsed = tyro.cli(options, **settings)
    except SystemExit as end:
        cause: BaseException | None = end
        while cause is not None and not isinstance(cause, UserError):
            cause = cause.__context__
        if cause is not None:
            raise cause from None
        print(printed.getvalue(), end="", file=sys.stderr)
        raise
    print(printed.getvalue(), end="", file=sys.stderr)
    return parsed
