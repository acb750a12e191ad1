"""Metrics in Weights & Biases, in its offline mode; skipped where the package is not installed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytest.importorskip("wandb")

WRITE = """
import sys
from pathlib import Path
from dsvla_jax.training.metrics import MetricsWriter
run, first = Path(sys.argv[1]), int(sys.argv[2])
with MetricsWriter(run, first - 1, "project", {"data": {"tasks": ("lamp_on",)}}) as metrics:
    for step in (first, first + 1):
        metrics.write(step, {"loss": 1 / step, "validation/position_cm": 2.5, "gradient_norm": float("nan")})
"""


def test_a_run_that_goes_on_is_the_same_one_there(tmp_path: Path):
    for first in (1, 3):
        # What it has been told is on disk when the process has ended.
        subprocess.run(
            [sys.executable, "-c", WRITE, str(tmp_path), str(first)],
            cwd=ROOT,
            env={**os.environ, "WANDB_MODE": "offline"},
            check=True,
        )
    stored = sorted((tmp_path / "wandb").glob("offline-run-*/*.wandb"))
    assert len(stored) == 2
    assert {file.stem for file in stored} == {f"run-{(tmp_path / 'wandb_id.txt').read_text()}"}
    for file in stored:
        assert b"validation/position_cm" in file.read_bytes()
        assert b"gradient_norm" not in file.read_bytes()
