"""The two programs as a person runs them: mistakes end in one clear message, a non-zero status and no traceback."""

import os
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from configs import get_config
from data_pipelines.rlbench.__main__ import Settings, import_demonstrations
from dsvla_jax.experiment import save_experiment
from tests.rlbench_files import write_dataset

ROOT = Path(__file__).parent.parent


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "JAX_PLATFORMS": "cpu"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["train.py", "tinny"], "unknown config 'tinny': did you mean 'tiny'?"),
        (["eval.py", "nowhere"], "no run here"),
        (["-m", "data_pipelines.demos", "out", "--tasks", "lamp_of"], "lamp_on"),
    ],
)
def test_a_program_ends_with_one_message(arguments: list[str], expected: str, tmp_path: Path):
    if arguments[0].endswith(".py"):
        arguments = [str(ROOT / arguments[0]), *arguments[1:]]
    result = run(*arguments, folder=tmp_path)
    text = result.stdout + result.stderr
    assert result.returncode not in (0, None)
    assert "Traceback" not in text
    assert expected in text
    assert not any(tmp_path.rglob("*.json")), "nothing is written for a mistake"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["train.py", "mine/tiny_lor.py"],
            "'mine/tiny_lor.py': no such file; did you mean 'tiny_lora'?",
        ),
        (["train.py", "tiny", "--optimizer.learning-rat", "1"], "learning-rate"),
        (["train.py", "tiny", "--steps", "many"], "many"),
        (["train.py", "tiny", "--data.tasks", "lamp_of"], "lamp_on"),
        (["train.py", "tiny", "--data.crop", "1.5"], "error: data.crop: expected more than 0, at most 1, got 1.5"),
        (["train.py", "tiny_oxe", "--oxe.horizon", "-1"], "oxe.horizon: expected at least 0, at most 3600, got -1.0"),
        (["eval.py", "nowhere", "--compare", "elsewhere"], "no results under these conditions; evaluate first"),
        (["train.py", "tiny", "--run", "runs/lr=[0.1]"], "whose path contains [; choose another folder"),
        (["train.py", "tiny", "--run", "/dev/null/run"], "error: /dev/null/run: Not a directory; choose another path"),
        (["data_pipelines.oxe", "fixtures", "/dev/null", "--datasets", "viola"], "error: /dev/null/viola"),
    ],
)
def test_a_mistake_ends_in_one_message(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """In the process of the tests, which has imported already what a program would."""
    program, *rest = arguments
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", [program, *rest])
    is_file = program.endswith(".py")
    start = partial(runpy.run_path, str(ROOT / program)) if is_file else partial(runpy.run_module, program)
    with pytest.raises(SystemExit) as ended:
        start(run_name="__main__")
    assert ended.value.code not in (0, None)
    printed = capsys.readouterr()
    assert expected in printed.out + printed.err
    assert not any(tmp_path.rglob("*.json")), "nothing is written for a mistake"


def test_a_run_of_another_config_is_not_overwritten(tmp_path: Path):
    folder = tmp_path / "runs" / "tiny"
    folder.mkdir(parents=True)
    save_experiment(folder / "config.json", replace(get_config("tiny"), batch_size=7, log_every=3))
    (folder / "checkpoints" / "2").mkdir(parents=True)
    before = (folder / "config.json").read_text()
    result = run(str(ROOT / "train.py"), "tiny", "--data.crop", "0.8", folder=tmp_path)
    assert result.returncode == 1
    assert "started with another config (another batch_size, data.crop)" in result.stderr
    assert "Traceback" not in result.stderr
    assert (folder / "config.json").read_text() == before


def test_words_that_a_vocabulary_lacks_end_in_one_message(tmp_path: Path):
    source = write_dataset(tmp_path / "source", ["rinse_mug"], 1, size=8, frames=8, descriptions=["rinse the mug"])
    import_demonstrations(source, tmp_path / "mine", Settings(), progress=False)
    data = ["--data.source", "episodes", "--data.folder", "mine", "--data.tasks", "all"]
    result = run(str(ROOT / "train.py"), "tiny", "--run", "run", *data, folder=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("error: mine: the vocabulary has no token for 'mug', 'rinse'")
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_damage_ends_in_one_message_and_loses_nothing(tmp_path: Path):
    """A truncated demonstration file and the checkpoint of another model size, as train.py and eval.py meet them."""
    small = ["tiny", "--steps", "2", "--data.tasks", "lamp_on", "--data.episodes", "4", "--batch-size", "4"]

    def train(name: str, *more: str) -> subprocess.CompletedProcess[str]:
        return run(str(ROOT / "train.py"), *small, "--run", name, *more, folder=tmp_path)

    for name, layers in (("one", "3"), ("other", "2")):
        result = train(name, "--model.language.layers", layers)
        assert result.returncode == 0, result.stderr
    shutil.rmtree(tmp_path / "other" / "checkpoints")
    shutil.copytree(tmp_path / "one" / "checkpoints", tmp_path / "other" / "checkpoints")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for program, arguments in (("eval.py", ["other"]), ("train.py", [])):
        result = (
            run(str(ROOT / program), *arguments, folder=tmp_path)
            if arguments
            else train("other", "--model.language.layers", "2", "--steps", "3")
        )
        assert result.returncode == 1
        assert "Traceback" not in result.stderr
        assert "other" in result.stderr

    (shard,) = (tmp_path / "data" / "demos").glob("*.array_record")
    shard.write_bytes(shard.read_bytes()[:1000])
    before[shard] = shard.read_bytes()
    result = train("third")
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert shard.name in result.stderr
    assert "truncated" in result.stderr
    assert {path: path.read_bytes() for path in before} == before
