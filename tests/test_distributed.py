"""Jobs of several processes: how they find each other, and how they end where one of them goes wrong."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dsvla_jax.errors import UserError
from dsvla_jax.training.distributed import EXPLICIT, PEER_FAILED, launch_arguments
from tests.test_sharding import ROOT, free_address


def test_a_program_runs_alone_unless_told_otherwise():
    assert launch_arguments({}) is None
    # A shell inside an allocation is no step of several tasks.
    assert launch_arguments({"SLURM_JOB_ID": "1", "SLURM_NTASKS": "4", "SLURM_STEP_NUM_TASKS": "1"}) is None


def test_a_slurm_step_of_several_tasks_finds_itself():
    assert launch_arguments({"SLURM_STEP_NUM_TASKS": "4"}) == {"cluster_detection_method": "slurm"}


def test_explicit_addresses_win():
    explicit = {"JAX_COORDINATOR_ADDRESS": "one:1234", "JAX_NUM_PROCESSES": "16", "JAX_PROCESS_ID": "3"}
    expected = {"coordinator_address": "one:1234", "num_processes": 16, "process_id": 3}
    assert launch_arguments({**explicit, "SLURM_STEP_NUM_TASKS": "4"}) == expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"JAX_PROCESS_ID": None}, "without JAX_PROCESS_ID"),
        ({"JAX_PROCESS_ID": "2"}, "from 0 to JAX_NUM_PROCESSES - 1, got '2' of '2'"),
        ({"JAX_NUM_PROCESSES": "two"}, "got '0' of 'two'"),
        ({"JAX_COORDINATOR_ADDRESS": "one"}, "expected host:port of process 0, got 'one'"),
    ],
)
def test_incomplete_addresses_are_named(change, message):
    given = {"JAX_COORDINATOR_ADDRESS": "one:1", "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "0", **change}
    with pytest.raises(UserError, match=message):
        launch_arguments({name: value for name, value in given.items() if value is not None})


def test_the_cluster_files_name_what_the_program_reads():
    manifest, script = ((ROOT / "cluster" / name).read_text() for name in ("jobset.yaml", "slurm.sh"))
    assert all(f"name: {name}\n" in manifest for name in EXPLICIT)
    assert f'"$status" -eq {PEER_FAILED} ]' in script
    subprocess.run(["bash", "-n", ROOT / "cluster" / "slurm.sh"], check=True)


def run_job(folder: Path, how: str) -> list[tuple[int, str, str]]:
    """Status, output and errors of the two processes of `tests.watched_job`."""
    address = free_address()
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.watched_job", str(folder), how],
            cwd=ROOT,
            env={
                **os.environ,
                "JAX_PLATFORMS": "cpu",
                "JAX_COORDINATOR_ADDRESS": address,
                "JAX_NUM_PROCESSES": "2",
                "JAX_PROCESS_ID": str(index),
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(2)
    ]
    try:
        outputs = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [(process.returncode, *output) for process, output in zip(processes, outputs, strict=True)]


def test_a_process_that_dies_ends_the_job_with_a_message(tmp_path: Path):
    # A job before this one left its file: it means nothing now.
    (tmp_path / "process-1.json").write_text('{"job": -1, "host": "x", "doing": "", "error": "old"}')
    (status, output, errors), (killed, _, _) = run_job(tmp_path, "kill")
    assert (status, killed) == (PEER_FAILED, -9), errors
    assert [line for line in output.splitlines() if line.startswith("sum")] == ["sum 0.0", "sum 8.0", "sum 16.0"]
    assert "error: process 0 of 2 ends: process 1 on " in errors
    assert "while reading data for step 3: it died, or is cut off" in errors


@pytest.mark.slow
def test_an_error_in_one_process_is_told_by_all(tmp_path: Path):
    (status, _, errors), (failed, _, own) = run_job(tmp_path, "raise")
    assert (status, failed) == (PEER_FAILED, 1), errors
    assert "error: episode 17: truncated" in own
    assert "failed with UserError: episode 17: truncated" in errors


@pytest.mark.slow
def test_a_process_that_holds_the_others_up_is_named(tmp_path: Path):
    results = run_job(tmp_path, "stall")
    assert [status for status, _, _ in results] == [PEER_FAILED] * 2
    for _, _, errors in results:
        assert "reading data for step 3" in errors or "failed with ended because" in errors
    assert any("there was no progress for" in errors for _, _, errors in results)


@pytest.mark.slow
def test_a_job_without_trouble_ends_well(tmp_path: Path):
    results = run_job(tmp_path, "nothing")
    assert [status for status, _, _ in results] == [0, 0], results
    assert not list(tmp_path.iterdir())
