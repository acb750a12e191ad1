"""Where a run's demonstrations come from, by ``DataConfig.source``."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from data_pipelines.demos import generate_demonstrations
from data_pipelines.episodes import EpisodeReader
from data_pipelines.records import picture_size
from data_pipelines.samples import require_texts_fit
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.pose_inputs import encode_instruction
from dsvla_jax.encoding.text import Tokenizer, check_words, unknown_words
from dsvla_jax.errors import UserError
from dsvla_jax.sim.cameras import check_cameras
from dsvla_jax.sim.tasks import TASKS, Task, select_tasks


def choose_tasks(data: DataConfig) -> tuple[str, ...]:
    """The names of the tasks that a run learns, groups spelled out, none twice."""
    names = tuple(dict.fromkeys(name for words in data.tasks for name in words.split(",") if name))
    if data.source == "simulator":
        return select_tasks(names)
    return EpisodeReader(Path(data.folder), tasks=None if "all" in names else names).tasks


def open_demonstrations(data: DataConfig, tokenizer: Tokenizer) -> EpisodeReader:
    """The demonstrations of ``data.tasks``; those of the simulator are made first where they are missing.

    Raises UserError where an instruction has words that a word-level tokenizer does not know.
    """
    folder, tasks = Path(data.folder), choose_tasks(data)
    if data.source == "simulator":
        _simulate(data, folder, tasks, data.episodes, "train")
        return EpisodeReader(folder, tasks=tasks, episodes=data.episodes, cameras=data.cameras)
    reader = _open_folder(data, tokenizer)
    if (present := len(EpisodeReader(folder, tasks=tasks))) > len(reader):
        print(f"{folder}: {len(reader)} of {present} demonstrations are used (data.episodes is {data.episodes} a task)")
    return reader


def _open_folder(data: DataConfig, tokenizer: Tokenizer) -> EpisodeReader:
    folder = Path(data.folder)
    tasks = choose_tasks(data)
    reader = EpisodeReader(folder, tasks=tasks, episodes=data.episodes, fewer=True, cameras=data.cameras)
    check_words(folder, reader.instructions, tokenizer, f"python -m data_pipelines.vocabulary {folder} OUT")
    return reader


def open_held_out(data: DataConfig, tokenizer: Tokenizer, episodes: int) -> EpisodeReader:
    """Demonstrations of ``data.tasks`` that `open_demonstrations` does not give: whole episodes, `episodes` a task.

    Those of the simulator start from other seeds, and are made first where they are missing, in a folder beside that of
    training; of a folder's they are what follows the first ``data.episodes`` of each task.
    Raises UserError where there are none of a task.
    """
    tasks = choose_tasks(data)
    if data.source == "simulator":
        folder = Path(f"{data.folder}_validation")
        _simulate(data, folder, tasks, episodes, "validation")
        return EpisodeReader(folder, tasks=tasks, episodes=episodes, cameras=data.cameras)
    folder = Path(data.folder)
    if used := [task for task in tasks if len(EpisodeReader(folder, tasks=(task,))) <= data.episodes]:
        raise UserError(
            f"{folder}: training uses all demonstrations of {', '.join(used)}, so none are left to validate with; use "
            "fewer of each task (--data.episodes), or turn validation off (--validate-every 0)"
        )
    reader = EpisodeReader(folder, tasks=tasks, episodes=episodes, skip=data.episodes, fewer=True, cameras=data.cameras)
    check_words(folder, reader.instructions, tokenizer, f"python -m data_pipelines.vocabulary {folder} OUT")
    return reader


def require_data_fits(
    data: DataConfig,
    encoding: EncodingConfig,
    tokenizer: Tokenizer,
    held_out: int = 0,
    instructions_only: bool = False,
) -> tuple[int, int]:
    """Height and width of the pictures of ``data``. Raises UserError where they, or the texts, do not fit the encoding.

    Demonstrations of the simulator are judged by what they will be: nothing is made. held_out: as `open_held_out`'s
    ``episodes``, 0 for none. instructions_only: for policies that read and write no numbers as text.
    """
    if data.source == "simulator":
        picture, name = (data.image_size, data.image_size), "data.image_size"
        tasks = [TASKS[task] for task in choose_tasks(data)]
        for task in tasks:
            check_cameras(data.cameras, task.num_arms)
        require_tasks_fit(tasks, encoding, tokenizer, instructions_only)
    else:
        reader, name = _open_folder(data, tokenizer), data.folder
        if held_out:
            open_held_out(data, tokenizer, held_out)
        picture = picture_size(reader.episode(0).rgb_png[0])
        texts = [(text, min(reader.num_arms.values())) for text in reader.instructions]
        _require_texts_fit(texts, encoding, tokenizer, instructions_only)
    encoding.require_points(*picture, len(data.cameras), f"a picture of {name}")
    return picture


def require_tasks_fit(
    tasks: Iterable[Task],
    encoding: EncodingConfig,
    tokenizer: Tokenizer,
    instructions_only: bool = False,
    or_else: str = "",
) -> None:
    """Raises UserError where an instruction of a simulated task has unknown words, or is too long.

    instructions_only: as in `require_data_fits`. or_else: the end of the message, another fix.
    """
    texts = [(text, task.num_arms) for task in tasks for text in task.all_instructions()]
    if unknown := unknown_words([text for text, _ in texts], tokenizer):
        raise UserError(
            f"tokenizer: it lacks {len(unknown)} words of the tasks' instructions ({', '.join(unknown[:5])}), which "
            f"the simulator gives; leave it empty for the words of the task suite{or_else}"
        )
    _require_texts_fit(texts, encoding, tokenizer, instructions_only)


def _require_texts_fit(
    texts: Iterable[tuple[str, int]], encoding: EncodingConfig, tokenizer: Tokenizer, instructions_only: bool
) -> None:
    if instructions_only:
        for text, _ in texts:
            encode_instruction(tokenizer, text, encoding.max_text_length)
    else:
        require_texts_fit(encoding, tokenizer, texts)


def require_oxe_fits(oxe: OxeConfig, encoding: EncodingConfig, tokenizer: Tokenizer) -> tuple[int, int]:
    """As `require_data_fits`, of Open X-Embodiment: with the shortest text, since instructions are not read yet."""
    picture = (oxe.image_size, oxe.image_size)
    encoding.require_points(*picture, 1, "a picture of oxe.image_size")
    require_texts_fit(encoding, tokenizer, [("", 1)])
    return picture


def _simulate(
    data: DataConfig, folder: Path, tasks: tuple[str, ...], episodes: int, split: Literal["train", "validation"]
) -> None:
    generate_demonstrations(
        folder,
        tasks,
        episodes,
        workers=os.cpu_count() or 1,
        split=split,
        image_size=data.image_size,
        cameras=data.cameras,
        seed=data.seed,
        perturb=data.perturb,
        keypoints=data.keypoints,
    )
