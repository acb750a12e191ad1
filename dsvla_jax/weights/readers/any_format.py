"""Which reader a source needs."""

from pathlib import Path

from dsvla_jax.model.config import LanguageConfig, VisionConfig
from dsvla_jax.weights.readers import gguf, hugging_face, llama_consolidated, openai_clip
from dsvla_jax.weights.readers.peft import refuse_peft_adapter
from dsvla_jax.weights.towers import Tower, resample


def read_language(source: Path) -> Tower[LanguageConfig]:
    """The LLaMA decoder of a Hugging Face folder, one of Meta's (params.json), or a GGUF file.

    Raises WeightsError naming file and key where anything is missing, damaged, left over, or of another architecture.
    """
    refuse_peft_adapter(source)
    if source.suffix == ".gguf":
        return gguf.read_language(source)
    if (source / llama_consolidated.PARAMS).is_file():
        return llama_consolidated.read_language(source)
    return hugging_face.read_language(source)


def read_vision(source: Path, image_size: int | None = None, projection: bool = False) -> Tower[VisionConfig]:
    """The CLIP vision tower of a Hugging Face folder, or of one of OpenAI's files.

    image_size: pixels; None for the checkpoint's own. Positional embeddings are resampled to another size's grid.
    projection: read the projection into CLIP's joint embedding too. Raises WeightsError as `read_language` does.
    """
    refuse_peft_adapter(source)
    read = openai_clip.read_vision if source.is_file() else hugging_face.read_vision
    tower = read(source, projection)
    return tower if image_size in (None, tower.config.image_size) else resample(tower, image_size, source)
