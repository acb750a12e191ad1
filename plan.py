"""Plan a run on a TPU slice that is not there: python plan.py CONFIG --topology v5e:4x4 [...]

CONFIG is a name or a file, and each of its fields can be overridden, as for train.py. Compiles the real training step
and decoding step ahead of time (the libtpu package does it on any processor: pip install libtpu) and prints memory,
FLOPs, communication and time a chip. Without libtpu it compiles for virtual CPU devices, whose memory figures differ
from a TPU's. Exits with 3 where nothing fits.
"""

import dataclasses
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from configs import get_config
from dsvla_jax.command_line import fail_with_message, require_each_option_once
from dsvla_jax.experiment import Experiment
from dsvla_jax.planner.description import describe
from dsvla_jax.planner.meshes import candidate_meshes, parse_mesh
from dsvla_jax.planner.planning import Plan, plan_decoding, plan_training
from dsvla_jax.training.chips import find_slice

NOTHING_FITS = 3


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
    experiment = get_config(arguments[0])

    def plan(
        options: Annotated[Options, tyro.conf.arg(name="")],
        experiment: Annotated[Experiment, tyro.conf.arg(name="")] = experiment,
    ) -> int:
        return main(experiment, options)

    require_each_option_once(arguments[1:])
    return tyro.cli(plan, args=arguments[1:], prog=f"plan.py {arguments[0]}", description=__doc__)


def program() -> None:
    """Runs the program: `python plan.py`, or `dsvla-plan` where the project is installed."""
    with fail_with_message():
        sys.exit(command_line(sys.argv[1:]))


if __name__ == "__main__":
    program()
