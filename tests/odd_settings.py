"""Every field of every config with values that it is not meant for, found by looking at the dataclasses."""

import dataclasses
import math
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from data_pipelines.episodes import write_episodes
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.pretrained_tokenizers import save_tokenizer
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.experiment import Experiment, ValidationConfig
from dsvla_jax.model.config import LoraConfig, ModelConfig, RopeScaling, VisualPromptConfig
from dsvla_jax.policies.config import BehaviourCloningConfig, DP3Config
from tests.random_data import random_episode
from tests.small import small_encoding, small_language, small_vision

# Zero, negative, and huge: beyond what an array can have, and what no machine has the memory for.
WHOLE = (0, -1, 10**6, 10**12)
REAL = (0.0, -1.0, 1e30, 1e300, math.inf, math.nan)


@dataclasses.dataclass(frozen=True)
class OddSetting:
    """One field of an experiment with another value. name: as on the command line."""

    name: str
    value: Any

    def apply(self, experiment: Experiment) -> Experiment:
        """The experiment with the value. Raises what the configs raise."""
        return _replace(experiment, self.name.split("."), self.value)


def toy_experiment(folder: Path) -> Experiment:
    """An experiment of every part that runs two steps in seconds, and has every optional config. Writes its data."""
    episodes = [random_episode(seed, size=32) for seed in range(4)]
    write_episodes(folder / "data", episodes)
    tokenizer = WordTokenizer(vocabulary(episode.instruction for episode in episodes))
    save_tokenizer(tokenizer, folder / "words")
    language = dataclasses.replace(small_language(tokenizer.vocab_size), rope_scaling=RopeScaling())
    return Experiment(
        encoding=dataclasses.replace(small_encoding(), max_text_length=56),
        model=ModelConfig(
            vision=small_vision(),
            language=language,
            visual_prompt=VisualPromptConfig(width=32, layers=1, heads=2, ffn=32),
            lora=LoraConfig(rank=2),
        ),
        data=DataConfig(source="episodes", folder=str(folder / "data"), tasks=("all",), episodes=3),
        validation=ValidationConfig(episodes=1, batches=1),
        tokenizer=str(folder / "words"),
        steps=2,
        batch_size=2,
        log_every=1,
        validate_every=2,
    )


def baseline_experiments(toy: Experiment) -> list[Experiment]:
    """The toy experiment with each of the baselines, at sizes that run two steps in seconds."""
    small = DP3Config(point_channels=(16,), feature=16, language_layers=1, channels=(16, 32), inference_steps=2)
    return [
        dataclasses.replace(toy, baseline=BehaviourCloningConfig(hidden=16)),
        dataclasses.replace(toy, baseline=small, model=ModelConfig()),
    ]


def odd_settings(experiment: Experiment) -> Iterator[OddSetting]:
    """Every odd value of every field, that of nested configs too."""
    for name, hint, value in _leaves(experiment, ""):
        for odd in _odd_values(hint, value):
            yield OddSetting(name, odd)


def _leaves(config: Any, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _leaves(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", hints[field.name], value


def _odd_values(hint: Any, value: Any) -> list[Any]:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return [choice for choice in arguments if choice != value] + ["", "no such choice"]
    if origin in (typing.Union, types.UnionType):
        return [odd for kind in arguments for odd in _odd_values(kind, value)]
    if origin is tuple:
        inner = _odd_values(arguments[0], value[0] if value else "q")
        return [(), *((odd, *value[1:]) for odd in inner), *([tuple(reversed(value))] if len(value) > 1 else [])]
    if hint is int:
        return [*WHOLE, *([value + 1] if value is not None and value + 1 not in WHOLE else [])]
    if hint is float:
        return list(REAL)
    if hint is bool:
        return [not value]
    if hint is str:
        return ["", " ", "no such name"]
    return []


def _replace(config: Any, path: list[str], value: Any) -> Any:
    name, *rest = path
    inner = _replace(getattr(config, name), rest, value) if rest else value
    return dataclasses.replace(config, **{name: inner})
