"""Pretrained language weights in simulation: SmolLM2-135M under the vision tower and point tokens of `tiny`.

All of it learns: the vision tower starts from random numbers, so a frozen one would see nothing. The folder of the
checkpoint is the vocabulary, and what is imported from it the base (docs/weights.md):

    python -m dsvla_jax.weights import SmolLM2-135M bases/smollm2
    python train.py smollm2_sim --tokenizer SmolLM2-135M
"""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.model.config import LanguageConfig


def config() -> Experiment:
    base = tiny.config()
    language = LanguageConfig(
        vocab_size=49152,
        width=576,
        layers=30,
        heads=9,
        kv_heads=3,
        ffn=1536,
        rope_theta=100000.0,
        norm_eps=1e-5,
        tie_embeddings=True,
    )
    return replace(
        base,
        # Signs and digits are tokens of their own in this vocabulary.
        encoding=replace(base.encoding, max_text_length=256),
        model=replace(base.model, language=language, scan_unroll=1, remat="full"),
        optimizer=OptimizerConfig(learning_rate=3e-4),
        base="bases/smollm2",
        tokenizer="SmolLM2-135M",
        steps=2000,
        batch_size=32,
    )
