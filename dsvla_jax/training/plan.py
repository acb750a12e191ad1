"""Plan a run on a TPU slice that is not there: python -m dsvla_jax.training.plan CONFIG --topology v5e:4x4 [...]

CONFIG is a name or a file, and each of its fields can be overridden, as for train.py. Compiles the real training step
and decoding step ahead of time (the libtpu package does it on any processor: pip install libtpu) and prints memory,
FLOPs, communication and time a chip. Without libtpu it compiles for virtual CPU devices, whose memory figures differ
from a TPU's. Exits with 3 where nothing fits.
"""

import dataclasses
import importlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import tyro

from dsvla_jax.command_line import fail_with_message, require_each_option_once
from dsvla_jax.errors import UserError
from dsvla_jax.model.partition import MESH_AXES
from dsvla_jax.training.chips import Slice, find_slice
from dsvla_jax.training.experiment import Experiment
from dsvla_jax.training.planning import Plan, held_bytes, plan_decoding, plan_training
from dsvla_jax.training.sharding import MeshConfig, make_mesh

NOTHING_FITS = 3


def parse_mesh(text: str) -> MeshConfig:
    """The mesh of a text such as data=1,fsdp=-1; axes that are not named are 1. Raises UserError for other texts."""
    sizes = dict.fromkeys(MESH_AXES, 1)
    for part in text.split(","):
        axis, _, size = part.partition("=")
        if axis not in sizes or not size.removeprefix("-").isdigit():
            raise UserError(f"mesh: expected sizes such as data=1,fsdp=-1,tensor=1; got {text!r}")
        sizes[axis] = int(size)
    return MeshConfig(**sizes)


def candidate_meshes(experiment: Experiment, where: Slice) -> Iterator[MeshConfig]:
    """All meshes of the slice that have room for parameters and optimizer, the most copies first.

    `tensor` goes up to the chips of a host, as far as it divides the attention heads of both towers.
    """
    count = len(where.devices)
    sizes = [size for size in range(1, count + 1) if count % size == 0]
    heads = (experiment.model.language.kv_heads, experiment.model.vision.heads)
    for tensor in (size for size in sizes if size <= 8 and not any(number % size for number in heads)):
        for fsdp in (size for size in sizes if (count // tensor) % size == 0):
            config = MeshConfig(count // tensor // fsdp, fsdp, tensor)
            if held_bytes(experiment, make_mesh(config, where.devices)) < where.chip.memory:
                yield config


def size_text(count: float) -> str:
    """Bytes for people."""
    return f"{count / 2**30:.2f} GiB" if count >= 2**28 else f"{count / 2**20:.1f} MiB"


def describe(plan: Plan, where: Slice) -> str:
    """The plan for people."""
    mesh = ", ".join(f"{axis} {size}" for axis, size in plan.mesh.items())
    lines = [f"{plan.program} on {plan.topology}: {mesh}; {plan.examples} examples a chip"]
    memory = plan.held if plan.temporary is None else {**plan.held, "temporary": plan.temporary}
    kinds = ", ".join(f"{kind} {size_text(size)}" for kind, size in memory.items())
    verdict = "fits" if plan.fits else "DOES NOT FIT"
    lines.append(f"  memory   {verdict}: {size_text(plan.peak)} of {size_text(where.chip.memory)} ({kinds})")
    if plan.temporary is not None:
        ratio = plan.flops / plan.counted_flops
        lines.append(f"  FLOPs    {plan.flops:.3e} compiled, {plan.counted_flops:.3e} counted by hand: {ratio:.2f}")
        kinds = ", ".join(f"{kind} {size_text(size)}" for kind, size in sorted(plan.collectives.items())) or "none"
        lines.append(f"  network  {size_text(sum(plan.collectives.values()))} ({kinds})")
        low, high = plan.seconds
        slow, fast = (plan.examples * len(where.devices) / seconds for seconds in (high, low))
        lines.append(
            f"  time     {low:.3g} s if products, memory and network overlap, {high:.3g} s if not: {slow:.0f} to "
            f"{fast:.0f} examples a second at the chips' published peaks"
        )
        if plan.unknown_loops:
            lines.append(f"  {plan.unknown_loops} loops of unknown length are counted once")
    lines.append(f"  compiled in {plan.compile_seconds:.0f} s")
    return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class Options:
    """What to plan."""

    topology: str
    """The slice, e.g. v5e:4x4 or v5p:2x2x4."""
    mesh_sizes: Annotated[str, tyro.conf.arg(name="mesh")] = ""
    """data=1,fsdp=-1,tensor=1; empty for the mesh of the config."""
    examples: tuple[int, ...] = (16,)
    """Examples a chip, in place of the config's batch size; several are planned one after the other."""
    search: bool = False
    """Plan all meshes that have room for the parameters, and end with the quickest that fits."""
    decode: bool = True
    """Plan decoding too."""
    out: Path | None = None
    """A file that gets each plan as a line of JSON."""


def main(experiment: Experiment, options: Options) -> int:
    """Plans an experiment on a slice, prints each plan, and returns the exit status."""
    where = find_slice(options.topology)
    if where.virtual:
        print("no TPU compiler (pip install libtpu): planning on virtual CPU devices", file=sys.stderr)
    elif experiment.model.attention == "auto":
        # That would be chosen for the processor that compiles.
        experiment = dataclasses.replace(experiment, model=dataclasses.replace(experiment.model, attention="fused"))
    if options.mesh_sizes:
        experiment = dataclasses.replace(experiment, mesh=parse_mesh(options.mesh_sizes))
    meshes = list(candidate_meshes(experiment, where)) if options.search else [experiment.mesh]
    jobs: list[Callable[[Experiment, int], Plan]] = [lambda one, count: plan_training(one, where, count)]
    if options.decode:
        jobs.append(lambda one, count: plan_decoding(one, where, count))
    plans = []
    for mesh in meshes:
        for count in options.examples:
            for job in jobs:
                plan = job(dataclasses.replace(experiment, mesh=mesh), count)
                plans.append(plan)
                print(describe(plan, where), flush=True)
                if options.out is not None:
                    with options.out.open("a") as file:
                        file.write(json.dumps(dataclasses.asdict(plan)) + "\n")
    training = [plan for plan in plans if plan.program == plans[0].program and plan.fits]
    if len(meshes) * len(options.examples) > 1 and training:
        best = min(training, key=lambda plan: sum(plan.seconds) / plan.examples)
        print(f"quickest that fits: {best.mesh}, {best.examples} examples a chip")
    return 0 if training else NOTHING_FITS


def command_line(arguments: list[str]) -> int:
    """Parses `CONFIG --topology SLICE ...` and plans."""
    if not arguments or arguments[0].startswith("-"):
        print(__doc__)
        return 0 if arguments else 2
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # The experiments are the program's, which knows this package, and not the other way round.
    experiment = importlib.import_module("configs").get_config(arguments[0])

    def plan(
        options: Annotated[Options, tyro.conf.arg(name="")],
        experiment: Annotated[Experiment, tyro.conf.arg(name="")] = experiment,
    ) -> int:
        return main(experiment, options)

    require_each_option_once(arguments[1:])
    return tyro.cli(plan, args=arguments[1:], prog=f"plan {arguments[0]}", description=__doc__)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(command_line(sys.argv[1:]))
