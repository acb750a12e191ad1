"""Writes what the published `openpi-client` package (0.1.2) puts on the wire: the oracle of tests/test_serving.py.

pip install --no-deps --target CLIENT openpi-client==0.1.2 && PYTHONPATH=CLIENT python tests/golden/serving.py

"""

from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent


def message() -> dict[str, Any]:
    """Every kind of value that a robot may send."""
    return {
        "prompt": "turn on the light",
        "rgb": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
        "depth": np.array([[0.5, np.inf], [0.0, 1.25]]),
        "transposed": np.arange(6, dtype=np.int16).reshape(2, 3).T,
        "scalar": np.float32(0.25),
        "empty": np.zeros((0, 3), np.float32),
        "switch": np.bool_(True),
        "nested": {"list": [1, 2.5, None, False], "counts": np.array([-1, 2**40])},
    }


if __name__ == "__main__":
    from openpi_client import msgpack_numpy  # type: ignore[import-not-found]

    (HERE / "openpi_message.msgpack").write_bytes(msgpack_numpy.packb(message()))
