"""A plan as text."""

from dsvla_jax.planner.planning import Plan
from dsvla_jax.training.chips import Slice


def size_text(count: float) -> str:
    """A number of bytes in MiB or GiB."""
    return f"{count / 2**30:.2f} GiB" if count >= 2**28 else f"{count / 2**20:.1f} MiB"


def describe(plan: Plan, where: Slice) -> str:
    """The plan as lines of text: memory, FLOPs, communication and time of each chip."""
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
