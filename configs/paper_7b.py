"""The paper's model and finetuning at full size: CLIP ViT-L/14 at 336 pixels, LLaMA-7B, LLaMA-Adapter's prompts.

Adapters in both towers and the projection learn (paper, section 3.1). For one accelerator with 80 GB. Needs, and names
when missing, LLaMA's vocabulary (`tokenizer`) and a folder of imported weights (`base`).

The paper states 10 epochs of 100 demonstrations a task at 336 pixels; batch size and optimizer are those of the
authors' released code: AdamW(0.9, 0.95), weight decay 0.05, learning rate 1e-4 batch / 256 with a cosine to zero, no
warm-up, no clipping. That rate was set for going on from their own checkpoint, so treat it as a start of a sweep.
"""

from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.experiment import Experiment, MeshConfig, OptimizerConfig
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig, VisualPromptConfig

EPOCHS, DEMONSTRATIONS, BATCH = 10, 100, 3
# One demonstration of each of the 26 tasks has so many keyframes together (docs/tasks.md).
KEY_POSES = 124


def config() -> Experiment:
    steps = EPOCHS * DEMONSTRATIONS * KEY_POSES // BATCH
    return Experiment(
        encoding=EncodingConfig(),  # 336 pixels, 2048 points to 576 tokens, 16 neighbours, 512 text tokens
        model=ModelConfig(
            vision=VisionConfig(embed_width=768),
            language=LanguageConfig(),
            fusion="adapter",
            visual_prompt=VisualPromptConfig(),
            lora=LoraConfig(rank=16, alpha=16.0),
            dtype="bfloat16",
            remat="full",
        ),
        # Nothing of the small configs' augmentation: the paper only adds noise to keypoints.
        data=DataConfig(folder="data/demos_336", tasks=("all",), episodes=DEMONSTRATIONS, image_size=336, perturb=0.0),
        optimizer=OptimizerConfig(
            learning_rate=1e-4 * BATCH / 256, warmup_steps=0, weight_decay=0.05, gradient_clip=float("inf")
        ),
        regime="lora",
        base="bases/paper_7b",
        tokenizer="tokenizers/llama",
        mesh=MeshConfig(data=1, fsdp=-1),
        steps=steps,
        batch_size=BATCH,
        checkpoint_every=1000,
    )
