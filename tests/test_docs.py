"""What the documents say works: the example of a new task runs, and the pictures that the pages show exist."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.accelerator_page import PAGE, page
from data_pipelines.episodes import EpisodeReader
from dsvla_jax.geometry.cameras import project
from dsvla_jax.sim.environment import Environment
from dsvla_jax.types import Camera
from tests.small import SMALL_RUN

DOCS = Path(__file__).parent.parent / "docs"


def test_the_example_of_a_new_task_works():
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "tasks_adding.md").read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(code, "tasks_adding.md", "exec"), names)
    environment = Environment(names["TASK"], image_size=32)
    start = environment.reset(jax.random.split(jax.random.key(0), 2))
    assert not np.asarray(environment.success(start)).any()
    assert np.asarray(environment.success(environment.follow(start, environment.expert(start))[-1])).all()


def test_the_example_of_a_new_task_is_one_file_that_is_trained_on(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "tasks_adding.md").read_text(), re.DOTALL)
    for name in ("dsvla_jax", "data_pipelines", "configs"):
        shutil.copytree(DOCS.parent / name, tmp_path / name)
    shutil.copy(DOCS.parent / "train.py", tmp_path)
    (tmp_path / "dsvla_jax" / "sim" / "tasks" / "lift_cube.py").write_text(code)
    options = "--data.tasks lift_cube --data.episodes 2 --data.image-size 48 --steps 1"
    command = [sys.executable, "train.py", *SMALL_RUN.split(), *options.split()]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    episode = EpisodeReader(tmp_path / "data" / "demos").episode(0)
    assert episode.keypoints.shape == (1, 1, 3)
    # Found on the cube by its mask, and a little inside of what is seen of it.
    assert 0.752 < episode.keypoints[0, 0, 2] < 0.81
    assert (tmp_path / "run" / "checkpoints" / "1").is_dir()


def test_the_example_of_own_demonstrations_works(tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "data_own.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "data_own.md", "exec"), {})
    assert capsys.readouterr().out.splitlines() == ["6 samples: pick up the block"] * 3
    frame = EpisodeReader("data/mine").frame(0)
    # The keypoint is in the block: what is seen where it projects to is red and nearer than the table.
    camera = Camera(
        jnp.asarray(frame.pictures.camera.intrinsics[0]), jnp.asarray(frame.pictures.camera.world_from_camera[0])
    )
    pixel, depth = project(frame.keypoint[0], camera)
    u, v = np.rint(np.asarray(pixel)).astype(int)
    np.testing.assert_array_equal(frame.pictures.rgb[0][v, u], [200, 40, 40])
    np.testing.assert_allclose(np.array([frame.pictures.depth[0][v, u], float(depth)]), 0.95, atol=1e-4)


@pytest.mark.parametrize("page", [*sorted(DOCS.glob("*.md")), DOCS.parent / "README.md"], ids=lambda page: page.name)
def test_linked_files_exist(page: Path):
    links = re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text())
    assert not [link for link in links if not (page.parent / link).exists()]


def test_the_page_of_accelerators_is_what_the_figures_say():
    assert PAGE.read_text() == page(), "write it: python -m benchmarks.accelerator_page"
