"""Draws the README's picture, a demonstration of each task that `make train` learns: python -m docs.pictures"""

from pathlib import Path

import numpy as np

from dsvla_jax.command_line import configure_jax
from dsvla_jax.data_config import DataConfig
from dsvla_jax.evaluation.pictures import film_strip, mark_targets
from dsvla_jax.files import write_picture
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys

SIZE, COLUMNS = 224, 5


def demonstration(name: str) -> np.ndarray:
    """A film strip of the expert at work, each next target marked."""
    environment = Environment(name, image_size=SIZE)
    state = environment.reset(episode_keys(1, "validation", name, 0, 1))
    plan = environment.expert(state)
    frames = [np.asarray(environment.render(s).rgb[0]) for s in environment.follow(state, plan)]
    targets = np.asarray(plan.pose[0, :, :, :3])
    frames[:-1] = [mark_targets(f, t, environment.camera) for f, t in zip(frames[:-1], targets, strict=True)]
    frames += [np.full_like(frames[0], 255)] * (COLUMNS - len(frames))
    return film_strip(frames)


def main() -> None:
    """Draws the picture of demonstrations."""
    configure_jax()
    strips = [demonstration(name) for name in DataConfig().tasks]
    path = Path(__file__).parent / "images" / "episodes.png"
    path.parent.mkdir(exist_ok=True)
    write_picture(path, np.concatenate(strips))
    print(path)


if __name__ == "__main__":
    main()
