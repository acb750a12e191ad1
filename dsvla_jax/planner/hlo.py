"""What a compiled program costs, read from its text: matrix products, collectives and memory traffic.

XLA's own cost analysis counts the body of a loop once, and a model is a loop over its layers. Here every instruction
counts as often as the loops around it run. Shapes in a compiled program are those of one device, and so are all counts.
"""

import dataclasses
import math
import re
from collections import defaultdict
from typing import Literal

import numpy as np

COLLECTIVES = ("all-gather", "all-reduce", "reduce-scatter", "all-to-all", "collective-permute", "ragged-all-to-all")

# Instructions that name buffers, or whose called computations are counted themselves.
_FREE = ("parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "call", "conditional", "after-all")

_BITS = {"pred": 8, "c64": 64, "c128": 128, "token": 0, "opaque": 0}
_SHAPE = re.compile(r"\b(pred|token|opaque|[a-z]+\d+\w*)\[([\d,]*)\](?:\{([^}]*)\})?")


@dataclasses.dataclass(frozen=True)
class Shape:
    """One array. on_chip: whether it lives in the cores' own memory and costs no traffic."""

    dims: tuple[int, ...]
    bits: int
    on_chip: bool

    @property
    def bytes(self) -> int:
        """Its size in memory."""
        return math.prod(self.dims) * self.bits // 8


@dataclasses.dataclass(frozen=True)
class Instruction:
    """One line of a program."""

    name: str
    opcode: str
    shapes: tuple[Shape, ...]
    operands: tuple[str, ...]
    rest: str
    attributes: str
    root: bool

    def attribute(self, pattern: str) -> str | None:
        """The first group of a pattern in the attributes; None if it is not there."""
        found = re.search(pattern, self.attributes)
        return found.group(1) if found else None


Computation = dict[str, Instruction]


@dataclasses.dataclass
class Cost:
    """Of one device, one run of the program.

    flops: of matrix products. traffic: bytes that instructions read and write in the device's main memory; an upper
    estimate. collectives: bytes by kind, each buffer at its full size over the devices that take part (an all-reduce
    twice, as it reduces and then gathers): what a device of a large ring sends. unknown_loops: loops whose number of
    rounds is not in the program, counted once.
    """

    flops: int = 0
    traffic: int = 0
    collectives: dict[str, int] = dataclasses.field(default_factory=lambda: defaultdict(int))
    unknown_loops: int = 0


def program_cost(text: str) -> Cost:
    """The cost of an optimised HLO module, as ``compiled.as_text()`` gives it."""
    computations, entry = parse_module(text)
    cost = Cost()
    _add(cost, computations, entry, 1, entry, set(), fused=False)
    return cost


def parse_module(text: str) -> tuple[dict[str, Computation], str]:
    """The computations of a module by name, and the name of its entry."""
    computations: dict[str, Computation] = {}
    entry, current = "", None
    for line in text.splitlines():
        if line.endswith("{") and ") -> " in line and not line.startswith(" "):
            name = line.removeprefix("ENTRY ").split(" ", 1)[0].lstrip("%")
            entry = name if line.startswith("ENTRY") else entry
            current = computations.setdefault(name, {})
        elif line.startswith("}"):
            current = None
        elif current is not None and " = " in line:
            instruction = _parse_instruction(line)
            current[instruction.name] = instruction
    return computations, entry


def _parse_instruction(line: str) -> Instruction:
    head, _, rest = line.strip().partition(" = ")
    split = _closing(rest, 0) + 1 if rest.startswith("(") else rest.index(" ")
    type_, rest = rest[:split], rest[split:].lstrip()
    opening = rest.index("(")
    closing = _closing(rest, opening)
    inside = rest[opening + 1 : closing]
    return Instruction(
        name=head.removeprefix("ROOT ").lstrip("%"),
        opcode=rest[:opening],
        shapes=tuple(map(_shape, _SHAPE.finditer(type_))),
        operands=tuple(re.findall(r"%([\w.\-]+)", inside)),
        rest=inside,
        attributes=rest[closing + 1 :],
        root=head.startswith("ROOT "),
    )


def _closing(text: str, opening: int) -> int:
    """Where the parenthesis at ``opening`` is closed."""
    depth = 0
    for place in range(opening, len(text)):
        depth += (text[place] == "(") - (text[place] == ")")
        if depth == 0:
            return place
    raise ValueError(f"no end of the parenthesis in {text[:80]!r}")


def _shape(found: re.Match[str]) -> Shape:
    dtype, dims, layout = found.groups()
    bits = _BITS[dtype] if dtype in _BITS else int(re.findall(r"\d+", dtype)[0])
    return Shape(tuple(map(int, dims.split(","))) if dims else (), bits, bool(re.search(r"S\([1-9]", layout or "")))


def _add(
    cost: Cost,
    computations: dict[str, Computation],
    name: str,
    times: int,
    caller: str,
    seen: set[tuple[str, str]],
    fused: bool,
) -> None:
    """Adds a computation that runs so many times. caller: the innermost computation around it that is no fusion."""
    computation = computations[name]
    for instruction in computation.values():
        opcode = instruction.opcode.removesuffix("-start")
        if opcode == "dot":
            cost.flops += times * _dot_flops(instruction, computation)
        elif opcode == "convolution":
            cost.flops += times * _convolution_flops(instruction, computation)
        elif opcode in COLLECTIVES:
            # On TPU one collective that overlaps with computation is spread over several fusions.
            channel = instruction.attribute(r"channel_id=(\d+)") or instruction.name
            if (caller, channel) not in seen:
                seen.add((caller, channel))
                kind = "reduce-scatter" if "all-reduce-scatter" in name else opcode
                cost.collectives[kind] += times * _collective_bytes(kind, instruction, computation)
        if not fused and opcode not in _FREE:
            cost.traffic += times * _traffic(instruction, computation, computations)
        if opcode == "while":
            trips = _trips(instruction, computation, computations)
            cost.unknown_loops += trips is None
            body = instruction.attribute(r"body=%?([\w.\-]+)") or ""
            _add(cost, computations, body, times * (1 if trips is None else trips), body, seen, fused=False)
        elif opcode == "fusion":
            called = instruction.attribute(r"calls=%?([\w.\-]+)") or ""
            _add(cost, computations, called, times, caller, seen, fused=True)
        elif opcode in ("call", "async"):
            called = instruction.attribute(r"(?:to_apply|calls)=%?([\w.\-]+)") or ""
            _add(cost, computations, called, times, called, seen, fused)
        elif opcode == "conditional":
            branches = instruction.attribute(r"branch_computations=\{([^}]*)\}")
            names = re.findall(r"%?([\w.\-]+)", branches) if branches else []
            names += re.findall(r"(?:true|false)_computation=%?([\w.\-]+)", instruction.attributes)
            for branch in names:
                _add(cost, computations, branch, times, branch, seen, fused)


def _dot_flops(instruction: Instruction, computation: Computation) -> int:
    left = computation[instruction.operands[0]].shapes[0].dims
    contracted = instruction.attribute(r"lhs_contracting_dims=\{([\d,]*)\}")
    inner = math.prod(left[int(axis)] for axis in contracted.split(",")) if contracted else 1
    return 2 * math.prod(instruction.shapes[0].dims) * inner


def _convolution_flops(instruction: Instruction, computation: Computation) -> int:
    """Products with zeros that stand for padding and dilation do not count: on TPU a batched product is written so."""
    labels = instruction.attribute(r"dim_labels=([\w?]+_[\w?]+->[\w?]+)")
    assert labels is not None
    left_labels, right_labels, out_labels = re.split(r"_|->", labels)
    left, right = (computation[name].shapes[0].dims for name in instruction.operands[:2])
    out = instruction.shapes[0].dims
    window = instruction.attribute(r"window=\{([^}]*)\}") or ""
    sizes = dict(re.findall(r"(\w+)=(\S+)", window))
    total = right[right_labels.index("i")] * out[out_labels.index("f")] * out[out_labels.index("b")]
    for axis in range(sum(label.isdigit() for label in out_labels)):
        digit = str(axis)

        def of(key: str, default: int, axis: int = axis) -> int:
            return int(sizes[key].split("x")[axis]) if key in sizes else default

        low = int(sizes["pad"].split("x")[axis].split("_")[0]) if "pad" in sizes else 0
        dilate = of("lhs_dilate", 1)
        span = (left[left_labels.index(digit)] - 1) * dilate + 1
        starts = np.arange(out[out_labels.index(digit)]) * of("stride", 1) - low
        valid = 0
        for tap in range(right[right_labels.index(digit)]):
            at = starts + tap * of("rhs_dilate", 1)
            valid += int(((at >= 0) & (at < span) & (at % dilate == 0)).sum())
        total *= valid
    return 2 * total


def _collective_bytes(kind: str, instruction: Instruction, computation: Computation) -> int:
    operands = sum(shape.bytes for name in instruction.operands for shape in computation[name].shapes)
    # The result of an asynchronous start holds the operand too.
    results = sum(shape.bytes for shape in instruction.shapes)
    results -= operands if instruction.opcode in ("all-gather-start", "collective-permute-start") else 0
    return {"reduce-scatter": operands, "all-reduce": 2 * operands}.get(kind, results)


def _traffic(instruction: Instruction, computation: Computation, computations: dict[str, Computation]) -> int:
    """Bytes read and written in main memory. Of a buffer that a fusion takes slices of, the slices count."""
    inner: Computation = {}
    if instruction.opcode == "fusion":
        inner = computations[instruction.attribute(r"calls=%?([\w.\-]+)") or ""]
    elif instruction.opcode in ("dynamic-slice", "dynamic-update-slice", "gather"):
        inner = {"": dataclasses.replace(instruction, root=True)}
    parameters = {int(item.rest): item.name for item in inner.values() if item.opcode == "parameter"}
    total = 0
    for index, operand in enumerate(instruction.operands):
        if operand not in computation:
            continue
        shapes = [shape for shape in computation[operand].shapes if not shape.on_chip]
        name = parameters.get(index, operand)
        users = [item for item in inner.values() if name in item.operands]
        if users and all(_takes_slice(item, name) for item in users):
            total += sum(item.shapes[0].bytes for item in users if item.opcode != "dynamic-update-slice") * bool(shapes)
        else:
            total += sum(shape.bytes for shape in shapes)
    written = [shape for shape in instruction.shapes if not shape.on_chip]
    updates = [item for item in inner.values() if item.opcode == "dynamic-update-slice"]
    if updates and written and any(item.shapes[0].dims == written[0].dims for item in updates):
        sizes = [inner.get(item.operands[1]) or computation.get(item.operands[1]) for item in updates]
        return total + sum(item.shapes[0].bytes for item in sizes if item is not None)
    return total + sum(shape.bytes for shape in written)


def _takes_slice(user: Instruction, name: str) -> bool:
    sliced = user.opcode in ("dynamic-slice", "gather", "dynamic-update-slice")
    return sliced and user.operands[0] == name and name not in user.operands[1:]


def _trips(loop: Instruction, computation: Computation, computations: dict[str, Computation]) -> int | None:
    """How often a loop runs: noted by the compiler, or from a counter that its condition compares with a constant."""
    noted = loop.attribute(r'known_trip_count[^0-9]*"?n"?[^0-9]*(\d+)')
    if noted is not None:
        return int(noted)
    condition = computations[loop.attribute(r"condition=%?([\w.\-]+)") or ""]
    root = next(item for item in condition.values() if item.root)
    if root.opcode == "fusion":
        inner = computations[root.attribute(r"calls=%?([\w.\-]+)") or ""]
        compare = next(item for item in inner.values() if item.root)
        places = {item.name: root.operands[int(item.rest)] for item in inner.values() if item.opcode == "parameter"}
        sides = [places.get(name) for name in compare.operands]
        known = {name: int(item.rest) for name, item in inner.items() if item.opcode == "constant"}
    else:
        compare, sides, known = root, list(root.operands), {}
    if compare.opcode != "compare" or compare.attribute(r"direction=(\w+)") not in ("LT", "NE"):
        return None

    def at_start(side: Literal[0, 1]) -> int | None:
        if compare.operands[side] in known:
            return known[compare.operands[side]]
        item = _through_copies(condition, sides[side])
        if item is None or item.opcode != "get-tuple-element":
            return _constant(item)
        start = computation.get(loop.operands[0])
        if start is None or start.opcode != "tuple":
            return None
        return _constant(_through_copies(computation, start.operands[_place(item)]))

    first, last = at_start(0), at_start(1)
    if last is None:
        return None
    counter = _through_copies(condition, sides[0])
    body = computations[loop.attribute(r"body=%?([\w.\-]+)") or ""]
    step = 1 if counter is None or counter.opcode != "get-tuple-element" else _step(body, _place(counter))
    return max(-(-(last - (first or 0)) // step), 0)


def _step(body: Computation, place: int) -> int:
    """By how much a loop's body raises the counter at a place of its tuple: unrolled loops by more than one."""
    root = next(item for item in body.values() if item.root)
    item = _through_copies(body, root.operands[place]) if root.opcode == "tuple" else None
    total = 0
    while item is not None and item.opcode == "add":
        sides = [_through_copies(body, name) for name in item.operands]
        raised = [value for value in map(_constant, sides) if value is not None]
        if len(raised) != 1:
            break
        total += raised[0]
        item = next(side for side in sides if _constant(side) is None)
    return max(total, 1)


def _place(item: Instruction) -> int:
    return int(item.attribute(r"index=(\d+)") or 0)


def _through_copies(computation: Computation, name: str | None) -> Instruction | None:
    item = computation.get(name or "")
    while item is not None and item.opcode in ("copy", "bitcast", "convert"):
        item = computation.get(item.operands[0])
    return item


def _constant(item: Instruction | None) -> int | None:
    if item is None or item.opcode != "constant" or not re.fullmatch(r"-?\d+", item.rest):
        return None
    return int(item.rest)
