"""TFRecord files without TensorFlow: framing and checksums.

A record is: length (uint64, little-endian), masked CRC32C of those 8 bytes (uint32), the bytes, masked CRC32C of the
bytes (uint32). The mask is that of TensorFlow's core/lib/io/record_writer: rotate right by 15 bits, add 0xa282ead8.
"""

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import google_crc32c
import numpy as np

from dsvla_jax.errors import DataError

HEADER_BYTES, FOOTER_BYTES = 12, 4
_MASK_DELTA = 0xA282EAD8
_FIX = "copy the file again, or leave its bad records out with --skip-bad"


def masked_crc(data: bytes) -> int:
    """The checksum that TFRecord files store."""
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + _MASK_DELTA) & 0xFFFFFFFF


def record_offsets(file: BinaryIO, size: int, where: object) -> np.ndarray:
    """int64 (R + 1,): where each record starts, and where the last one ends; only headers are read.

    The last entry is smaller than `size` where the file ends within a record: the records before it are intact.
    Raises DataError where a header's checksum is wrong: what follows it cannot be found.
    """
    offsets = [0]
    while offsets[-1] + HEADER_BYTES <= size:
        file.seek(offsets[-1])
        length = _length(file.read(HEADER_BYTES), f"{where}, record {len(offsets) - 1}")
        end = offsets[-1] + HEADER_BYTES + length + FOOTER_BYTES
        if end > size:
            break
        offsets.append(end)
    return np.array(offsets, np.int64)


def read_record(file: BinaryIO, offset: int, where: object) -> bytes:
    """The bytes of the record that starts at `offset`, both checksums verified."""
    file.seek(offset)
    length = _length(file.read(HEADER_BYTES), where)
    data, footer = file.read(length), file.read(FOOTER_BYTES)
    if len(data) + len(footer) != length + FOOTER_BYTES:
        raise DataError(where, "record", f"{length} bytes and a checksum", f"{len(data)} (truncated)", _FIX)
    (stored,) = struct.unpack("<I", footer)
    if (crc := masked_crc(data)) != stored:
        raise DataError(where, "CRC of the record", f"{stored:#010x}", f"{crc:#010x}", _FIX)
    return data


def write_records(path: Path, records: Iterable[bytes]) -> None:
    """Writes a TFRecord file."""
    with path.open("wb") as file:
        for record in records:
            length = struct.pack("<Q", len(record))
            file.write(length + struct.pack("<I", masked_crc(length)))
            file.write(record + struct.pack("<I", masked_crc(record)))


def _length(header: bytes, where: object) -> int:
    if len(header) != HEADER_BYTES:
        raise DataError(where, "header", f"{HEADER_BYTES} bytes", f"{len(header)} (truncated)", _FIX)
    length, stored = struct.unpack("<QI", header)
    if (crc := masked_crc(header[:8])) != stored:
        raise DataError(where, "CRC of the length", f"{stored:#010x}", f"{crc:#010x}", _FIX)
    return length
