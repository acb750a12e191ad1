"""Whether the files of a checkpoint are those that were written: their sizes and sha256, kept beside them.

Orbax restores arrays with flipped bits without a word, and the errors of a truncated file are TensorStore's.
"""

import json
from pathlib import Path

from dsvla_jax.files import file_digest

FILE = "digests.json"


def write_digests(folder: Path, *, top: bool) -> None:
    """Notes size and sha256 of every file in the folder's sub-folders and, if asked, of those at its top."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and (top or path.parent != folder))
    digests = {str(path.relative_to(folder)): (path.stat().st_size, file_digest(path)) for path in files}
    (folder / FILE).write_text(json.dumps(digests, indent=1) + "\n")


def damage(folder: Path) -> str | None:
    """What is wrong with the files, compared with what `write_digests` noted; None where nothing is."""
    try:
        digests = json.loads((folder / FILE).read_text())
    except FileNotFoundError:
        return f"{FILE} is missing"
    except ValueError:
        return f"{FILE} is not JSON"
    for name, (size, digest) in digests.items():
        path = folder / name
        if not path.is_file():
            return f"{name} is missing"
        if path.stat().st_size != size:
            return f"{name} has {path.stat().st_size} bytes, {size} were written"
        if file_digest(path) != digest:
            return f"{name} is not what was written (sha256 differs)"
    return None
