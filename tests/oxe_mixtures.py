"""Fixture datasets of Open X-Embodiment, loaders of their mixtures, and what is true of a sample."""

from data_pipelines.oxe.fixtures.write import known_episodes, write_fixture
from data_pipelines.oxe.loader import OxeLoader
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.prompts import parse_answer
from dsvla_jax.suite_vocabulary import suite_tokenizer

FIVE = ("nyu_rot_dataset_converted_externally_to_rlds=3", "austin_sirius_dataset_converted_externally_to_rlds",
        "cmu_play_fusion=0.5", "utokyo_pr2_opening_fridge_converted_externally_to_rlds=2",
        "cmu_stretch=1.5")  # fmt: skip
MANISKILL = "maniskill_dataset_converted_externally_to_rlds"
ENCODING = EncodingConfig(image_size=32, patch_size=16, style="compact", max_text_length=64, use_points=False)


def names_of(mixture):
    return [entry.partition("=")[0] for entry in mixture]


def write_datasets(folder):
    """The five, and four more, of 9 episodes with known motions each."""
    for name in (
        *names_of(FIVE),
        MANISKILL,
        "roboturk",
        "berkeley_cable_routing",
        "utokyo_xarm_bimanual_converted_externally_to_rlds",
    ):
        write_fixture(folder, name, episodes=9, steps=9)
    return folder


def config_for(folder, mixture=FIVE, **options):
    return OxeConfig(
        **{"folder": str(folder), "mixture": mixture, "image_size": 32, "streams": 3, "window": 6, **options}
    )


def make(folder, mixture=FIVE, *, batch_size=4, encoding=ENCODING, seed=0, split=(0, 1), threads=2, **options):
    return OxeLoader(
        config_for(folder, mixture, **options),
        encoding,
        suite_tokenizer(),
        batch_size=batch_size,
        seed=seed,
        process_index=split[0],
        process_count=split[1],
        num_threads=threads,
        progress=False,
    )


def scale_of(loader):
    assert loader.scale is not None
    return loader.scale


def truth_of(name, where):
    """The known arms and step of a sample, by the place that it names."""
    record, _, step = where.partition(", step ")
    shard = int(record.rpartition("-of-")[0][-5:])
    number = int(record.rpartition(" ")[2]) + (0 if shard == 0 else 5)
    known = known_episodes(name, 9, 9)[number]
    return known, int(step.partition(",")[0])


def answer_of(batch, row, arms):
    tokens = batch.text.tokens[row][batch.answer_mask[row]][:-1]
    return parse_answer(suite_tokenizer().decode([int(token) for token in tokens]), arms, "compact")
