"""Look at data before training on it: python -m data_pipelines.inspect PATH [--page FILE.html]

PATH is a folder of demonstrations: generated, imported or one's own. Prints features, counts and statistics,
warns of what is mostly a mistake, and writes an HTML page with frames, clouds, actions and prompts.
"""

import dataclasses
from pathlib import Path

import tyro

from data_pipelines.episodes import INDEX_FILE
from data_pipelines.inspect.episodes import describe_episodes
from data_pipelines.inspect.page import Page, print_page, write_page
from data_pipelines.records import DataError
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.encoding.encode import EncodingConfig
from dsvla_jax.encoding.prompts import Style


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command line."""

    path: tyro.conf.Positional[Path]
    """A folder of demonstrations."""
    page: Path | None = None
    """The HTML file to write; PATH/inspect.html if not given."""
    tasks: tuple[str, ...] = ()
    """Names of tasks; all that are there if not given."""
    episodes: int = 3
    """Episodes of each task to draw."""
    style: Style = "compact"
    """Of the prompts on the page."""
    workspace_low: tuple[float, float, float] = EncodingConfig.workspace_low
    workspace_high: tuple[float, float, float] = EncodingConfig.workspace_high
    """Corners of the box that clouds are cut to, metres, as in the config to train with."""


def describe(options: Options) -> Page:
    """The page of whatever is at the path. Raises DataError where it is nothing that can be read."""
    path = options.path
    if (path / INDEX_FILE).exists():
        encoding = EncodingConfig(workspace_low=options.workspace_low, workspace_high=options.workspace_high)
        return describe_episodes(path, options.tasks or None, options.episodes, encoding, options.style)
    fix = "generate, import or write demonstrations first (docs/data_own.md)"
    if any(found for depth in range(1, 4) for found in path.glob("*/" * depth + "episodes/episode0")):
        fix = f"import them first: python -m data_pipelines.rlbench {path} OUT, and look at OUT"
    raise DataError(path, "folder", f"demonstrations ({INDEX_FILE})", "none", fix)


def main(options: Options) -> None:
    """Describes what is at the path."""
    page = describe(options)
    print_page(page)
    file = options.page or options.path / "inspect.html"
    write_page(file, page)
    print(f"page: {file}")


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, prog="python -m data_pipelines.inspect", description=__doc__)
        configure_jax()
        main(parsed)
