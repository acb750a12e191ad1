"""Writes what `transformers` computes with tiny random LLaMA decoders and CLIP vision towers: the oracle of
tests/test_backbones.py and tests/test_weights.py. Needs torch and transformers, which the project does not install:

    python tests/golden/backbones.py        (seen with transformers 5.23, torch 2.14)

backbones.json: of each case the config.json and the names and shapes of the parameters. Their values are drawn from the
    names (`draw`), so that none need to be kept.
backbones.npz: inputs and outputs of each case; the images are drawn (`draw_image`).
llama_sharded/, clip/: checkpoints as `save_pretrained` writes them, in bfloat16 shards and one float16 file.
"""

import json
import zlib
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent

LLAMAS = {
    "plain": {"hidden_size": 32, "num_attention_heads": 4, "intermediate_size": 44, "vocab_size": 37},
    "grouped_tied": {
        "hidden_size": 42,
        "num_attention_heads": 7,
        "num_key_value_heads": 1,
        "intermediate_size": 29,
        "vocab_size": 53,
        "tie_word_embeddings": True,
        "rms_norm_eps": 1e-5,
    },
    "head_dim": {
        "hidden_size": 18,
        "num_attention_heads": 6,
        "num_key_value_heads": 3,
        "head_dim": 10,
        "intermediate_size": 33,
        "vocab_size": 31,
        "rope_parameters": {"rope_type": "default", "rope_theta": 50.0},
    },
    "llama3": {
        "hidden_size": 32,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "intermediate_size": 40,
        "vocab_size": 29,
        "tie_word_embeddings": True,
        "max_position_embeddings": 320,
        # All three bands are met: wavelengths from 6 to 16,000 around a context of 40.
        "rope_parameters": {
            "rope_type": "llama3",
            "rope_theta": 10000.0,
            "factor": 8.0,
            "low_freq_factor": 1.0,
            "high_freq_factor": 4.0,
            "original_max_position_embeddings": 40,
        },
    },
}
CLIPS = {
    "odd_grid": {
        "hidden_size": 24,
        "num_attention_heads": 3,
        "intermediate_size": 37,
        "image_size": 15,
        "patch_size": 5,
    },
    "one_patch_row": {
        "hidden_size": 16,
        "num_attention_heads": 2,
        "intermediate_size": 64,
        "image_size": 14,
        "patch_size": 7,
        "layer_norm_eps": 1e-3,
    },
}
RESAMPLED_TO = {"odd_grid": (35, 10), "one_patch_row": (35,)}


def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The values of a parameter, float32: scales about 1, biases about 0, rows of unit size."""
    random = np.random.RandomState(zlib.crc32(name.encode()))  # a frozen stream, unlike Generator's
    values = np.asarray(random.standard_normal(shape))
    if len(shape) == 1 and "embedding" not in name:
        values = 0.2 * values + name.endswith("weight")
    elif "embed" not in name:
        values = values / np.sqrt(np.prod(shape[1:]))
    return np.asarray(values, np.float32)


def padded_batch(vocab: int, length: int) -> dict[str, np.ndarray]:
    """Three rows: full, padded behind, padded in front. Positions count the real tokens."""
    tokens = np.random.RandomState(1).randint(0, vocab, (3, length))
    mask = np.ones((3, length), bool)
    mask[1, length * 2 // 3 :] = False
    mask[2, : length // 3] = False
    return {"tokens": tokens, "mask": mask, "positions": np.maximum(np.cumsum(mask, 1) - 1, 0)}


def draw_image(size: int) -> np.ndarray:
    """Two images, float32 (2, size, size, 3)."""
    return np.random.RandomState(2).standard_normal((2, size, size, 3)).astype(np.float32)


def main() -> None:
    import torch  # pyright: ignore[reportMissingImports]
    from transformers import (  # pyright: ignore[reportMissingImports]
        CLIPConfig,
        CLIPModel,
        CLIPTextConfig,
        CLIPVisionConfig,
        CLIPVisionModel,
        LlamaConfig,
        LlamaForCausalLM,
    )

    def fill(model):
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                parameter.copy_(torch.from_numpy(draw(name, tuple(parameter.shape))))
        return model.eval()

    def language_outputs(model, tokens, mask, positions):
        hidden = model.model(
            input_ids=torch.from_numpy(tokens),
            attention_mask=torch.from_numpy(mask).long(),
            position_ids=torch.from_numpy(positions),
        ).last_hidden_state
        return {"hidden": hidden.numpy(), "logits": model.lm_head(hidden).numpy()}

    def vision_outputs(model, image, interpolate):
        pixels = torch.from_numpy(image).permute(0, 3, 1, 2)
        last = model(pixels, interpolate_pos_encoding=interpolate).last_hidden_state
        return model.post_layernorm(last).numpy()

    cases, arrays = {}, {}

    def record(name, model, values):
        shapes = {key: list(parameter.shape) for key, parameter in model.named_parameters()}
        cases[name] = {"config": json.loads(model.config.to_json_string()), "shapes": shapes}
        arrays.update({f"{name}.{key}": value for key, value in values.items()})

    with torch.no_grad():
        for name, options in LLAMAS.items():
            config = LlamaConfig(**options, num_hidden_layers=2, attn_implementation="eager")
            model = fill(LlamaForCausalLM(config))
            batch = padded_batch(config.vocab_size, 50 if name == "llama3" else 11)
            record(name, model, batch | language_outputs(model, **batch))
        for name, options in CLIPS.items():
            model = fill(CLIPVisionModel(CLIPVisionConfig(**options, num_hidden_layers=3, attn_implementation="eager")))
            sizes = (options["image_size"], *RESAMPLED_TO[name])
            values = {f"output_{size}": vision_outputs(model, draw_image(size), size != sizes[0]) for size in sizes}
            record(name, model, values)

        small = {"hidden_size": 16, "num_attention_heads": 2, "num_hidden_layers": 2, "intermediate_size": 24}
        language = fill(LlamaForCausalLM(LlamaConfig(**small, num_key_value_heads=1, vocab_size=21)))
        language.to(torch.bfloat16).save_pretrained(HERE / "llama_sharded", max_shard_size="4KB")
        (HERE / "llama_sharded" / "generation_config.json").unlink()
        batch = padded_batch(21, 7)
        # Read back, because the cast above rounded the rotary frequencies too.
        language = LlamaForCausalLM.from_pretrained(HERE / "llama_sharded", dtype=torch.float32).eval()
        values = batch | language_outputs(language, **batch)
        arrays.update({f"llama_sharded.{key}": value for key, value in values.items()})

        text = CLIPTextConfig(**small, vocab_size=20, max_position_embeddings=8)
        vision = CLIPVisionConfig(**small, image_size=9, patch_size=3)
        clip = fill(CLIPModel(CLIPConfig(text_config=text.to_dict(), vision_config=vision.to_dict(), projection_dim=8)))
        clip.to(torch.float16).save_pretrained(HERE / "clip")
        output = vision_outputs(clip.to(torch.float32).vision_model, draw_image(9), False)
        projected = clip.visual_projection(torch.from_numpy(output)).numpy()
        arrays.update({"clip.output_9": output, "clip.projected_9": projected})

    (HERE / "backbones.json").write_text(json.dumps(cases) + "\n")
    np.savez_compressed(HERE / "backbones.npz", **arrays)


if __name__ == "__main__":
    main()
