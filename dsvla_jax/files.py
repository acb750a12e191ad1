"""Files that another program or a full disk could spoil: one writer a folder, whole files, errors that name them."""

import contextlib
import errno
import fcntl
import os
import sys
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


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file that appears under its name only once it is whole. Raises UserError naming it if that fails."""
    partial = path.with_name(f"{path.name}.partial")
    with writing(path):
        try:
            partial.write_bytes(data)
            os.replace(partial, path)
        except OSError:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            raise


def write_picture(path: Path, rgb: np.ndarray, compression: int = 1) -> None:
    """Writes uint8 (H, W, 3), red first, in the format that the name's ending says. compression: of PNG, 0 to 9.

    Raises UserError naming the file: OpenCV's own `imwrite` only returns False.
    """
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, compression]
    written, data = cv2.imencode(path.suffix, np.ascontiguousarray(rgb[..., ::-1]), parameters)
    if not written:
        raise ValueError(f"{path}: expected a picture uint8 (H, W, 3), got {rgb.dtype} {rgb.shape}")
    write_bytes(path, data.tobytes())
