"""Prints what a config trains and freezes, by name: 334.3 M of 7.38 G for the paper's (10 seconds).

Usage: python -m benchmarks.parameter_counts [CONFIG]. Nothing is allocated. Exits with 1 where the paper's config
departs from the sizes of LLaMA-Adapter's modules as ManipLLM, which 3DS-VLA builds on, has them.
"""

import math
import sys
from typing import Any

import jax

from configs import get_config
from dsvla_jax.model.variables import split_variables
from dsvla_jax.model.vla import initialize

# ManipLLM's released model: LLaMA's adapters; the visual blocks with their norm and output; visual_proj and clip_proj
# with their norms; adapter_query.
PUBLISHED = {
    "lora/language": 39_976_960,
    "visual_blocks*": 206_603_264,
    "visual_proj*": 4_206_592,
    "clip_proj*": 789_504,
    "adapter_query": 75_628_544,
}


def count(tree: Any) -> int:
    """Parameters of a tree of shapes."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))


def table(name: str) -> tuple[dict[str, int], dict[str, int]]:
    """Parameters that learn, and that are frozen, by module."""
    experiment = get_config(name)
    shapes = jax.eval_shape(lambda: initialize(experiment.model, jax.random.key(0)))
    parts = []
    for tree in split_variables(shapes, experiment.regime):
        part = {f"lora/{tower}": count(leaves) for tower, leaves in tree.get("lora", {}).items()}
        for module, leaves in tree.get("params", {}).items():
            inner = {f"{module}/{key}": count(value) for key, value in leaves.items()}
            part |= inner if module == "projector" else {module: count(leaves)}
        parts.append(part)
    return parts[0], parts[1]


def main(name: str) -> int:
    learns, frozen = table(name)
    for label, part in (("learns", learns), ("frozen", frozen)):
        for module, size in part.items():
            print(f"{label}  {module:32}{size:16,}")
        print(f"{label}  {'all':32}{sum(part.values()):16,}")
    if name != "paper_7b":
        return 0
    short = {module.removeprefix("projector/"): size for module, size in learns.items()}
    wrong = 0
    for module, size in PUBLISHED.items():
        stem = module.removesuffix("*")
        found = sum(n for key, n in short.items() if key == stem or (module != stem and key.startswith(stem)))
        wrong += found != size
        print(f"published  {module:28}{size:16,}  {'the same' if found == size else f'here {found:,}'}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else "paper_7b"))
