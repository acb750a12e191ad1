"""A tensor of a checkpoint on disk, read some rows at a time: what the reader of every format lists."""

import dataclasses
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from dsvla_jax.errors import UserError

FLOATS = {"F32": np.dtype(np.float32), "F16": np.dtype(np.float16), "BF16": np.dtype(jnp.bfloat16)}
AGAIN = "download it again"


class WeightsError(UserError):
    """A checkpoint of another project is missing, damaged, or of a kind that does not fit here."""


@dataclasses.dataclass(frozen=True)
class StoredTensor:
    """Where one tensor lies, row-major. dtype: its name in FLOATS. begin, end: bytes from the start of the file."""

    key: str
    file: Path
    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int

    def check(self) -> None:
        """Raises WeightsError where the numbers are of no kind that is read, or do not fill their bytes."""
        dtype = FLOATS.get(self.dtype)
        if dtype is None:
            raise WeightsError(
                f"{self.file}: {self.key}: expected dtype {', '.join(FLOATS)}, found {self.dtype}; "
                "use an unquantised checkpoint"
            )
        if self.end - self.begin != math.prod(self.shape) * dtype.itemsize:
            raise WeightsError(
                f"{self.file}: {self.key}: {self.dtype} {self.shape} does not fill the {self.end - self.begin} bytes "
                f"that the header gives it: the file is damaged; {AGAIN}"
            )

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows ``start`` to ``stop`` of the first axis, in memory of their own: a mapped file would count as ours."""
        self.check()
        rows, *rest = self.shape or (1,)
        stop = rows if stop is None else stop
        row_bytes = (self.end - self.begin) // max(rows, 1)
        content = self._bytes(self.begin + start * row_bytes, (stop - start) * row_bytes)
        return content.view(FLOATS[self.dtype]).reshape((stop - start, *rest) if self.shape else ())

    def _bytes(self, begin: int, count: int) -> np.ndarray:
        content = np.fromfile(self.file, np.uint8, count, offset=begin)
        if len(content) != count:
            raise WeightsError(f"{self.file}: {self.key}: cut short while it was read; {AGAIN}")
        return content
