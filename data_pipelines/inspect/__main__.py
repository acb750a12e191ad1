"""Look at data before training on it: python -m data_pipelines.inspect PATH|DATASET [--page FILE.html]

PATH is a folder of demonstrations (generated, imported or one's own) or of an RLDS build, which may be a URL; DATASET
is a name of `python -m data_pipelines.oxe list` whose build is in --oxe.folder. Prints features, counts and statistics,
warns of what is mostly a mistake, and writes an HTML page with frames, clouds, actions and prompts.
"""

import dataclasses
import os
from pathlib import Path

import tyro

from data_pipelines.episodes import INDEX_FILE
from data_pipelines.inspect.episodes import describe_episodes
from data_pipelines.inspect.page import Page, print_page, write_page
from dsvla_jax.command_line import configure_jax, fail_with_message, parse_options
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.prompts import Style
from dsvla_jax.errors import DataError
from dsvla_jax.ranges import FINITE, at_least, check_fields


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command line."""

    path: tyro.conf.Positional[str]
    """A folder of demonstrations, an RLDS build, or the name of a dataset."""
    page: Path | None = None
    """The HTML file to write; PATH/inspect.html, or where that cannot be written inspect.html here, if not given."""
    tasks: tuple[str, ...] = ()
    """Names of tasks, of demonstrations; all that are there if not given."""
    episodes: int = 3
    """Episodes of each task, or of an RLDS build, to draw."""
    style: Style = "compact"
    """Of the prompts on the page."""
    workspace_low: tuple[float, float, float] = EncodingConfig.workspace_low
    """The lowest corner of the box that clouds are cut to, metres, as in the config to train with."""
    workspace_high: tuple[float, float, float] = EncodingConfig.workspace_high
    """The highest corner of that box."""
    oxe: OxeConfig = dataclasses.field(default_factory=lambda: OxeConfig(mixture=()))
    """Of RLDS builds, as in the config to train with. With a mixture, displacements are binned over that."""

    def __post_init__(self) -> None:
        check_fields(self, "", episodes=at_least(1), workspace_low=FINITE, workspace_high=FINITE)


def describe(options: Options) -> tuple[Page, str]:
    """The page of whatever is at the path, and the folder that it is about.

    Raises UserError where it is nothing that can be read.
    """
    encoding = EncodingConfig(
        workspace_low=options.workspace_low, workspace_high=options.workspace_high, style=options.style
    )
    path = Path(options.path)
    if (path / INDEX_FILE).exists():
        return describe_episodes(path, options.tasks or None, options.episodes, encoding), options.path
    fix = "generate, import or write demonstrations first (docs/data_own.md), or give an RLDS build (docs/data_oxe.md)"
    if any(found for depth in range(1, 4) for found in path.glob("*/" * depth + "episodes/episode0")):
        fix = f"import them first: python -m data_pipelines.rlbench {path} OUT, and look at OUT"
        raise DataError(path, "folder", f"demonstrations ({INDEX_FILE})", "RLBench's", fix)
    # Its feature definitions take a second to import, which demonstrations do not need.
    from data_pipelines.inspect.rlds import describe_build, find_dataset

    build, dataset = find_dataset(options.path, options.oxe, fix)
    return describe_build(build, dataset, options.oxe, options.episodes, encoding), build.folder


def main(options: Options) -> None:
    """Describes what is at the path."""
    page, folder = describe(options)
    print_page(page)
    file = options.page or Path(folder if os.access(folder, os.W_OK) else ".") / "inspect.html"
    write_page(file, page)
    print(f"page: {file}")


if __name__ == "__main__":
    with fail_with_message():
        parsed = parse_options(Options, prog="python -m data_pipelines.inspect", description=__doc__)
        configure_jax()
        main(parsed)
