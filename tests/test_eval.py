"""eval.py: what it keeps of earlier results, what it skips, and what it refuses before an episode is run."""

import dataclasses
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
import pytest

import eval as program
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.command_line import require_each_option_once
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.conditions import Conditions
from dsvla_jax.evaluation.demo import Options as DemoOptions
from dsvla_jax.evaluation.demo import main as demo
from dsvla_jax.evaluation.results import EpisodeResult, read_results, write_results
from dsvla_jax.experiment import Experiment, save_experiment
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.config import BehaviourCloningConfig, PolicyConfig
from dsvla_jax.policy import save_policy_config
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.suite_vocabulary import suite_tokenizer
from tests.run_folders import NO_NOTES, variables_only
from tests.small import small_encoding, small_language, small_vision
from train import advice

TOKENIZER = suite_tokenizer()
EXPERIMENT = Experiment(
    encoding=small_encoding(max_text_length=64),
    model=ModelConfig(small_vision(), small_language(TOKENIZER.vocab_size)),
    data=DataConfig(tasks=("lamp_on",), image_size=32, keypoints="oracle"),
)
OLD = [
    EpisodeResult(task, i, True, "", 2, "go", ["1"], Conditions()) for task in ("lamp_on", "close_box") for i in (0, 1)
]


INITIALIZE = jax.jit(lambda: initialize(EXPERIMENT.model, jax.random.key(0)))


def save(run: Path, *steps: int) -> None:
    with closing(RunCheckpoints(run)) as checkpoints:
        for step in steps:
            checkpoints.save(step, variables_only(INITIALIZE()), NO_NOTES)


def write_run(run: Path, experiment: Experiment = EXPERIMENT) -> Path:
    """A run without checkpoints."""
    run.mkdir(parents=True)
    save_experiment(run / "config.json", experiment)
    save_policy_config(run, PolicyConfig(experiment.encoding, experiment.model), TOKENIZER)
    return run


def evaluate(run: Path, **options: Any) -> list[EpisodeResult]:
    program.main(program.Options(run, batch=1, **options))
    return read_results(run / "eval")


def counts(results: list[EpisodeResult]) -> dict[tuple[str, Any], int]:
    """Episodes by task and step of the checkpoint."""
    keys = [(result.task, result.conditions.step) for result in results]
    return {key: keys.count(key) for key in keys}


def test_an_evaluation_destroys_no_results(tmp_path: Path, capsys):
    run = write_run(tmp_path / "run")
    save(run, 1)
    file = run / "eval" / "results.jsonl"
    write_results(run / "eval", OLD)
    results = evaluate(run, tasks=("lamp_on",), episodes=2)
    assert results[:4] == OLD
    assert counts(results[4:]) == {("lamp_on", 1): 2}
    conditions = results[4].conditions
    assert conditions.digest
    assert conditions == Conditions(1, conditions.digest, "mujoco", "host", "oracle", 0.0, (), 0, "greedy", 32)
    assert (run / "eval" / "strips" / conditions.name / "lamp_on-1.png").exists()
    assert "step 1" in (run / "eval" / "report.html").read_text()

    # File times say nothing: the results are older than what follows, and of this checkpoint.
    (run / "metrics.jsonl").write_text("")
    before = file.read_bytes()
    capsys.readouterr()
    evaluate(run, episodes=2, skip_finished=True)
    assert "holds 2 episodes of each task at step 1: nothing to do" in capsys.readouterr().out
    assert file.read_bytes() == before

    save(run, 2)
    results = evaluate(run, episodes=1, skip_finished=True)
    assert counts(results) == {("lamp_on", None): 2, ("close_box", None): 2, ("lamp_on", 1): 2, ("lamp_on", 2): 1}


def test_a_checkpoint_of_the_same_step_and_other_weights_is_another(tmp_path: Path):
    save(tmp_path / "one", 1)
    save(tmp_path / "other", 1)
    shutil.copytree(tmp_path / "one", tmp_path / "copy")
    identities = []
    for name in ("one", "copy", "other"):
        with closing(RunCheckpoints(tmp_path / name, read_only=True)) as checkpoints:
            identities.append(checkpoints.identify())
            with pytest.raises(CheckpointError, match="no checkpoint was scored"):
                checkpoints.identify("best")
    assert identities[0] == identities[1] != identities[2]
    assert [step for step, _ in identities] == [1, 1, 1]


def test_what_is_evaluated_in_the_place_of_a_damaged_step_is_in_the_results(tmp_path: Path):
    save(tmp_path, 1, 2)
    with closing(RunCheckpoints(tmp_path, read_only=True)) as checkpoints:
        older, newer = checkpoints.identify(1), checkpoints.identify()
    assert (older[0], newer[0]) == (1, 2)
    files = [path for path in (tmp_path / "checkpoints" / "2" / "trainable").rglob("*") if path.is_file()]
    largest = max(files, key=lambda path: path.stat().st_size)
    largest.write_bytes(b"")
    with closing(RunCheckpoints(tmp_path, read_only=True)) as checkpoints:
        assert checkpoints.identify() == older


def test_a_folder_that_cannot_be_written_to_is_refused_before_an_episode_is_run(tmp_path: Path, capsys):
    run = write_run(tmp_path / "run")
    save(run, 1)
    (run / "eval").write_text("a file")
    with pytest.raises(UserError, match=r"eval: cannot write here .*; choose another place with --out"):
        program.main(program.Options(run, episodes=1))
    assert "keyframe" not in capsys.readouterr().err


def test_runs_are_compared_under_the_keypoints_that_they_learned_with(tmp_path: Path, capsys):
    run = write_run(tmp_path / "run")
    plain, found = Conditions(keypoints="oracle"), Conditions(keypoints="segmentation")
    results = [dataclasses.replace(OLD[0], conditions=one, success=one == plain) for one in (plain, found)]
    write_results(run / "eval", results)
    program.main(program.Options(run, compare=(run,)))
    assert "100.0" in capsys.readouterr().out
    program.main(program.Options(run, compare=(run,), keypoints="segmentation"))
    assert "100.0" not in capsys.readouterr().out


def test_results_written_elsewhere_are_compared(tmp_path: Path, capsys):
    write_results(tmp_path / "elsewhere", OLD[:1])
    write_results(tmp_path / "other" / "eval", OLD[2:3])
    program.main(program.Options(tmp_path / "run", out=tmp_path / "elsewhere", compare=(tmp_path / "other",)))
    printed = capsys.readouterr().out
    assert "lamp_on" in printed
    assert "close_box" in printed
    with pytest.raises(UserError, match="run/eval: no results under these conditions; evaluate first"):
        program.main(program.Options(tmp_path / "run", compare=(tmp_path / "other",)))
    with pytest.raises(UserError, match=r"python eval.py \S+run --keypoint-noise 0\.1 --shift camera position$"):
        program.main(
            program.Options(
                tmp_path / "run", keypoint_noise=0.1, shift=("camera", "position"), compare=(tmp_path / "other",)
            )
        )


def test_choices_between_integers_are_refused_for_policies_without_any(tmp_path: Path):
    experiment = dataclasses.replace(EXPERIMENT, baseline=BehaviourCloningConfig())
    run = write_run(tmp_path / "run", experiment)
    with pytest.raises(UserError, match="--choice: behaviour_cloning answers with poses, not with integers"):
        program.main(program.Options(run, choice="expected"))


def test_a_damaged_line_is_named_and_costs_no_other(tmp_path: Path):
    write_results(tmp_path, OLD[:2])
    file = tmp_path / "results.jsonl"
    file.write_text(file.read_text()[:-40])
    with pytest.raises(UserError, match=r"line 2: not an episode result .*; delete that line, and evaluate its task"):
        read_results(tmp_path)


@pytest.mark.parametrize("main", [lambda run: program.main(program.Options(run)), lambda run: demo(DemoOptions(run))])
def test_a_run_of_open_x_embodiment_does_not_act_in_the_simulator(tmp_path: Path, main):
    experiment = dataclasses.replace(EXPERIMENT, oxe=OxeConfig(folder="data", mixture=("viola",)))
    run = write_run(tmp_path / "run", experiment)
    with pytest.raises(UserError, match=r"poses in each robot's own frame.*finetune it on simulated tasks first"):
        main(run)
    assert advice(experiment).startswith("finetune it in simulation with: python train.py CONFIG --base")
    assert advice(EXPERIMENT).startswith("evaluate it with")
    assert not (run / "eval").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"episodes": 0}, "episodes: expected at least 1, got 0"),
        ({"episodes": -3}, "episodes: expected at least 1, got -3"),
        ({"batch": 0}, "batch: expected at least 1, got 0"),
        ({"batch": -3}, "batch: expected at least 1, got -3"),
        ({"keypoint_noise": -1.0}, "keypoint_noise: expected at least 0, got -1.0"),
        ({"keypoint_noise": float("nan")}, "keypoint_noise: .* got nan"),
        ({"keypoint_noise": float("inf")}, "keypoint_noise: .* got inf"),
        ({"seed": -1}, "seed: expected at least 0, got -1"),
        ({"loop": "device"}, "loop: expected 'host' with physics 'mujoco', got 'device'; add --physics mjx"),
        (
            {"loop": "device", "physics": "mjx", "keypoints": "segmentation-refresh"},
            "loop: .* found before every keyframe",
        ),
        ({"seed": 2**40}, "seed: expected at most 2147483647"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], expected: str):
    with pytest.raises(UserError, match=expected):
        program.Options(Path("run"), **options)


def test_the_demo_wants_one_task_and_an_episode_that_exists(tmp_path: Path):
    with pytest.raises(UserError, match="seed: expected at least 0"):
        DemoOptions(tmp_path, seed=-1)
    run = write_run(tmp_path / "run")
    for task in ("lamp_on,close_box", "all"):
        with pytest.raises(UserError, match="--task: expected one task"):
            demo(DemoOptions(run, task=task))
    with pytest.raises(UserError, match="tasks: expected at least one name"):
        demo(DemoOptions(run, task=","))


def test_names_of_tasks_that_name_none_are_refused():
    for names in ((",",), ("",), ()):
        with pytest.raises(UserError, match="tasks: expected at least one name"):
            select_tasks(names)
    assert select_tasks(("lamp_on,lamp_on", "lamp_on")) == ("lamp_on",)


def test_an_option_given_twice_is_refused_instead_of_dropped():
    require_each_option_once(["run", "--tasks", "lamp_on", "--episodes", "2"])
    for again in (["--tasks", "close_box"], ["--tasks=close_box"]):
        with pytest.raises(UserError, match="--tasks is given 2 times; give it once, with all its values after it"):
            require_each_option_once(["run", "--tasks", "lamp_on", *again])
    with pytest.raises(UserError, match="--keypoint-noise is given 2 times"):
        require_each_option_once(["run", "--keypoint_noise", "1", "--keypoint-noise", "2"])
