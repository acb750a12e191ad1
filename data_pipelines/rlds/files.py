"""Files by local path or URL: everything here that opens one does it through these few lines."""

import os
from pathlib import Path
from typing import BinaryIO, cast

import fsspec
from fsspec import AbstractFileSystem

from dsvla_jax.errors import DataError


def is_remote(path: str) -> bool:
    """Whether a path is a URL that fsspec opens (gs://, s3://, memory://, ...)."""
    return "://" in path


def as_text(path: str | os.PathLike[str]) -> str:
    """The path as text; objects of etils' ``epath`` and of pathlib are welcome."""
    return os.fspath(path)


def join(folder: str, *names: str) -> str:
    """The path of a file in a folder."""
    return "/".join([folder.rstrip("/"), *names])


def open_binary(path: str) -> BinaryIO:
    """Opens for reading. Raises DataError naming the file where there is none."""
    try:
        if not is_remote(path):
            return Path(path).open("rb")
        file_system, name = _file_system(path)
        return cast(BinaryIO, file_system.open(name, "rb"))
    except FileNotFoundError as error:
        raise DataError(path, "file", "to be present", "no such file", "copy the whole build again") from error


def read_text(path: str) -> str:
    """The whole file as UTF-8."""
    with open_binary(path) as file:
        return file.read().decode()


def exists(path: str) -> bool:
    """Whether there is such a file or folder."""
    if not is_remote(path):
        return Path(path).exists()
    file_system, name = _file_system(path)
    return bool(file_system.exists(name))


def size_of(path: str) -> int:
    """Bytes of a file."""
    if not is_remote(path):
        return Path(path).stat().st_size
    file_system, name = _file_system(path)
    return int(cast(int, file_system.size(name)))


def written(path: str) -> float | None:
    """When a file was last written, in seconds since 1970; None where its file system does not tell."""
    if not is_remote(path):
        return Path(path).stat().st_mtime
    file_system, name = _file_system(path)
    try:
        return file_system.modified(name).timestamp()
    except NotImplementedError:
        return None


def folders_in(path: str) -> list[str]:
    """The names of the folders in a folder, sorted; empty where there is no such folder."""
    if not is_remote(path):
        here = Path(path)
        return sorted(child.name for child in here.iterdir() if child.is_dir()) if here.is_dir() else []
    file_system, name = _file_system(path)
    entries: list[dict[str, str]] = file_system.ls(name, detail=True) if file_system.isdir(name) else []
    return sorted(entry["name"].rstrip("/").rsplit("/", 1)[-1] for entry in entries if entry["type"] == "directory")


def _file_system(path: str) -> tuple[AbstractFileSystem, str]:
    """What fsspec opens a URL with, and the name that it knows the file by."""
    try:
        return fsspec.core.url_to_fs(path)
    except (ImportError, ValueError) as error:
        fix = "install the package it names, or correct the address"
        raise DataError(path, "address", "a file system that is installed", str(error), fix) from error
