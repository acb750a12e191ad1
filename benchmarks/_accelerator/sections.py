"""The sections of benchmarks.accelerator in the order in which they run, and the two sizes at which they do."""

import dataclasses
import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from dsvla_jax.errors import UserError

Size = Literal["full", "toy"]


@dataclasses.dataclass(frozen=True)
class TrainCase:
    """One training step that is measured; what is None is as `configs/paper_7b.py` has it."""

    batch: int
    remat: Literal["full", "dots"] | None = None
    attention: Literal["fused", "cudnn"] | None = None

    @property
    def name(self) -> str:
        """What the report calls it."""
        changes = [f"{field} {value}" for field in ("remat", "attention") if (value := getattr(self, field))]
        return ", ".join((f"batch {self.batch}", *changes))


@dataclasses.dataclass(frozen=True)
class DecodeCase:
    """Actions that are measured: for a number of robots that ask together, with the base in bfloat16 or in 8 bits."""

    robots: int
    base: Literal["bfloat16", "int8"] = "bfloat16"
    attention: Literal["fused", "cudnn"] | None = None

    @property
    def name(self) -> str:
        """What the report calls it."""
        changes = [self.base] if self.base != "bfloat16" else []
        changes += [f"attention {self.attention}"] if self.attention else []
        return ", ".join((f"robots {self.robots}", *changes))


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much of everything is measured."""

    name: Size = "full"
    product: int = 8192
    """Rows and columns of the matrices whose product gives the device's attainable rate."""
    train: tuple[TrainCase, ...] = (
        TrainCase(3),
        TrainCase(8, "dots"),
        TrainCase(16),
    )
    train_steps: int = 10
    decode: tuple[DecodeCase, ...] = (DecodeCase(1), DecodeCase(8), DecodeCase(1, "int8"), DecodeCase(64, "int8"))
    actions: int = 20
    episodes: tuple[int, ...] = (32, 256, 1024)
    """Side by side in the device loop."""
    keyframes: int = 8
    """At most so many in an episode of the device loop; fewer for tasks whose experts need less than half."""
    rollouts: int = 3
    render_tasks: tuple[str, ...] = ("lamp_on", "stack_blocks")
    pixels: tuple[int, ...] = (64, 128, 336)
    frames: int = 128
    """Rendered at a time."""
    clouds: tuple[int, ...] = (1, 16, 64)
    repeats: int = 10
    picture_tasks: tuple[str, ...] = (
        "lamp_on",
        "stack_blocks",
        "close_fridge",
        "put_rubbish_in_bin",
        "bimanual_lift_ball",
    )
    pictures: int = 20
    """Of each of those tasks, of `picture_pixels` a side."""
    picture_pixels: int = 128
    compared: int = 50
    """Episodes whose outcome is compared with the CPU's."""


SIZES = {
    "full": Sizes(),
    "toy": Sizes(
        name="toy",
        product=64,
        train=(TrainCase(2), TrainCase(2, "dots")),
        train_steps=2,
        decode=(DecodeCase(2), DecodeCase(2, "int8")),
        actions=2,
        episodes=(2,),
        keyframes=2,
        rollouts=1,
        pixels=(16,),
        frames=2,
        clouds=(2,),
        repeats=2,
        render_tasks=("lamp_on",),
        picture_tasks=("lamp_on",),
        pictures=8,
        picture_pixels=32,
        compared=2,
    ),
}


@dataclasses.dataclass(frozen=True)
class Job:
    """What a section is given.

    folder: for what several sections use. note: adds figures to the section's, and writes the report.
    left: the seconds that are left. shared: passed on between sections of one module.
    """

    sizes: Sizes
    folder: Path
    note: Callable[..., None]
    left: Callable[[], float]
    shared: dict[str, Any]

    def prepared(self, name: str) -> Path:
        """The file that `benchmarks._accelerator.reference` makes, waited for. Raises UserError if it fails."""
        file, problem = prepared_file(self.folder, name), problem_file(self.folder, name)
        while not file.exists():
            if problem.exists():
                raise UserError(f"{name}: the CPU could not prepare them: {problem.read_text()}")
            if self.left() <= 0:
                raise UserError(f"{name}: the CPU was still preparing them when no time was left")
            time.sleep(0.2)
        return file


def prepared_file(folder: Path, name: str) -> Path:
    """Where something that is prepared on the CPU is kept."""
    return folder / f"{name}.pickle"


def problem_file(folder: Path, name: str) -> Path:
    """Where it is said why it could not be prepared."""
    return folder / f"{name}.problem"


@dataclasses.dataclass(frozen=True)
class Section:
    """One part of the benchmark.

    function: "module:name", imported when it runs, so that what one section lacks stops no other.
    seconds: what it is expected to take at full size. needs: what the CPU prepares for it.
    headlines: patterns of the figures that the table shows.
    """

    name: str
    function: str
    seconds: float
    headlines: tuple[str, ...]
    needs: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        """Where its function is."""
        return self.function.partition(":")[0]

    def run(self, job: Job) -> None:
        """Measures."""
        module, _, name = self.function.partition(":")
        getattr(importlib.import_module(module), name)(job)


_HERE = "benchmarks._accelerator"

# Peak memory is one figure of the whole process, so the largest model comes first.
SECTIONS = (
    Section("devices", f"{_HERE}.device:devices", 10, ("kind", "memory_gib", "product_tflops", "jax")),
    Section(
        "paper_7b_train",
        f"{_HERE}.paper:train",
        120,
        (
            "*/tokens_per_second",
            "*/utilisation",
            "*/peak_gib",
            "*/planned_gib",
            "*/seconds",
            "*/compile_seconds",
            "*/skipped",
        ),
    ),
    Section("paper_7b_decode", f"{_HERE}.paper:decode", 240, ("*/milliseconds", "*/compile_seconds", "*/skipped")),
    Section("points", f"{_HERE}.device:points", 20, ("*/clouds_per_second",)),
    Section("render", f"{_HERE}.simulation:render", 20, ("*/frames_per_second",)),
    Section(
        "equal_pictures", f"{_HERE}.simulation:equal_pictures", 20, ("equal", "*share", "*difference"), ("pictures",)
    ),
    Section(
        "tiny",
        f"{_HERE}.tiny:tiny",
        90,
        ("steps_per_second", "train_seconds", "success", "success_*"),
        ("demonstrations",),
    ),
    Section("mjx_lamp_on", f"{_HERE}.simulation:lamp_on", 90, ("*/keyframes_per_second", "*/episodes_per_second")),
    Section(
        "mjx_stack_blocks", f"{_HERE}.simulation:stack_blocks", 120, ("*/keyframes_per_second", "*/episodes_per_second")
    ),
    Section(
        "equal_episodes", f"{_HERE}.simulation:equal_episodes", 90, ("agree", "episodes", "*succeed*"), ("episodes",)
    ),
)


def choose(names: tuple[str, ...]) -> list[Section]:
    """The sections of these names (with commas or spaces between, or all), in their order. Raises UserError."""
    known = {section.name: section for section in SECTIONS}
    wanted = {name for words in names for name in words.split(",") if name}
    if "all" in wanted:
        return list(SECTIONS)
    if unknown := sorted(wanted - known.keys()):
        raise UserError(f"sections: unknown {', '.join(unknown)}; choose from all, {', '.join(known)}")
    return [section for section in SECTIONS if section.name in wanted]
