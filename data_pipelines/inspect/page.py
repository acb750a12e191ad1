"""What is said about a data set: tables, warnings and sections with pictures, for the terminal and as HTML."""

import dataclasses
import os
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table as RichTable

from dsvla_jax.evaluation.pages import write_html


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of texts under a caption; columns but the first are aligned to the right where `numbers`."""

    caption: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    numbers: bool = True


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the page. pictures: (caption, uint8 (H, W, 3)). lines: shown as they are, spaces and all."""

    heading: str
    pictures: list[tuple[str, np.ndarray]]
    lines: list[str]


@dataclasses.dataclass(frozen=True)
class Page:
    """Everything that is said about one data set."""

    title: str
    tables: list[Table]
    warnings: list[str]
    sections: list[Section]


def print_page(page: Page, console: Console | None = None) -> None:
    """Tables and warnings on the terminal."""
    console = console or Console()
    console.print(page.title, style="bold", markup=False)
    for table in page.tables:
        drawn = RichTable(title=table.caption, title_justify="left")
        for index, column in enumerate(table.columns):
            drawn.add_column(column, justify="right" if table.numbers and index else "left", overflow="fold")
        for row in table.rows:
            drawn.add_row(*map(_plain, row))
        console.print(drawn)
    for warning in page.warnings:
        console.print(f"warning: {warning}", markup=False)


def write_page(path: str | os.PathLike, page: Page) -> None:
    """The page as one HTML file that needs no other file and no network."""
    write_html(Path(path), Path(__file__).with_name("page.html.jinja"), page=page)


def _plain(text: str) -> str:
    # Square brackets are rich's mark-up.
    return text.replace("[", r"\[")
