"""What all programs check of JAX's settings before they do anything."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from dsvla_jax.command_line import DRAWS, configure_jax
from dsvla_jax.errors import UserError
from dsvla_jax.sim.environment import Environment

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("name", "value"),
    [("jax_enable_x64", True), ("jax_threefry_partitionable", False), ("jax_default_prng_impl", "rbg")],
)
def test_settings_that_draw_other_episodes_are_refused(name, value):
    jax.config.update(name, value)
    try:
        for start in (configure_jax, lambda: Environment("lamp_on")):
            with pytest.raises(UserError, match=rf"{name.upper()}: expected .*, got {value}: the same seeds"):
                start()
    finally:
        jax.config.update(name, DRAWS[name])


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        ({"JAX_ENABLE_X64": "1"}, "error: JAX_ENABLE_X64: expected False, got True"),
        ({"JAX_PLATFORMS": "nonsense"}, "error: JAX_PLATFORMS=nonsense: no such device here"),
    ],
)
def test_a_program_says_so_in_one_message(tmp_path, variable, message):
    command = [sys.executable, "eval.py", str(tmp_path / "run")]
    finished = subprocess.run(command, cwd=ROOT, env=os.environ | variable, capture_output=True, text=True)
    assert finished.returncode == 1
    assert finished.stderr.startswith(message)
    assert "Traceback" not in finished.stderr
