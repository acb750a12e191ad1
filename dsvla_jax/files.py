"""Files that another program or a full disk could spoil: one writer a folder, whole files, errors that name them."""

import contextlib
import errno
import fcntl
import hashlib
import os
import shutil
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from dsvla_jax.errors import UserError

LOCK_FILE = ".lock"

# What file systems without locks answer, such as Lustre mounted without `flock`.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


def hold_folder(folder: Path, doing: str, wait: bool = False) -> TextIO:
    """Makes the folder and holds it against other writers until the returned file is closed.

    The system lets go of it however this process ends. The lock is `flock`'s: it holds between processes of one host,
    and between hosts where the network file system passes locks on, as NFS does.

    doing: what the other program does there, in words for people. wait: for the other program to end, with a line that
    says so. Otherwise raises UserError if another program, or another part of this one, holds the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = (folder / LOCK_FILE).open("a")
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if not wait:
                raise UserError(f"{folder}: another process {doing}; wait for it, or stop it first") from error
            print(f"{folder}: another process {doing}; waiting for it", file=sys.stderr)
            fcntl.flock(file, fcntl.LOCK_EX)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            file.close()
            raise
        print(f"{folder}: this file system has no locks; make sure that no other program writes here", file=sys.stderr)
    except BaseException:
        file.close()
        raise
    return file


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Around code that writes `path`: turns errors of the disk, those of native libraries too, into UserError.

    Wrap nothing else: every RuntimeError within counts as a failure to write.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        # array_record: "write() failed: No space left on device; writing FILE; at byte 0; ..."
        reason = getattr(error, "strerror", None) or str(error).split(";")[0]
        fix = "free space or correct the permissions there, then run the same command again"
        raise UserError(f"{path}: not written: {reason}; {fix}; what was finished before is whole") from error


@contextlib.contextmanager
def replacing(path: Path, *, durable: bool = False, shared: bool = False) -> Iterator[Path]:
    """Yields the path of a file beside `path` to write to, which takes the place of `path` when the block ends.

    If the block raises, `path` stays as it was and the other file is removed.

    durable: wait until the file and its name are on the disk, for what must survive a machine that loses its power.
    shared: other processes or threads may write the same path at the same time; the last one stays.
    """
    token = f".{uuid.uuid4().hex}" if shared else ""
    partial = path.with_name(f"{path.name}{token}.partial")
    try:
        yield partial
        if durable:
            _sync(partial)
        os.replace(partial, path)
        if durable:
            _sync(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def _sync(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


@contextlib.contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Yields a new folder beside `folder` to write to, which is renamed to `folder` when the block ends.

    `folder` must not exist then, or be empty. If the block raises, the new folder is removed. What a killed process
    left is removed first.
    """
    partial = folder.absolute().with_name(f"{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        yield partial
        partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Writes a file that appears under its name only once it is whole; see `replacing`.

    Raises UserError naming the file if that fails.
    """
    with writing(path), replacing(path, durable=durable) as partial:
        partial.write_bytes(data)


def write_picture(path: Path, rgb: np.ndarray, compression: int = 1) -> None:
    """Writes uint8 (H, W, 3), red first, in the format that the name's ending says. compression: of PNG, 0 to 9.

    Raises UserError naming the file: OpenCV's own `imwrite` only returns False.
    """
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, compression]
    written, data = cv2.imencode(path.suffix, np.ascontiguousarray(rgb[..., ::-1]), parameters)
    if not written:
        raise ValueError(f"{path}: expected a picture uint8 (H, W, 3), got {rgb.dtype} {rgb.shape}")
    write_bytes(path, data.tobytes())


def file_digest(path: Path) -> str:
    """Returns a file's sha256, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
