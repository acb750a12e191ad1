"""`train.py tiny` from its demonstrations to its success, in this process."""

import dataclasses
import json
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

import eval as evaluation
import train
from benchmarks._accelerator.sections import Job, Size
from configs import get_config
from dsvla_jax.data_config import DataConfig
from dsvla_jax.evaluation.results import macro_mean, read_results, success_rates
from dsvla_jax.experiment import Experiment, load_experiment

# The smallest options that have every part.
_TOY_DATA: dict[str, Any] = {"tasks": ("lamp_on",), "episodes": 2, "image_size": 32}
_TOY = """
    --steps 4 --log-every 1 --batch-size 2 --data.tasks lamp_on --data.episodes 2 --data.image-size 32
    --encoding.image-size 32 --encoding.patch-size 16 --encoding.points.num-points 64
    --encoding.points.group-sizes 16 4 --encoding.points.neighbours 4 --encoding.points.width 32
    --model.vision.image-size 32 --model.vision.patch-size 16 --model.vision.width 32 --model.vision.layers 1
    --model.vision.heads 2 --model.language.width 32 --model.language.layers 1 --model.language.heads 2
    --model.language.kv-heads 2 --model.language.ffn 64 --model.scan-unroll 1 --evaluation.episodes 2
"""


def demonstrations(folder: Path, size: Size) -> DataConfig:
    """What `tiny` learns from."""
    plain = dataclasses.replace(get_config("tiny").data, folder=str(folder / "demos"))
    return dataclasses.replace(plain, **_TOY_DATA) if size == "toy" else plain


def tiny_run(folder: Path) -> Path:
    """The run that `tiny` trains."""
    return folder / "runs" / "tiny"


def options(folder: Path, size: Size) -> list[str]:
    """What train.py is called with."""
    more = _TOY.split() if size == "toy" else []
    data = demonstrations(folder, size)
    return ["tiny", "--run", str(tiny_run(folder)), "--data.folder", data.folder, *more]


def tiny(job: Job) -> None:
    """Steps a second of the whole program, and success on unseen episodes afterwards, as `make train` has it."""
    job.prepared("demonstrations")
    run = tiny_run(job.folder)
    shutil.rmtree(run, ignore_errors=True)
    start = time.perf_counter()
    try:
        train.command_line(options(job.folder, job.sizes.name))
    except SystemExit as ended:
        if ended.code:
            raise RuntimeError(f"train.py ended with status {ended.code}") from ended
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    steps = [line["seconds_per_step"] for line in lines if "seconds_per_step" in line]
    last = lines[-1]
    job.note(
        train_seconds=time.perf_counter() - start,
        steps=last["step"],
        steps_per_second=1 / statistics.median(steps),
        fastest_step=min(steps),
        slowest_step=max(steps),
        data_wait_share=statistics.median(line["data_wait_share"] for line in lines if "data_wait_share" in line),
        loss=last["loss"],
        bins_within_one=last["bin_within_one"],
    )
    experiment: Experiment = load_experiment(run / "config.json")
    start = time.perf_counter()
    evaluation.main(evaluation.Options(run=run))
    rates = success_rates(read_results(run / "eval"))
    job.note(
        success=macro_mean(rates),
        **{f"success_{rate.name}": rate.rate for rate in rates},
        episodes=experiment.evaluation.episodes,
        evaluation_seconds=time.perf_counter() - start,
    )
