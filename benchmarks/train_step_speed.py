"""A float32 training step of 25 M parameters takes a CPU no longer than PyTorch with transformers and peft (5 minutes).

Usage: python -m benchmarks.train_step_speed [lora] [full]. Needs torch, transformers and peft (see `make parity`).
Both do forward, backward and AdamW on the same weights and batch, with the same number of threads, by turns; the
fastest step of each counts. First the losses and the updated weights of a few steps are compared.
"""

import dataclasses
import os
import sys
import time
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch  # pyright: ignore[reportMissingImports]

from benchmarks._torch_peer import TorchVLA, as_torch, torch_inputs
from dsvla_jax.command_line import configure_jax, keep_freed_memory
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig
from dsvla_jax.model.variables import Regime, join_variables, split_variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import ModelInputs, Text

CONFIG = ModelConfig(
    vision=VisionConfig(image_size=224, patch_size=14, width=384, layers=6, heads=6),
    language=LanguageConfig(vocab_size=4096, width=384, layers=6, heads=6, kv_heads=6, ffn=1024, tie_embeddings=True),
    lora=LoraConfig(rank=16, alpha=32.0),
    scan_unroll=6,
)
BATCH, POINTS, TEXT, ANSWER = 4, 64, 64, 16
# Large enough an epsilon that Adam's first steps do not blow up the last digit of a gradient near zero.
SETTINGS: dict[str, Any] = {"b1": 0.9, "b2": 0.95, "eps": 1e-4, "weight_decay": 0.05}
RATE, ROUNDS = 1e-3, 10


def make_inputs() -> tuple[ModelInputs, jax.Array]:
    """A batch, and which of its text is to be learnt."""
    rng = np.random.default_rng(0)
    vision, size = CONFIG.vision, CONFIG.vision.image_size
    inputs = ModelInputs(
        images=jnp.asarray(rng.normal(size=(BATCH, 1, size, size, 3)), jnp.float32),
        point_tokens=jnp.asarray(rng.normal(size=(BATCH, POINTS, vision.width)), jnp.float32),
        point_patches=jnp.asarray(rng.integers(0, vision.num_patches, (BATCH, POINTS)), jnp.int32),
        text=Text(
            jnp.asarray(rng.integers(0, CONFIG.language.vocab_size, (BATCH, TEXT)), jnp.int32),
            jnp.ones((BATCH, TEXT), bool),
        ),
    )
    return inputs, jnp.broadcast_to(jnp.arange(TEXT) >= TEXT - ANSWER, (BATCH, TEXT))


class OurStep:
    """One call is one training step."""

    def __init__(self, config: ModelConfig, variables: Any, regime: Regime):
        model, (inputs, answer) = VLA(config), make_inputs()
        trainable, self.frozen = split_variables(jax.tree.map(jnp.copy, variables), regime)
        optimizer = optax.adamw(RATE, **SETTINGS)
        self.state = trainable, optimizer.init(trainable)

        def step(state: Any, frozen: Any, inputs: ModelInputs):
            trainable, optimizer_state = state

            def loss_of(trainable: Any):
                logits: Any = model.apply(join_variables(trainable, frozen), inputs)
                losses = optax.softmax_cross_entropy_with_integer_labels(logits[:, :-1], inputs.text.tokens[:, 1:])
                return jnp.where(answer[:, 1:], losses, 0.0).sum() / answer[:, 1:].sum()

            loss, gradients = jax.value_and_grad(loss_of)(trainable)
            updates, optimizer_state = optimizer.update(gradients, optimizer_state, trainable)
            return (optax.apply_updates(trainable, updates), optimizer_state), loss

        self.inputs, self.step = inputs, jax.jit(step, donate_argnums=0)

    def __call__(self) -> float:
        self.state, loss = self.step(self.state, self.frozen, self.inputs)
        jax.block_until_ready(self.state)
        return float(loss)

    def trained(self) -> dict[str, np.ndarray]:
        return as_torch(join_variables(self.state[0], self.frozen))


class TheirStep:
    """The same in PyTorch, as it runs without compiling."""

    def __init__(self, config: ModelConfig, variables: Any, regime: Regime):
        inputs, answer = make_inputs()
        self.model = TorchVLA(config, variables).train()
        self.inputs, self.answer = torch_inputs(inputs), torch.from_numpy(np.array(answer))
        parameters = [p for p in self.model.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(
            parameters, RATE, (SETTINGS["b1"], SETTINGS["b2"]), SETTINGS["eps"], SETTINGS["weight_decay"]
        )

    def __call__(self) -> float:
        self.optimizer.zero_grad()
        loss = self.model.loss(self.inputs, self.answer)
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())

    def trained(self) -> dict[str, np.ndarray]:
        return {name: p.detach().numpy() for name, p in self.model.named_parameters()}


def largest_difference(ours: OurStep, theirs: TheirStep) -> float:
    """Of what the steps changed, relative to how far a step goes."""
    a, b = ours.trained(), theirs.trained()
    # A key's bias moves no attention: its gradient is rounding noise, which Adam blows up.
    return max(float(np.abs(a[name] - b[name]).max()) / RATE for name in a if not name.endswith("k_proj.bias"))


def compare(regime: Regime) -> float:
    """Our fastest step as a share of theirs; NaN where the two do not compute the same."""
    config = dataclasses.replace(CONFIG, lora=CONFIG.lora if regime == "lora" else None)
    variables = initialize(config, jax.random.key(0))
    ours, theirs = OurStep(config, variables, regime), TheirStep(config, variables, regime)
    learn, everything = (sum(leaf.size for leaf in jax.tree.leaves(tree)) for tree in (ours.state[0], variables))
    losses = [(ours(), theirs()) for _ in range(2)]
    error = max(abs(a - b) / b for a, b in losses)
    moved = largest_difference(ours, theirs)
    print(
        f"{regime}: {learn:,} of {everything:,} parameters learn; losses differ by {error:.1e}, weights by {moved:.1e}"
    )
    if error > 1e-4 or moved > 0.1:
        return float("nan")
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for side, step in zip(times, (ours, theirs), strict=True):
            start = time.perf_counter()
            step()
            side.append(time.perf_counter() - start)
    fastest, medians = [min(side) for side in times], [float(np.median(side)) for side in times]
    print(
        f"{regime}: {fastest[0]:.2f} s a step (median {medians[0]:.2f}), PyTorch {fastest[1]:.2f} ({medians[1]:.2f}): "
        f"{fastest[0] / fastest[1]:.2f} of its time (at most 1)"
    )
    return fastest[0] / fastest[1]


if __name__ == "__main__":
    keep_freed_memory()  # as train.py does
    configure_jax()
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    chosen = sys.argv[1:] or ["lora", "full"]
    ratios = [compare(regime) for regime in get_args(Regime) if regime in chosen]
    sys.exit(not all(ratio <= 1 for ratio in ratios))
