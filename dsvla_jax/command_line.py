"""What the two programs and the `python -m` commands have in common at their outermost edge."""

import contextlib
import ctypes
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import jax

from dsvla_jax.errors import UserError


@contextlib.contextmanager
def fail_with_message() -> Iterator[None]:
    """Ends the program with one clear message and status 1 where the input, not the code, is at fault."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        # Without a file's name it is no file that a user named, unless the disk is full.
        if error.filename is None and error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        where = "" if error.filename is None else f"{error.filename}: "
        fix = "choose another path, or mend this one (its name, permissions, free space)"
        print(f"error: {where}{error.strerror}; {fix}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("stopped; nothing that was finished is lost", file=sys.stderr)
        sys.exit(130)


def cache_folder() -> Path:
    """Where things are kept that can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "dsvla_jax"


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
    asked = jax.config.jax_platforms
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
    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    _require_platform()


# From glibc's malloc.h: how many blocks may be pages of their own, the free memory at the end that is handed back, and
# how many heaps there are.
M_MMAP_MAX, M_TRIM_THRESHOLD, M_ARENA_MAX = -4, -1, -8


def keep_freed_memory() -> None:
    """Keeps what is freed for the process's next use instead of handing it back to the system. Call it before threads
    start; without glibc it does nothing.

    XLA's CPU client allocates a program's temporaries anew at every call. As blocks of their own they would come as
    fresh pages each time, and to fault those in takes a fifth of a training step.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1), (M_ARENA_MAX, 1)):
            mallopt(parameter, value)
