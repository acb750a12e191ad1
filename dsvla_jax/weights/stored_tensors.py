"""A tensor of a checkpoint on disk, read some rows at a time: what the reader of every format lists."""

import dataclasses
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from dsvla_jax.errors import UserError

INTEGERS = {"I64": np.dtype(np.int64), "I32": np.dtype(np.int32)}
FLOATS = {"F32": np.dtype(np.float32), "F16": np.dtype(np.float16), "BF16": np.dtype(jnp.bfloat16)}
AGAIN = "download it again"
COMPARED_ROWS = 1024


class WeightsError(UserError):
    """A checkpoint of another project is missing, damaged, or of a kind that does not fit here."""


@dataclasses.dataclass(frozen=True)
class StoredTensor:
    """Where one tensor lies, row-major. dtype: its name in FLOATS. begin, end: bytes from the start of the file.

    head_dim: not 0 where rows that are rotated together lie side by side, in heads of so many rows; they are read as
    the model wants them, half a head apart.
    """

    key: str
    file: Path
    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int
    head_dim: int = 0

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
        stop = self.shape[0] if stop is None else stop
        part = self.rows(start, stop)
        content = np.fromfile(self.file, np.uint8, part.end - part.begin, offset=part.begin)
        if len(content) != part.end - part.begin:
            raise WeightsError(f"{self.file}: {self.key}: cut short while it was read; {AGAIN}")
        values = self._decode(content).reshape(part.shape)
        if not self.head_dim:
            return values
        return values.reshape(-1, self.head_dim // 2, 2, *self.shape[1:]).swapaxes(1, 2).reshape(values.shape)

    def _decode(self, content: np.ndarray) -> np.ndarray:
        return content.view(FLOATS[self.dtype])

    def equals(self, other: "StoredTensor", rounded: bool = False) -> bool:
        """Whether another tensor holds the same numbers; rounded: as far as the coarser of the two can write them."""
        if self.shape != other.shape or not self.shape:
            return False
        kinds = [FLOATS.get(tensor.dtype, FLOATS["F32"]) for tensor in (self, other)]
        coarse = min(kinds, key=lambda kind: (kind.itemsize, jnp.finfo(kind).nmant)) if rounded else FLOATS["F32"]
        head_dim = max(self.head_dim, other.head_dim, 1)
        step = max(COMPARED_ROWS // head_dim, 1) * head_dim
        for start in range(0, self.shape[0], step):
            stop = min(start + step, self.shape[0])
            one, two = (tensor.read(start, stop).astype(coarse).astype(np.float32) for tensor in (self, other))
            if not np.array_equal(one, two):
                return False
        return True

    def holds(self, constant: np.ndarray) -> bool:
        """Whether it holds these numbers, but for the rounding of 16-bit floats; leading axes of length 1 are free."""
        dtype = (FLOATS | INTEGERS).get(self.dtype)
        shape = self.shape[max(len(self.shape) - constant.ndim, 0) :]
        if dtype is None or shape != constant.shape or self.end - self.begin != constant.size * dtype.itemsize:
            return False
        stored = np.fromfile(self.file, dtype, constant.size, offset=self.begin)
        return np.allclose(stored.astype(np.float64).reshape(shape), constant, rtol=2**-7, atol=2**-24)

    def rows(self, start: int, stop: int) -> "StoredTensor":
        """The part between two rows of the first axis."""
        row = (self.end - self.begin) // self.shape[0]
        begin = self.begin + start * row
        return dataclasses.replace(
            self, shape=(stop - start, *self.shape[1:]), begin=begin, end=begin + (stop - start) * row
        )
