"""RLBench's pickles: nothing in them is run, what is known comes back, and damage is named."""

import pickle
import random
import subprocess
from typing import Any

import numpy as np
import pytest

from data_pipelines.rlbench.files import read_recording
from data_pipelines.rlbench.unpickle import read_pickle, to_array
from dsvla_jax.errors import DataError
from tests import rlbench_files as files


def global_payload(module, name, path):
    """A pickle that calls module.name(path), in the plain text protocol."""
    return f"c{module}\n{name}\n(V{path}\ntR.".encode()


def test_nothing_in_a_pickle_is_run(tmp_path):
    victim = tmp_path / "made"
    payloads = {
        "reduce": pickle.dumps(files.Loud(victim)),
        "nested": pickle.dumps({"_observations": [1, {"misc": files.Loud(victim)}]}),
        "posix": global_payload("posix", "mkdir", victim),
        "builtins": global_payload("builtins", "eval", f"__import__('os').mkdir('{victim}')"),
        "numpy": global_payload("numpy.testing._private.utils", "runstring", victim),
        "dotted": b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93.",
        "codecs": global_payload("_codecs", "lookup", victim),
        "rlbench": global_payload("rlbench.backend.utils", "image_to_float_array", victim),
        "process": pickle.dumps(subprocess.Popen),
    }
    path = tmp_path / "low_dim_obs.pkl"
    for data in payloads.values():
        path.write_bytes(data)
        with pytest.raises(DataError, match=r"low_dim_obs.pkl: pickle: expected only .*nothing in it was run"):
            read_pickle(path)
        assert not victim.exists()
    # The payloads are real: pickle itself runs them.
    pickle.loads(payloads["reduce"])
    assert victim.exists()


def test_known_names_stay_inert(tmp_path):
    # `encode` is known, but what it is called with is only kept.
    path = tmp_path / "x.pkl"
    path.write_bytes(b"c_codecs\nencode\n(Vtext\nVno such encoding\ntR.")
    kept: Any = read_pickle(path)
    assert kept.args == ("text", "no such encoding")
    path.write_bytes(pickle.dumps(np.array([{"a": 1}, None], object)))
    with pytest.raises(ValueError, match="an array of"):
        to_array(read_pickle(path))


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_arrays_come_back(tmp_path, protocol):
    values = [
        np.arange(6, dtype=np.float32).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(4, dtype=">i4"),
        np.array([]),
        np.array(1.5),
        np.float64(2.5),
        np.int64(-7),
        np.bool_(True),
        np.array([True, False]),
    ]
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps(values, protocol))
    stored: Any = read_pickle(path)
    for read, value in zip(stored, values, strict=True):
        np.testing.assert_array_equal(to_array(read), value)
        assert to_array(read).shape == np.shape(value)


def test_damaged_pickles_are_refused_and_named(tmp_path):
    files.write_episode(tmp_path, frames=5, size=8)
    path = tmp_path / "low_dim_obs.pkl"
    whole = path.read_bytes()
    rng = random.Random(0)
    damaged = [whole[: rng.randrange(len(whole))] for _ in range(50)]
    for _ in range(400):
        changed = bytearray(whole)
        for _ in range(3):
            changed[rng.randrange(len(whole))] = rng.randrange(256)
        damaged.append(bytes(changed))
    refused = []
    for data in damaged:
        path.write_bytes(data)
        try:
            read_recording(tmp_path, "lamp_on")
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 50  # all the short ones, and changes of structure
    assert all("low_dim_obs.pkl" in message for message in refused)
