"""Look for the keypoints of recorded episodes: python -m data_pipelines.find_keypoints DEMOS OUT [--draw FOLDER]

Writes a copy of the episodes whose keypoints are those of the objects that the instruction names, found by Grounding
DINO and SAM in the first picture, as in the paper. Needs the extra `perception`. An episode of which some object is not
found is left out, and said so.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from data_pipelines.episodes import INDEX_FILE, EpisodeReader, write_episodes
from data_pipelines.records import Episode, decode_depth, decode_rgb
from dsvla_jax.command_line import fail_with_message, parse_options
from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.errors import UserError
from dsvla_jax.files import hold_folder, write_picture
from dsvla_jax.perception.grounding import GroundingOptions
from dsvla_jax.perception.keypoints import KeypointsNotFound, Segmenter, Sighting, draw_sightings, find_keypoints
from dsvla_jax.perception.phrases import ObjectPhrases, phrases_for
from dsvla_jax.perception.simulator import suite_phrases
from dsvla_jax.types import Camera


@dataclasses.dataclass(frozen=True)
class Options:
    """Which episodes, and where to."""

    demos: tyro.conf.Positional[Path]
    """A folder of recorded episodes."""
    out: tyro.conf.Positional[Path]
    """A new folder for the same episodes with the keypoints that were found."""
    draw: Path | None = None
    """Writes a picture of what was found in each episode into this folder."""
    grounding: tyro.conf.OmitArgPrefixes[GroundingOptions] = dataclasses.field(default_factory=GroundingOptions)


def find(episode: Episode, segment: Segmenter, table: Sequence[ObjectPhrases]) -> tuple[Episode, list[Sighting]]:
    """The episode with the keypoints seen in its first picture, and the active ones of each frame; what was seen.

    Of several cameras, the first one's picture is looked at. Raises KeypointsNotFound, and UserError where no phrases
    are known for the instruction.
    """
    arms = phrases_for(episode.instruction, table)
    if len(arms) not in (1, episode.num_arms):
        raise UserError(f"{episode.instruction!r}: its objects are for {len(arms)} arms, not {episode.num_arms}")
    arms = arms * (episode.num_arms // len(arms))
    camera = Camera(episode.intrinsics[0, 0], episode.world_from_camera[0, 0])  # type: ignore[arg-type]
    rgb, depth = decode_rgb(episode.rgb_png[0]), decode_depth(episode.depth_png[0])
    keypoints, sightings = find_keypoints(segment, rgb, depth, camera, arms)
    return dataclasses.replace(
        episode, keypoints=keypoints, active_keypoint=_active(episode.pose, keypoints)
    ), sightings


def _active(poses: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """float32 (F, A, 3): the active keypoint of each arm at each frame, of poses (F, A, 7) and keypoints (A, K, 3)."""
    latched, active = np.zeros(len(keypoints), np.int32), []
    for pose in poses:
        latched = np.asarray(advance_latch(latched, pose[:, :3], keypoints))
        active.append([np.asarray(active_keypoint(n, row)) for n, row in zip(latched, keypoints, strict=True)])
    return np.array(active, np.float32)


def main(options: Options) -> None:
    """Writes the demonstrations again with the keypoints that are found, and prints how many."""
    reader, table = EpisodeReader(options.demos), (*options.grounding.table(), *suite_phrases())
    settings = {
        "importer": "find_keypoints",
        "detector": options.grounding.detector,
        "mask_model": options.grounding.mask_model,
        "box_threshold": options.grounding.box_threshold,
        "from": reader.settings,
    }
    problems: list[str] = []

    def found(segment: Segmenter) -> Iterator[Episode]:
        for number in tqdm(range(len(reader)), unit="episode"):
            original = reader.episode(number)
            name = f"{original.task}-{original.seed}"
            try:
                episode, sightings = find(original, segment, table)
                yield episode
            except KeypointsNotFound as error:
                sightings = list(error.sightings)
                problems.append(f"{name}: {error}")
            if options.draw:
                options.draw.mkdir(parents=True, exist_ok=True)
                picture = draw_sightings(decode_rgb(original.rgb_png[0]), sightings)
                write_picture(options.draw / f"{name}.png", picture)

    with hold_folder(options.out, "writes demonstrations there"):
        if (options.out / INDEX_FILE).exists():
            raise UserError(f"{options.out}: holds demonstrations already; choose another folder")
        write_episodes(options.out, found(options.grounding.segmenter()), settings=settings)
    print("\n".join([*problems, f"{len(reader) - len(problems)} of {len(reader)} episodes written to {options.out}"]))


if __name__ == "__main__":
    with fail_with_message():
        main(parse_options(Options, prog="python -m data_pipelines.find_keypoints", description=__doc__))
