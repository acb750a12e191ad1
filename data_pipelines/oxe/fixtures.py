"""Small RLDS builds of every dataset of the registry, with known motions, written as the dataset writes them.

    python -m data_pipelines.oxe fixtures FOLDER

Features have the names, shapes and dtypes of the published builds. What the registry must not read is noise. For tests,
and to try the whole path from pretraining to finetuning without a download.
"""

from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from data_pipelines.oxe import fixtures_converted, fixtures_other, fixtures_rtx
from data_pipelines.oxe.fixture_build import Fixture, episode_of, features_of
from data_pipelines.oxe.fixture_motion import KnownEpisode, known_episode
from data_pipelines.rlds.build import Format
from data_pipelines.rlds.writing import write_build

FIXTURES: dict[str, Fixture] = {
    **fixtures_rtx.FIXTURES,
    **fixtures_converted.FIXTURES,
    **fixtures_other.FIXTURES,
}


def known_episodes(name: str, episodes: int, steps: int) -> list[KnownEpisode]:
    """The motions of a dataset's fixture: episode i has `steps` + i % 3 steps."""
    fixture = FIXTURES[name]
    first = sum(name.encode()) * 100
    return [known_episode(fixture.kind, fixture.arms, steps + i % 3, first + i) for i in range(episodes)]


def write_fixture(
    folder: Path, name: str, episodes: int = 4, steps: int = 6, shards: int = 2, file_format: Format = "tfrecord"
) -> list[KnownEpisode]:
    """Writes ``folder/name/0.1.0`` and returns its motions."""
    known = known_episodes(name, episodes, steps)
    written = [episode_of(FIXTURES[name], episode) for episode in known]
    write_build(folder, name, features_of(FIXTURES[name]), {"train": written}, shards, file_format)
    return known


def write_fixtures(folder: Path, names: Sequence[str], episodes: int = 4, steps: int = 6) -> None:
    """One build a name; those that are there already are kept, whatever their version."""
    for name in tqdm(names, desc="fixtures", unit="build"):
        # What an interrupted writer left ends in .partial.
        if not any((folder / name).glob("*[0-9]/features.json")):
            write_fixture(folder, name, episodes, steps)
