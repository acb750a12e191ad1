"""What defines one training run. Every file of ``configs/`` returns one `Experiment`; a run folder keeps it as JSON."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Literal

from dsvla_jax.config_files import read_config
from dsvla_jax.data_config import DataConfig, OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import UserError
from dsvla_jax.files import replacing
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.partition import MESH_AXES
from dsvla_jax.model.same_sizes import require_same_sizes
from dsvla_jax.model.variables import Regime
from dsvla_jax.policies.config import Baseline, PolicyConfig, uses_model
from dsvla_jax.ranges import at_least, check_fields, more_than, require


@dataclasses.dataclass(frozen=True)
class MeshConfig:
    """How many devices lie along each axis of the mesh. The default suits models that fit one device.

    One axis may be -1: it takes the devices that the others leave.
    """

    data: int = -1
    """Devices that split the batch and hold whole copies of the parameters; -1 for all that the other axes leave."""
    fsdp: int = 1
    """Devices that split the batch, the parameters and the optimizer state; -1 for all that the other axes leave."""
    tensor: int = 1
    """Devices that split the hidden width of each layer; keep them within one host. -1 for all that the other axes
    leave."""

    def __post_init__(self) -> None:
        sizes = {axis: getattr(self, axis) for axis in MESH_AXES}
        check_fields(self, "mesh", **dict.fromkeys(sizes, at_least(-1)))
        named = ", ".join(f"{axis}={size}" for axis, size in sizes.items())
        if list(sizes.values()).count(-1) > 1 or 0 in sizes.values():
            raise UserError(f"mesh: expected positive sizes, and -1 (the rest) for one axis at most; got {named}")

    def shape(self, devices: int) -> tuple[int, int, int]:
        """Returns the sizes of the axes on these devices. Raises UserError unless their product is `devices`."""
        sizes = [self.data, self.fsdp, self.tensor]
        named = ", ".join(f"{axis}={size}" for axis, size in zip(MESH_AXES, sizes, strict=True))
        known = math.prod(size for size in sizes if size != -1)
        if devices % known or (-1 not in sizes and known != devices):
            raise UserError(
                f"mesh: {named} cannot be laid over {devices} devices; choose sizes with a product of {devices} "
                "(-1 for the rest), e.g. --mesh.data -1 --mesh.fsdp 1 --mesh.tensor 1"
            )
        data, fsdp, tensor = (devices // known if size == -1 else size for size in sizes)
        return data, fsdp, tensor


@dataclasses.dataclass(frozen=True)
class OptimizerConfig:
    """AdamW or Muon, with linear warm-up and a cosine to `final_fraction` of the peak."""

    method: Literal["adamw", "muon"] = "adamw"
    """The optimizer. muon orthogonalises the update of each layer's matrices (Jordan 2024) and scales it to AdamW's
    (Liu et al. 2025, arXiv 2502.16982); all other parameters use AdamW with Nesterov momentum."""
    learning_rate: float = 1e-3
    """Peak learning rate."""
    warmup_steps: int = 50
    """Steps of linear warm-up, but at most a fifth of the run."""
    final_fraction: float = 0.0
    """Learning rate at the end of the cosine, as a fraction of the peak."""
    weight_decay: float = 0.05
    """AdamW's decoupled weight decay, on kernels only."""
    beta1: float = 0.9
    """Decay of Adam's mean of the gradient."""
    beta2: float = 0.95
    """Decay of Adam's mean of the squared gradient."""
    gradient_clip: float = 1.0
    """Largest norm of the gradient; inf for no limit."""
    average_decay: float = 0.0
    """Acts by a moving average of the weights; the largest share that a step keeps of it, such as 0.999. 0 for none."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "optimizer",
            learning_rate=more_than(0),
            warmup_steps=at_least(0),
            final_fraction=at_least(0, at_most=1),
            weight_decay=at_least(0),
            beta1=at_least(0, below=1),
            beta2=at_least(0, below=1),
            gradient_clip=more_than(0, infinite=True),
            average_decay=at_least(0, below=1),
        )


@dataclasses.dataclass(frozen=True)
class ValidationConfig:
    """Comparison of answers with held-out demonstrations while training."""

    episodes: int = 10
    """Held-out demonstrations a task: from seeds of their own, or what a folder has after `data.episodes`."""
    batches: int = 8
    """At most so many, always the same ones; fewer where that is all of the demonstrations."""

    def __post_init__(self) -> None:
        check_fields(self, "validation", episodes=at_least(1), batches=at_least(1))


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """Closed-loop evaluation on unseen episodes."""

    episodes: int = 25
    """Unseen episodes a task, for eval.py."""
    episodes_while_training: int = 10
    """Unseen episodes a task, every `evaluate_every` steps."""

    def __post_init__(self) -> None:
        check_fields(self, "evaluation", episodes=at_least(1), episodes_while_training=at_least(1))


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How long a run trains, and what it does on the way."""

    steps: int = 1000
    """Training steps."""
    batch_size: int = 32
    """Examples a step, over all devices."""
    log_every: int = 20
    """Steps after which the numbers of a step are written, and at the end; 0 for the end alone."""
    checkpoint_every: int = 250
    """Steps after which a checkpoint is written, and at the end; 0 for the end alone."""
    max_skipped_steps: int = 10
    """Steps whose loss or gradient is not finite are skipped; a run with more of them stops."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment(Schedule):
    """Everything that decides the outcome of a run."""

    encoding: EncodingConfig
    """How an observation and a text become the network's inputs, and its answer an action."""
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    """Sizes and switches of the network; left as it is for a baseline that has a network of its own."""
    data: DataConfig = dataclasses.field(default_factory=DataConfig)
    """Simulated, imported or own demonstrations."""
    oxe: OxeConfig | None = None
    """Open X-Embodiment episodes to learn from instead of `data`."""
    optimizer: OptimizerConfig = OptimizerConfig()
    """AdamW and its schedule."""
    validation: ValidationConfig = ValidationConfig()
    """Comparison with held-out demonstrations."""
    evaluation: EvaluationConfig = EvaluationConfig()
    """Closed-loop episodes."""
    baseline: Baseline | None = None
    """Another policy than 3DS-VLA, which it is compared with (docs/policies.md)."""
    regime: Regime = "full"
    """`full` trains every parameter; `lora` trains the adapters and the projection, all else stays frozen."""
    base: str = ""
    """A finished run, or a folder of imported weights (docs/weights.md), whose parameters come in the place of random
    ones: the frozen base of the `lora` regime. Empty: all are random from the seed."""
    tokenizer: str = ""
    """A folder with the language model's vocabulary; empty: the words of the task suite."""
    gradient_accumulation: int = 1
    """Parts in which a batch is computed, one after the other: less memory, the same step."""
    mesh: MeshConfig = dataclasses.field(default_factory=MeshConfig)
    """How the devices share the work; the outcome is the same on any mesh."""
    fit_workspace: bool = False
    """Takes the workspace from the data instead of `encoding`: a box around all places of the hands, above the table.
    The run's config.json and policy.json hold it."""
    soft_target_sigma: float = 0.0
    """Bins: the width of the Gaussian that replaces one-hot targets on numbers; 0 is the paper's cross-entropy."""
    seed: int = 0
    """Seed of the initial parameters, the order of the data and all noise."""
    validate_every: int = 0
    """Steps after which answers are compared with held-out demonstrations, and at the end; 0 for never."""
    evaluate_every: int = 0
    """Steps after which the policy acts in episodes of the training tasks, and at the end; 0 for never."""
    keep_checkpoints: int = 2
    """The newest checkpoints that stay, besides the best one where steps are validated or evaluated."""

    @property
    def policy(self) -> PolicyConfig:
        """What its policy is made of, without what is found in the data."""
        return PolicyConfig(self.encoding, self.model, baseline=self.baseline)

    @property
    def keypoints(self) -> Literal["oracle", "segmentation"]:
        """Where a policy of this experiment gets its keypoints in simulation: from where it learned them."""
        return self.data.keypoints if self.encoding.use_keypoints else "oracle"

    def __post_init__(self) -> None:
        check_fields(
            self,
            "",
            steps=at_least(1),
            batch_size=at_least(1),
            log_every=at_least(0),
            checkpoint_every=at_least(0),
            max_skipped_steps=at_least(0),
            gradient_accumulation=at_least(1),
            soft_target_sigma=at_least(0),
            seed=at_least(0),
            validate_every=at_least(0),
            evaluate_every=at_least(0),
            keep_checkpoints=at_least(1),
        )
        if self.oxe is not None:
            require(bool(self.oxe.mixture), "oxe.mixture", "a named mixture or names of datasets", self.oxe.mixture)
        one_hot = self.soft_target_sigma == 0 or self.baseline is None
        require(one_hot, "soft_target_sigma", "0 for a policy that answers with poses", self.soft_target_sigma)
        if uses_model(self.baseline):
            require_same_sizes(self.encoding, self.model)
            self._require_as_many_cameras()
        else:
            self._require_no_model()
        adapters = self.regime == "full" or self.model.lora is not None
        require(adapters, "regime", "'full' without adapters", repr(self.regime), "give the config a model.lora")
        require(
            self.regime != "full" or self.model.base_dtype == "same",
            "model.base_dtype",
            "'same' with regime 'full', which trains all weights",
            repr(self.model.base_dtype),
            "use regime 'lora' for frozen weights",
        )

    @property
    def num_cameras(self) -> int:
        """C, of what is learned from."""
        return len(self.data.cameras) if self.oxe is None else 1

    def _require_as_many_cameras(self) -> None:
        """Raises UserError if the model was made for more or fewer cameras than the data have."""
        names = self.data.cameras if self.oxe is None else ("the only one",)
        require(
            self.model.cameras == len(names),
            "model.cameras",
            f"{len(names)}, as many as there are to learn from ({', '.join(names)})",
            self.model.cameras,
            f"use --model.cameras {len(names)}" + (", or other --data.cameras" if self.oxe is None else ""),
        )

    def _require_no_model(self) -> None:
        """Raises UserError for settings that a policy with a network of its own would ignore."""
        name = self.baseline and self.baseline.kind
        given = [f"model.{field}" for field in _differences(self.model, ModelConfig())]
        given += ["base"] * bool(self.base) + ["regime"] * (self.regime != "full")
        fix = "leave it out; the number of its cameras is that of data.cameras"
        require(not given, ", ".join(given), f"no such option for {name}, which has a network of its own", "one", fix)
        require(self.encoding.use_points, "encoding.use_points", f"true for {name}, which sees nothing else", "false")


# What may change when a run goes on: none of it changes what the run learns.
FREE_TO_CHANGE = (
    "mesh",
    "validation",
    "evaluation",
    "log_every",
    "validate_every",
    "evaluate_every",
    "checkpoint_every",
    "keep_checkpoints",
    "max_skipped_steps",
)


def outcome_differences(one: Experiment, other: Experiment) -> list[str]:
    """The fields that differ, of those that decide what a run learns; as on the command line, such as data.crop."""
    return [name for name in _differences(one, other) if name.split(".")[0] not in FREE_TO_CHANGE]


def _differences(one: object, other: object) -> list[str]:
    if type(one) is not type(other) or not dataclasses.is_dataclass(one):
        return []
    names = []
    for name, value in vars(one).items():
        if value != (against := getattr(other, name)):
            names += [f"{name}.{field}" for field in _differences(value, against)] or [name]
    return names


def save_experiment(path: Path, experiment: Experiment) -> None:
    """Writes the experiment as JSON: whole, or not at all."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(dataclasses.asdict(experiment), indent=2) + "\n")


def load_experiment(path: Path) -> Experiment:
    """Reads what `save_experiment` wrote. Raises UserError naming the file where it is not an experiment."""
    return read_config(path, Experiment, "an experiment")


def require_simulated(experiment: Experiment, run: Path) -> None:
    """Raises UserError for a run whose policy cannot act in the simulator."""
    if experiment.oxe is not None:
        raise UserError(
            f"{run}: learned from Open X-Embodiment, so its answers are poses in each robot's own frame, not in the "
            f"simulator's; finetune it on simulated tasks first: python train.py CONFIG --base {run}"
        )
