"""What two programs at once, a full disk or a signal must not spoil: folders of demonstrations and other files."""

import contextlib
import io
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from array_record.python import array_record_module  # pyright: ignore[reportAttributeAccessIssue]

from data_pipelines.demos import generate_demonstrations
from data_pipelines.episodes import EpisodeReader, write_index
from data_pipelines.processes import complete_in_processes
from data_pipelines.records import decode_rgb
from data_pipelines.rlbench.__main__ import Settings, import_demonstrations
from data_pipelines.writer import DemonstrationWriter
from dsvla_jax.command_line import cache_folder, fail_with_message
from dsvla_jax.compile_times import first_use
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.files import hold_folder, write_picture
from tests.rlbench_files import write_dataset
from tests.test_data import FakeExpert, contents
from tests.test_recording import GOOD, make_recording
from tests.worker_jobs import killed

ROOT = Path(__file__).parent.parent


def test_a_second_writer_is_refused_until_the_first_is_closed(tmp_path):
    with DemonstrationWriter(tmp_path) as first:
        first.add(GOOD, keyframes=[5, 11])
        with pytest.raises(UserError, match=rf"{tmp_path}: another process adds demonstrations there; wait for it"):
            DemonstrationWriter(tmp_path)
    with pytest.raises(UserError, match="this writer is closed"):
        first.add(GOOD, keyframes=[5, 11])
    with DemonstrationWriter(tmp_path) as second:
        second.add(make_recording(task="put_down"), keyframes=[5, 11])
    assert EpisodeReader(tmp_path).tasks == ("pick_up", "put_down")


def test_a_killed_writer_leaves_the_folder_free(tmp_path):
    program = f"""
import sys
from pathlib import Path
from dsvla_jax.files import hold_folder, write_picture
held = hold_folder(Path({str(tmp_path)!r}), "writes there")
print("held", flush=True)
sys.stdin.read()
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(UserError, match="another process"):
            DemonstrationWriter(tmp_path)
        other.kill()
        other.wait()
    DemonstrationWriter(tmp_path).close()


def test_a_writer_does_not_take_the_place_of_a_file_that_no_index_names(tmp_path, capsys):
    """A writer that was killed between a shard and its index left somebody's recordings in it."""
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(GOOD, keyframes=[5, 11])
    stray = (tmp_path / "pick_up-00000.array_record").read_bytes()
    write_index(tmp_path, [], {"importer": "recordings"})
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(GOOD, keyframes=[5, 11])
    assert "not in its index, and left as it is: pick_up-00000.array_record" in capsys.readouterr().err
    assert (tmp_path / "pick_up-00000.array_record").read_bytes() == stray
    assert len(EpisodeReader(tmp_path)) == 1


def test_an_import_is_refused_while_another_one_runs(tmp_path):
    source = write_dataset(tmp_path / "source", ["lamp_on"], episodes=1, frames=12, size=16)
    other = hold_folder(tmp_path / "out", "writes demonstrations there")
    with other, pytest.raises(UserError, match=r"out: another process writes demonstrations there"):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    assert import_demonstrations(source, tmp_path / "out", Settings(), progress=False) == []


def test_of_two_programs_that_want_the_same_demonstrations_one_makes_them(tmp_path, monkeypatch):
    """As when two runs that learn from one folder are started together."""
    working, waiting, experts = threading.Event(), threading.Event(), [FakeExpert(), FakeExpert()]

    class Stream(io.StringIO):
        def write(self, text):
            if "another process makes demonstrations there; waiting for it" in text:
                waiting.set()
            return len(text)

    def slow(task, settings):
        demonstrate = experts[0](task, settings)

        def attempt(start, count):
            working.set()
            assert waiting.wait(60)
            return demonstrate(start, count)

        return attempt

    def generate(folder, demonstrator):
        generate_demonstrations(folder, ["lamp_on"], 8, demonstrator=demonstrator, batch=4, progress=False)

    monkeypatch.setattr(sys, "stderr", Stream())
    shared, alone = tmp_path / "shared", tmp_path / "alone"
    first = threading.Thread(target=generate, args=(shared, slow))
    first.start()
    assert working.wait(60)
    generate(shared, experts[1])
    first.join()
    generate(alone, FakeExpert())
    assert len(experts[0].starts) == 3
    assert experts[1].starts == []
    assert contents(shared) == contents(alone)


def test_a_folder_that_holds_everything_is_not_written_to(tmp_path):
    """It may be on a read-only disk."""
    generate_demonstrations(tmp_path, ["lamp_on"], 8, demonstrator=FakeExpert(), batch=4, progress=False)
    with hold_folder(tmp_path, "makes demonstrations there"):
        generate_demonstrations(tmp_path, ["lamp_on"], 8, demonstrator=FakeExpert(), batch=4, progress=False)


def test_pictures_of_another_size_are_refused_and_cost_no_other_recording(tmp_path):
    small = make_recording(rgb=np.asarray(GOOD.rgb)[:, :8, :8], depth=np.asarray(GOOD.depth)[:, :8, :8])
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(GOOD, keyframes=[5, 11])
        with pytest.raises(DataError, match=r"recording 1 of 'pick_up': picture size: expected \(16, 16\) for all"):
            writer.add(small, keyframes=[5, 11])
    assert len(EpisodeReader(tmp_path)) == 1


def test_errors_come_back_from_worker_processes_as_they_were():
    error = pickle.loads(pickle.dumps(DataError("file", "pose", "numbers", "none", "give some")))
    assert isinstance(error, DataError)
    assert str(error) == "file: pose: expected numbers, got none; give some"


STUCK = """
import threading
from data_pipelines.processes import complete_in_processes


def stuck(name, report):
    report(name)
    threading.Event().wait()


def started(name):
    print(name, flush=True)


if __name__ == "__main__":
    from dsvla_jax.command_line import ended_by_sigterm, fail_with_message

    with fail_with_message(), ended_by_sigterm("what was finished is kept"):
        complete_in_processes(stuck, [("one",), ("two",)], 2, started)
"""


@pytest.mark.parametrize(
    ("number", "status", "said"),
    [
        (signal.SIGTERM, 75, "SIGTERM: what was finished is kept\n"),
        (signal.SIGKILL, -signal.SIGKILL, ""),
    ],
)
def test_workers_end_with_the_program_that_started_them(tmp_path, number, status, said):
    (tmp_path / "stuck.py").write_text(STUCK)
    program = subprocess.Popen(
        [sys.executable, str(tmp_path / "stuck.py")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert program.stdout is not None
    assert sorted(program.stdout.readline() for _ in range(2)) == ["one\n", "two\n"]
    program.send_signal(number)
    # The workers have the same output: it ends when the last of them has ended.
    _, errors = program.communicate(timeout=60)
    assert program.returncode == status
    assert said in errors
    assert "Traceback" not in errors


def test_a_worker_that_was_killed_ends_in_a_message():
    with pytest.raises(UserError, match="a worker process was ended from outside, most often for want of memory"):
        complete_in_processes(killed, [("one",)], 1, print)


@contextlib.contextmanager
def full_disk(room):
    """Files of this process cannot grow beyond `room` bytes: writing fails as on a full disk, also in C++."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


FULL = r"not written: .*File too large; free space or correct the permissions there, then run the same command again"


def test_demonstrations_on_a_full_disk_end_in_one_message_and_continue(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    generate_demonstrations(whole, ["lamp_on"], 8, demonstrator=FakeExpert(), batch=4, progress=False)
    generate_demonstrations(parts, ["lamp_on"], 2, demonstrator=FakeExpert(), batch=4, progress=False)
    before = contents(parts)
    with full_disk(1000), pytest.raises(UserError, match=rf"{parts}/lamp_on-00001.array_record: {FULL}"):
        generate_demonstrations(parts, ["lamp_on"], 8, demonstrator=FakeExpert(), batch=4, progress=False)
    assert contents(parts) == before
    generate_demonstrations(parts, ["lamp_on"], 8, demonstrator=FakeExpert(), batch=4, progress=False)
    assert contents(parts) == contents(whole)


def test_an_import_to_a_full_disk_ends_in_one_message(tmp_path):
    source = write_dataset(tmp_path / "source", ["lamp_on"], episodes=1, frames=12, size=16)
    with full_disk(1000), pytest.raises(UserError, match=rf"lamp_on-00000.array_record: {FULL}"):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    assert len(EpisodeReader(tmp_path / "out")) == 1


@pytest.mark.parametrize("room", [1000, 70000])
def test_recordings_that_a_full_disk_refuses_are_written_later(tmp_path, room):
    """The smaller room ends in the shard, the larger one in the index, which is made long by its instructions."""
    writer = DemonstrationWriter(tmp_path)
    writer.add(GOOD, keyframes=[5, 11])
    writer.add(make_recording(task="put_down", instruction="put the cup down " * 5000), keyframes=[5, 11])
    with full_disk(room), pytest.raises(UserError, match="File too large"):
        writer.close()
    writer.close()
    assert EpisodeReader(tmp_path, verify="sha256").tasks == ("pick_up", "put_down")
    shards = sorted(path.name for path in tmp_path.glob("*.array_record*"))
    assert shards == ["pick_up-00000.array_record", "put_down-00000.array_record"]


def test_pictures_that_cannot_be_written_are_not_passed_over(tmp_path):
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[..., 0] = 200
    write_picture(tmp_path / "strip.png", picture)
    np.testing.assert_array_equal(decode_rgb((tmp_path / "strip.png").read_bytes()), picture)
    with pytest.raises(UserError, match=r"missing/strip.png: not written: No such file"):
        write_picture(tmp_path / "missing" / "strip.png", picture)
    with full_disk(10), pytest.raises(UserError, match=rf"other.png: {FULL}"):
        write_picture(tmp_path / "other.png", picture)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["strip.png"]


def test_native_errors_of_a_full_disk_end_in_one_message(capsys):
    def write():
        writer = array_record_module.ArrayRecordWriter("/dev/full", "group_size:1,uncompressed")
        writer.write(b"record")
        writer.close()

    with pytest.raises(SystemExit) as end, fail_with_message():
        write()
    assert end.value.code == 1
    assert capsys.readouterr().err.startswith("error: write() failed: No space left on device; writing /dev/full")


@pytest.mark.parametrize("kind", ["file", "missing home", "full"])
def test_without_a_cache_the_work_is_done_all_the_same(tmp_path, monkeypatch, kind):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file" if kind == "file" else tmp_path))
    if kind == "missing home":
        monkeypatch.setenv("XDG_CACHE_HOME", "")
        monkeypatch.setenv("HOME", "/dev/null/nobody")
    said = []
    with full_disk(100) if kind == "full" else contextlib.nullcontext():
        assert cache_folder() is None
        with first_use("act", said.append):
            pass
    assert said == ["compiling"]


def test_times_of_compiling_are_noted_where_the_standard_says(tmp_path, monkeypatch):
    """An empty variable is one that is not set; what another program left in the file is not read as times."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert cache_folder() == tmp_path / "home" / ".cache" / "dsvla_jax"
    notes = tmp_path / "home" / ".cache" / "dsvla_jax" / "first_use_seconds.json"
    for content in ("[1]", "{", '{"act (cpu)": "long"}'):
        notes.write_text(content)
        said = []
        with first_use("act", said.append):
            pass
        with first_use("act", said.append):
            pass
        assert said == ["compiling", "compiling or loading, 0 s last time"]
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


def test_programs_say_once_that_nothing_is_kept(tmp_path):
    program = (
        "from dsvla_jax.command_line import configure_jax; configure_jax(); import jax; print(jax.numpy.ones(3) + 1)"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": "/dev/null", "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "[2. 2. 2.]\n")
    assert done.stderr == "compiled programs are not kept for the next time: no cache folder can be written\n"


def test_sigterm_while_demonstrations_are_made_keeps_what_is_finished(tmp_path, capsys):
    """Status 75, as of a run that saved and stopped; the same call continues."""
    expert = FakeExpert()

    def terminated(task, settings):
        demonstrate = expert(task, settings)

        def attempt(start, count):
            if start == 4:
                signal.raise_signal(signal.SIGTERM)
            return demonstrate(start, count)

        return attempt

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    generate_demonstrations(whole, ["lamp_on"], 8, demonstrator=FakeExpert(), batch=4, progress=False)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        generate_demonstrations(parts, ["lamp_on"], 8, demonstrator=terminated, batch=4, progress=False)
    assert end.value.code == 75
    assert "SIGTERM: what was finished is kept, and the same command continues" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before
    assert expert.starts == [("lamp_on", 0)]
    rest = FakeExpert()
    generate_demonstrations(parts, ["lamp_on"], 8, demonstrator=rest, batch=4, progress=False)
    assert rest.starts == [("lamp_on", 4), ("lamp_on", 8)]
    assert contents(parts) == contents(whole)
