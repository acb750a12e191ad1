"""An RLDS build as a page: features, shards, the standardised motion's statistics, and episodes as training sees them.

A build of the registry is read the way training reads it, so what is shown is what a policy would learn from.
"""

import re
from collections.abc import Sequence

import numpy as np
from tqdm import tqdm

from data_pipelines.first_look import dataset_views
from data_pipelines.inspect.drawing import draw_clouds, draw_frame
from data_pipelines.inspect.motions import COMPONENTS, draw_motion, motion_statistics
from data_pipelines.inspect.page import Page, Section, Table
from data_pipelines.inspect.stored import describe_stored, feature_table, shard_table
from data_pipelines.oxe.dataset import OxeDataset
from data_pipelines.oxe.index import HIGH, LOW, main_view
from data_pipelines.oxe.mixture import EncodedSample, OpenDataset, folder_of, open_mixture, shares_of
from data_pipelines.oxe.motion import Motion
from data_pipelines.oxe.registry import DATASETS, get_dataset
from data_pipelines.oxe.samples import prompts_and_answers, write_picture
from data_pipelines.oxe.scale import MixtureScale
from data_pipelines.oxe.targets import why_unsupported
from data_pipelines.records import Frame
from data_pipelines.rlds import files
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.workspace import require_points
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import displace
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.evaluation.pictures import MAX_STRIP_FRAMES, film_strip
from dsvla_jax.types import Action, Picture, RobotState, join_cameras

_VERSION = re.compile(r"\d+\.\d+\.\d+")
LOOKED_AT = 200
"""Episodes, evenly spaced, that statistics are taken of."""


def find_dataset(path: str, config: OxeConfig, fix: str) -> tuple[RldsBuild, OxeDataset | None]:
    """The build at a path, or of a registered name in `config.folder`, and what the registry knows of it.

    Raises UserError, with the fix, where neither is there.
    """
    if not files.exists(path):
        if "/" in path:
            raise DataError(path, "folder", "demonstrations or an RLDS build", "no such folder", fix)
        dataset = get_dataset(path)
        return RldsBuild(folder_of(dataset, config)), dataset
    if not files.exists(files.join(path, "features.json")):
        names = files.folders_in(path)
        if not any(_VERSION.fullmatch(name) for name in names):
            if datasets := [name for name in names if name in DATASETS]:
                fix = f"name one of them: python -m data_pipelines.inspect {datasets[0]} --oxe.folder {path}"
                raise DataError(path, "folder", "one dataset", f"{len(datasets)}, such as {datasets[0]}", fix)
            raise DataError(path, "folder", "demonstrations or an RLDS build", "neither", fix)
    build = RldsBuild(path)
    # A renamed folder says what its owner takes the build for: bridge_orig's builds call themselves bridge_dataset.
    names = [part for part in build.folder.split("/") if not _VERSION.fullmatch(part)]
    return build, DATASETS.get(names[-1], DATASETS.get(build.name))


def describe_build(
    build: RldsBuild, dataset: OxeDataset | None, config: OxeConfig, shown: int, encoding: EncodingConfig
) -> Page:
    """The page of a build. shown: how many episodes are drawn.

    config: as training takes it. A mixture without datasets stands for this one alone: it only says what displacements
    are binned over. Raises DataError at the first damaged record unless `config.skip_bad`.
    """
    tables = [feature_table(build), shard_table(build)]
    if dataset is None:
        fix = "what its values mean is not known; describe it in data_pipelines/oxe to train on it"
        return describe_stored(build, None, config, shown, tables, f"{build.name} is not in the registry: {fix}")
    tables.append(_known(dataset))
    if reason := why_unsupported(dataset, config):
        warning = f"{dataset.name} cannot be trained on with {config.target} targets: {reason}"
        return describe_stored(build, dataset, config, shown, tables, warning)
    opened, scale = _open(build, dataset, config)
    motions = _motions(opened)
    index = opened.index
    title = f"{build.folder}: {len(index.samples):,} usable episodes, {index.num_samples:,} samples"
    numbers = np.unique(np.linspace(0, len(index.samples) - 1, shown).astype(int)) if shown else []
    sections = [_section(opened, int(number), encoding, scale) for number in numbers]
    warnings = [f"left out: {where}: {why}" for where, why in index.left_out]
    tables += [_counts(opened, motions), motion_statistics(motions)]
    if scale is not None:
        tables.append(_targets(opened, scale))
    return Page(title, tables, warnings + _warnings(opened, motions, encoding), sections)


def _open(build: RldsBuild, dataset: OxeDataset, config: OxeConfig) -> tuple[OpenDataset, MixtureScale | None]:
    if not config.mixture:
        opened = [OpenDataset(build, dataset, config)]
        shares = np.ones(1)
    else:
        opened, weights = open_mixture(config)
        shares = shares_of(opened, weights)
    mine = next((one for one in opened if one.build.folder == build.folder), None)
    if mine is None:
        raise UserError(f"mixture: {build.folder} is none of {', '.join(one.build.folder for one in opened)}")
    return mine, MixtureScale(opened, shares) if config.target == "relative" else None


def _known(dataset: OxeDataset) -> Table:
    arms = f"{len(dataset.arms)} arm{'s' if len(dataset.arms) > 1 else ''}"
    units = "metres and radians" if dataset.metric else "units that are not known"
    rows = [
        ("published at", dataset.source),
        ("motion", f"{arms}, {dataset.hz:g} steps a second, {units}, displacements in the {dataset.frame}'s frame"),
        ("picture", dataset.images[main_view(dataset)] + (f", depth: {dataset.depth.key}" if dataset.depth else "")),
        ("instruction", dataset.language),
        *(("note", note) for note in dataset.notes),
    ]
    return Table(f"what the registry knows of {dataset.name}", ("", ""), rows, numbers=False)


def _motions(opened: OpenDataset) -> list[Motion]:
    """Of some evenly spaced usable episodes."""
    numbers = np.unique(np.linspace(0, len(opened.index.samples) - 1, LOOKED_AT).astype(int))
    bar = tqdm(numbers, unit="episode", desc="statistics", leave=False)
    return [opened.dataset.motion(opened.parse(int(number))) for number in bar]


def _counts(opened: OpenDataset, motions: Sequence[Motion]) -> Table:
    samples = opened.index.samples
    # Every step but an episode's last has a target.
    steps = samples + 1
    row = (
        f"{len(samples):,}",
        f"{len(opened.index.left_out):,}",
        f"{steps.sum():,}",
        f"{steps.min()}, {int(np.median(steps))}, {steps.max()}",
        f"{samples.sum():,}",
        f"{len({motion.instruction for motion in motions})}",
    )
    columns = ("usable episodes", "left out", "steps used", "least, median, most", "samples", "phrases")
    return Table(f"counts of split {opened.config.split} (phrases: of {len(motions)} episodes)", columns, [row])


def _targets(opened: OpenDataset, scale: MixtureScale) -> Table:
    """The dataset's own range of displacements, and the one that they are binned over."""
    low, high = np.asarray(opened.index.quantiles)[[LOW, HIGH]]
    rows = [
        (name, *(f"{value:.4f}" for value in values))
        for name, *values in zip(COMPONENTS, low, high, scale.scale.low, scale.scale.high, strict=True)
    ]
    ahead = f"{opened.config.horizon:g} s ahead" if opened.config.horizon else "at the next keyframe"
    columns = ("displacement", "1 %", "99 %", "binned from", "binned to")
    return Table(f"targets: displacements to the pose {ahead}, of all samples", columns, rows)


def _section(opened: OpenDataset, number: int, encoding: EncodingConfig, scale: MixtureScale | None) -> Section:
    """One episode."""
    episode = opened.parse(number)
    samples = opened.read(number)
    chosen = np.unique(np.linspace(0, len(samples) - 1, MAX_STRIP_FRAMES).round().astype(int)).tolist()
    frames = [_frame(samples[i], i, opened.config) for i in chosen]
    pictures = [frame.pictures.rgb[0] if samples[0].camera is None else draw_frame(frame) for frame in frames]
    caption = f"{len(chosen)} of {len(samples)} samples, cut and coloured as training may see them"
    if samples[0].camera is not None:
        caption += "; rings: where to go next"
    drawn = [(caption, film_strip(pictures)), ("the motion", draw_motion(opened.dataset.motion(episode)))]
    if samples[0].camera is not None:
        drawn += draw_clouds(frames[0])
    lines = []
    for prompt, answer, _ in prompts_and_answers([samples[i] for i in chosen], encoding, scale):
        lines += [prompt, f"    {answer}"]
    heading = f"{episode.where}: “{samples[0].instruction}”"
    return Section(heading, drawn, lines)


def _frame(sample: EncodedSample, number: int, config: OxeConfig) -> Frame:
    """A sample with its picture decoded and varied, in the shape that demonstrations have."""
    rgb = np.empty((config.image_size, config.image_size, 3), np.uint8)
    depth, camera = write_picture(sample, np.random.default_rng(number), config, sample.camera is not None, rgb)
    target = sample.target_pose
    if target is None:
        assert sample.displacement is not None
        target = displace(sample.pose, sample.displacement)
    return Frame(
        pictures=join_cameras([Picture(rgb, depth, camera)]),
        robot=RobotState(sample.pose, sample.gripper_open),
        keypoint=np.zeros((0, 3), np.float32),
        target=Action(target, sample.target_gripper),
        instruction=sample.instruction,
        task=sample.dataset,
        task_index=0,
        episode=0,
        frame=number,
    )


def _warnings(opened: OpenDataset, motions: Sequence[Motion], encoding: EncodingConfig) -> list[str]:
    """What is not refused, because it may be meant, but should be known."""
    found = []
    low, high = np.array(encoding.codec.low), np.array(encoding.codec.high)
    if all(motion.pose is not None for motion in motions):
        places = np.concatenate([motion.pose[..., :3].reshape(-1, 3) for motion in motions if motion.pose is not None])
        if share := float(np.mean(np.any((places < low) | (places > high), axis=1))):
            found.append(
                f"{100 * share:.1f} % of the poses are outside of the box of the action text, {low.tolist()} to "
                f"{high.tolist()}, and are told as on its surface"
            )
    else:
        found.append("poses are not told: prompts state the middle of the box instead")
    if not opened.dataset.metric:
        found.append("positions are in units that are not known: displacements are stretched to the mixture's range")
    if all((motion.gripper_command == motion.gripper_command[0]).all() for motion in motions):
        found.append("no gripper ever changes")
    if count := opened.index.unlabelled:
        left_out = opened.config.unlabelled == "leave_out"
        use = "left out" if left_out else "learned from with prompts that ask for nothing"
        found.append(f"{count:,} of {opened.num_episodes:,} episodes have no instruction: they are {use}")
    if still := [name for name in opened.index.constant if name != "gripper"]:
        found.append(f"{', '.join(still)} of the targets do not vary: every answer says the same of them")
    if opened.dataset.depth is not None:
        try:
            require_points(opened.dataset.name, dataset_views(opened), encoding)
        except UserError as error:
            found.append(f"3D input: {error}")
    return found
