"""The whole paper at a size that a laptop processor trains in minutes, from scratch.

What differs from the paper profile, and why, is in docs/architecture.md under "The tiny configuration".
"""

from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.model.config import LanguageConfig, ModelConfig, VisionConfig
from dsvla_jax.suite_vocabulary import suite_tokenizer

WIDTH = 128


def config() -> Experiment:
    return Experiment(
        encoding=EncodingConfig(
            image_size=96,
            patch_size=24,
            points=PointTokenizerConfig(num_points=256, group_sizes=(128, 64, 16), neighbours=8, width=WIDTH),
            style="compact",
            max_text_length=56,
        ),
        model=ModelConfig(
            vision=VisionConfig(image_size=96, patch_size=24, width=WIDTH, layers=3, heads=4),
            language=LanguageConfig(
                vocab_size=suite_tokenizer().vocab_size, width=WIDTH, layers=3, heads=4, kv_heads=4, ffn=352
            ),
            scan_unroll=3,
        ),
        data=DataConfig(
            episodes=100,
            shift_world=0.2,
            state_jitter=0.02,
            keypoint_noise=0.01,
            keypoint_noise_probability=0.2,
        ),
        optimizer=OptimizerConfig(learning_rate=2e-3),
        steps=800,
        batch_size=32,
        soft_target_sigma=1.5,
    )
