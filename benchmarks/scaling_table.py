"""paper_7b fits TPU v5e slices of 16, 64 and 256 chips, at a cost a chip that does not grow (an hour on two cores).

Usage: python -m benchmarks.scaling_table [--config paper_7b] [--examples 16] [--plans docs/scaling.jsonl]

Compiles the training step for v5e 4x4, 8x8 and 16x16 with 16 examples a chip, ahead of time and from any processor, and
writes the table into docs/scaling.md. Exits with 1 unless every slice fits 16 GB a chip, compiled FLOPs are within 1.25
of those counted by hand, and neither memory nor communication a chip grows with the slice; with 77 where libtpu is
missing. Slices that --plans already has are not compiled again.
"""

import dataclasses
import itertools
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import tyro

from dsvla_jax.command_line import fail_with_message

PAGE = Path(__file__).parent.parent / "docs" / "scaling.md"
BEGIN, END = "<!-- table of benchmarks.scaling_table -->", "<!-- end of the table -->"
TOPOLOGIES = ("v5e:4x4", "v5e:8x8", "v5e:16x16")
NO_LIBTPU, FLOPS_RATIO = 77, 1.25


@dataclasses.dataclass(frozen=True)
class Options:
    """What to compile."""

    config: str = "paper_7b"
    examples: int = 16
    plans: Path = PAGE.parent / "scaling.jsonl"


def compile_plans(options: Options) -> list[dict[str, Any]]:
    """The plan of each slice, in the order of `TOPOLOGIES`; each in a process of its own, as JAX starts once."""
    for topology in TOPOLOGIES:
        if topology not in read_plans(options):
            command = [sys.executable, "-m", "plan", options.config, "--topology", topology]
            command += ["--examples", str(options.examples), "--no-decode", "--out", str(options.plans)]
            subprocess.run(command, check=False)
    plans = read_plans(options)
    return [plans[topology] for topology in TOPOLOGIES if topology in plans]


def read_plans(options: Options) -> dict[str, dict[str, Any]]:
    """What the file has, by slice."""
    lines = options.plans.read_text().splitlines() if options.plans.exists() else []
    plans = [plan for plan in map(json.loads, lines) if plan["examples"] == options.examples]
    return {plan["topology"]: plan for plan in plans}


def table(plans: list[dict[str, Any]], config: str) -> str:
    """The plans as Markdown."""
    head = ("slice", "mesh", "examples a chip", "GiB a chip", "of it temporary", "FLOPs", "of those by hand")
    head += ("network GiB", "seconds, overlapped to not")
    rows = [head, tuple("---:" if place > 1 else "---" for place in range(len(head)))]
    for plan in plans:
        low, high = plan["seconds"]
        rows.append(
            (
                plan["topology"],
                " x ".join(str(size) for size in plan["mesh"].values()),
                str(plan["examples"]),
                f"{plan['peak'] / 2**30:.2f}",
                "does not fit" if plan["temporary"] is None else f"{plan['temporary'] / 2**30:.2f}",
                f"{plan['flops']:.3e}",
                f"{plan['flops'] / plan['counted_flops']:.2f}",
                f"{network(plan) / 2**30:.1f}",
                f"{low:.2f} to {high:.2f}",
            )
        )
    return f"`{config}`, one training step:\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows)


def network(plan: dict[str, Any]) -> int:
    return sum(plan["collectives"].values())


def shortcomings(plans: list[dict[str, Any]]) -> list[str]:
    """What does not hold."""
    told = [] if len(plans) == len(TOPOLOGIES) else [f"only {len(plans)} of {len(TOPOLOGIES)} slices compiled"]
    for plan in plans:
        ratio = plan["flops"] / plan["counted_flops"]
        told += [] if plan["fits"] else [f"{plan['topology']}: does not fit"]
        told += [] if ratio <= FLOPS_RATIO else [f"{plan['topology']}: {ratio:.2f} times the FLOPs counted by hand"]
        told += [] if not plan["unknown_loops"] else [f"{plan['topology']}: loops of unknown length"]
    for smaller, larger in itertools.pairwise(plans):
        pair = f"{smaller['topology']} to {larger['topology']}"
        told += [] if larger["peak"] <= smaller["peak"] else [f"{pair}: memory a chip grows"]
        # Buffers are padded to whole tiles, which differs with the slice by less than this.
        told += [] if network(larger) <= 1.005 * network(smaller) else [f"{pair}: communication a chip grows"]
    return told


def main(options: Options) -> int:
    if find_spec("libtpu") is None:
        print("no TPU compiler: pip install libtpu", file=sys.stderr)
        return NO_LIBTPU
    plans = compile_plans(options)
    text = table(plans, options.config)
    print(text)
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before.rstrip()}\n\n{BEGIN}\n{text}\n{END}\n{after.lstrip()}")
    for told in shortcomings(plans):
        print("FALLS SHORT:", told)
    return int(bool(shortcomings(plans)))


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
