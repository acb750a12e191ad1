"""What the documents say works: the example of a new task runs, and the pictures that the pages show exist."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from dsvla_jax.sim.episode import Environment

DOCS = Path(__file__).parent.parent / "docs"


def test_the_example_of_a_new_task_works():
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "tasks_adding.md").read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(code, "tasks_adding.md", "exec"), names)
    environment = Environment(names["TASK"], image_size=32)
    start = environment.reset(jax.random.split(jax.random.key(0), 2))
    assert not np.asarray(environment.success(start)).any()
    assert np.asarray(environment.success(environment.follow(start, environment.expert(start))[-1])).all()


@pytest.mark.parametrize("page", [*sorted(DOCS.glob("*.md")), DOCS.parent / "README.md"], ids=lambda page: page.name)
def test_linked_files_exist(page: Path):
    links = re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text())
    assert not [link for link in links if not (page.parent / link).exists()]
