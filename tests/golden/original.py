"""Writes tiny random checkpoints in the files of OpenAI's CLIP, Meta's LLaMA and LLaMA-Adapter, and what they compute:
the oracle of tests/test_original.py. Needs torch, which the project does not install:

    python tests/golden/original.py        (seen with torch 2.14)

original/clip.pt: a TorchScript archive, float16. original/llama/: params.json and consolidated.00.pth, float16.
original/adapter.pth: projection, gates, adapters, biases and norms, bfloat16 and float32, with what a training script
    saves beside them. original/outputs.npz: for one image and one text.

The forward passes are written here from the papers' formulas, with complex numbers for the rotation and PyTorch's own
multi-head attention for CLIP, and not with this project's arrangement of the weights.
"""

import argparse
import json
import math
import zlib
from pathlib import Path

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]
from torch.nn.functional import softmax  # pyright: ignore[reportMissingImports]

HERE = Path(__file__).parent / "original"

IMAGE, PATCH, CLIP_WIDTH, CLIP_FFN, EMBED = 4, 2, 64, 16, 8
WIDTH, HEADS, LAYERS, FFN, VOCAB = 16, 2, 2, 44, 21
BLOCK_WIDTH, BLOCKS, BLOCK_HEADS, BLOCK_FFN, RANK = 12, 2, 3, 20, 2
TOKENS = 1 + (IMAGE // PATCH) ** 2


def draw(key: str, shape: tuple[int, ...]) -> torch.Tensor:
    """Values told by the name: matrices keep the size of what they are multiplied with, norms are near one."""
    values = np.random.RandomState(zlib.crc32(key.encode())).standard_normal(shape)
    if "norm" in key or "ln_" in key:
        values = 0.2 * values + key.endswith("weight")
    elif len(shape) > 1 and "embed" not in key and "gate" not in key:
        values = values / math.sqrt(np.prod(shape[1:]))
    return torch.from_numpy(values.astype(np.float32))


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.ln_1, self.ln_2 = nn.LayerNorm(CLIP_WIDTH), nn.LayerNorm(CLIP_WIDTH)
        self.attn = nn.MultiheadAttention(CLIP_WIDTH, CLIP_WIDTH // 64, batch_first=True)
        self.mlp = nn.ModuleDict({"c_fc": nn.Linear(CLIP_WIDTH, CLIP_FFN), "c_proj": nn.Linear(CLIP_FFN, CLIP_WIDTH)})

    def forward(self, x):
        y = self.ln_1(x)
        x = x + self.attn(y, y, y, need_weights=False)[0]
        hidden = self.mlp["c_fc"](self.ln_2(x))
        return x + self.mlp["c_proj"](hidden / (1 + torch.exp(-1.702 * hidden)))


class Visual(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(3, CLIP_WIDTH, PATCH, PATCH, bias=False)
        self.class_embedding = nn.Parameter(torch.zeros(CLIP_WIDTH))
        self.positional_embedding = nn.Parameter(torch.zeros(TOKENS, CLIP_WIDTH))
        self.ln_pre, self.ln_post = nn.LayerNorm(CLIP_WIDTH), nn.LayerNorm(CLIP_WIDTH)
        self.transformer = nn.ModuleDict({"resblocks": nn.ModuleList([Block()])})
        self.proj = nn.Parameter(torch.zeros(CLIP_WIDTH, EMBED))

    def forward(self, image):
        patches = self.conv1(image).flatten(2).transpose(1, 2)
        first = self.class_embedding.expand(len(image), 1, -1)
        x = self.ln_pre(torch.cat([first, patches], 1) + self.positional_embedding)
        for block in self.transformer["resblocks"]:
            x = block(x)
        return self.ln_post(x) @ self.proj


class Clip(nn.Module):
    def __init__(self):
        super().__init__()
        self.visual = Visual()
        self.token_embedding = nn.Embedding(3, 4)
        self.logit_scale = nn.Parameter(torch.zeros(()))

    def forward(self, image):
        return self.visual(image)


def rms(x, weight, epsilon):
    return x / torch.sqrt((x * x).mean(-1, keepdim=True) + epsilon) * weight


def turn(x, positions):
    """Heads (T, H, D): neighbouring numbers are one complex number, turned by position / 10000^(2i/D)."""
    pairs = torch.view_as_complex(x.reshape(*x.shape[:-1], -1, 2))
    count = pairs.shape[-1]
    angles = positions[:, None, None] * 10000.0 ** (-torch.arange(count, dtype=torch.float64) / count)
    return torch.view_as_real(pairs * torch.polar(torch.ones_like(angles), angles).to(pairs.dtype)).flatten(-2)


def layer(x, p, prefix, heads, epsilon, causal, prompt=None):
    """One layer over (T, width). p: parameters, adapters and biases used where there are any."""

    def linear(name, y, adapted=True):
        out = y @ p[f"{prefix}{name}.weight"].T
        out = out + p.get(f"{prefix}{name}.bias", 0)
        module, last = name.rsplit(".", 1)
        down = p.get(f"{prefix}{module}.lora_{last}_l1.weight")
        return (
            out + y @ down.T @ p[f"{prefix}{module}.lora_{last}_l2.weight"].T if adapted and down is not None else out
        )

    def heads_of(y):
        return y.reshape(len(y), heads, -1)

    def attend(query, key, value, mask):
        scores = torch.einsum("thd,shd->hts", query, key) / math.sqrt(query.shape[-1])
        return torch.einsum("hts,shd->htd", softmax(scores + mask, -1), value)

    length, positions = len(x), torch.arange(len(x))
    y = rms(x, p[prefix + "attention_norm.weight"], epsilon)
    query, key = (turn(heads_of(linear(f"attention.w{name}", y)), positions) for name in "qk")
    mask = torch.full((length, length), -torch.inf).triu(1) if causal else torch.zeros(length, length)
    out = attend(query, key, heads_of(linear("attention.wv", y)), mask)
    if prompt is not None:
        prompt_key, prompt_value = (heads_of(linear(f"attention.w{name}", prompt, adapted=False)) for name in "kv")
        gate = torch.tanh(p[prefix + "attention.gate"]).reshape(heads, 1, 1)
        out = out + gate * attend(query, prompt_key, prompt_value, torch.zeros(()))
    x = x + linear("attention.wo", out.transpose(0, 1).flatten(1))
    y = rms(x, p[prefix + "ffn_norm.weight"], epsilon)
    gate = linear("feed_forward.w1", y)
    return x + linear("feed_forward.w2", gate * torch.sigmoid(gate) * linear("feed_forward.w3", y))


def language(p, tokens, prompts=None):
    x = p["tok_embeddings.weight"][tokens]
    for index in range(LAYERS):
        x = layer(x, p, f"layers.{index}.", HEADS, 1e-6, True, None if prompts is None else prompts[index])
    return rms(x, p["norm.weight"], 1e-6) @ p["output.weight"].T


def projection(p, features):
    x = nn.functional.layer_norm(
        features @ p["clip_proj.weight"].T + p["clip_proj.bias"],
        (BLOCK_WIDTH,),
        p["clip_proj_norm.weight"],
        p["clip_proj_norm.bias"],
    )
    for index in range(BLOCKS):
        x = layer(x, p, f"visual_blocks.layers.{index}.", BLOCK_HEADS, 1e-5, False)
    x = rms(x, p["visual_blocks.norm.weight"], 1e-5) @ p["visual_blocks.output.weight"].T
    x = x @ p["visual_proj.weight"].T + p["visual_proj.bias"]
    x = nn.functional.layer_norm(x, (WIDTH,), p["visual_proj_norm.weight"], p["visual_proj_norm.bias"])
    return x + p["adapter_query.weight"].reshape(LAYERS, TOKENS, WIDTH)


def block_shapes(prefix, width, ffn):
    shapes = {f"{prefix}attention.w{name}.weight": (width, width) for name in "qkvo"}
    shapes |= {f"{prefix}feed_forward.w{i}.weight": (width, ffn) if i == 2 else (ffn, width) for i in (1, 2, 3)}
    return shapes | {f"{prefix}{name}_norm.weight": (width,) for name in ("attention", "ffn")}


def llama_shapes():
    shapes = {"tok_embeddings.weight": (VOCAB, WIDTH), "norm.weight": (WIDTH,), "output.weight": (VOCAB, WIDTH)}
    for index in range(LAYERS):
        shapes |= block_shapes(f"layers.{index}.", WIDTH, FFN)
    return shapes


def adapter_shapes():
    shapes = {"clip_proj.weight": (BLOCK_WIDTH, EMBED), "clip_proj.bias": (BLOCK_WIDTH,)}
    shapes |= {"visual_proj.weight": (WIDTH, BLOCK_WIDTH), "visual_proj.bias": (WIDTH,)}
    for name, width in (("clip_proj", BLOCK_WIDTH), ("visual_proj", WIDTH)):
        shapes |= {f"{name}_norm.{kind}": (width,) for kind in ("weight", "bias")}
    for index in range(BLOCKS):
        shapes |= block_shapes(f"visual_blocks.layers.{index}.", BLOCK_WIDTH, BLOCK_FFN)
    shapes |= {"visual_blocks.norm.weight": (BLOCK_WIDTH,), "visual_blocks.output.weight": (BLOCK_WIDTH,) * 2}
    shapes |= {"adapter_query.weight": (LAYERS * TOKENS, WIDTH), "llama.norm.weight": (WIDTH,)}
    for index in range(LAYERS):
        prefix = f"llama.layers.{index}."
        shapes |= {f"{prefix}{name}_norm.weight": (WIDTH,) for name in ("attention", "ffn")}
        shapes[f"{prefix}attention.gate"] = (1, HEADS, 1, 1)
        linear = {f"attention.w{name}": (WIDTH, WIDTH) for name in "qkvo"}
        linear |= {f"feed_forward.w{i}": (WIDTH, FFN) if i == 2 else (FFN, WIDTH) for i in (1, 2, 3)}
        for name, (out, inputs) in linear.items():
            module, last = name.rsplit(".", 1)
            shapes[f"{prefix}{module}.lora_{last}_l1.weight"] = (RANK, inputs)
            shapes[f"{prefix}{module}.lora_{last}_l2.weight"] = (out, RANK)
            if last not in ("wk", "wv"):
                shapes[f"{prefix}{name}.bias"] = (out,)
    return shapes


def main() -> None:
    (HERE / "llama").mkdir(parents=True, exist_ok=True)
    clip = Clip().eval()
    with torch.no_grad():
        for name, parameter in clip.named_parameters():
            parameter.copy_(draw(name, tuple(parameter.shape)).half().float())
    image = torch.from_numpy(np.random.RandomState(2).standard_normal((1, IMAGE, IMAGE, 3)).astype(np.float32))
    pixels = image.permute(0, 3, 1, 2)
    with torch.no_grad():
        features = clip(pixels)[0]
        torch.jit.trace(clip, pixels).half().save(str(HERE / "clip.pt"))

        llama = {key: draw(key, shape).half() for key, shape in llama_shapes().items()}
        saved = llama | {"rope.freqs": torch.ones(4).half()}
        torch.save(saved, HERE / "llama" / "consolidated.00.pth")
        sizes = {"dim": WIDTH, "multiple_of": 4, "n_heads": HEADS, "n_layers": LAYERS, "norm_eps": 1e-6}
        (HERE / "llama" / "params.json").write_text(json.dumps(sizes | {"vocab_size": -1}))

        adapter = {key: draw("adapter." + key, shape).bfloat16() for key, shape in adapter_shapes().items()}
        adapter |= {key: value.float() for key, value in adapter.items() if key.endswith("gate")}
        model = nn.Module()
        model.weight = nn.Parameter(torch.ones(3))
        optimizer = torch.optim.AdamW(model.parameters())
        with torch.enable_grad():
            model.weight.sum().backward()
        optimizer.step()
        whole = {"model": adapter, "optimizer": optimizer.state_dict(), "epoch": 3}
        torch.save(whole | {"args": argparse.Namespace(lr=0.1, seed=1)}, HERE / "adapter.pth")

        tokens = torch.from_numpy(np.random.RandomState(3).randint(0, VOCAB, 9))
        base = {key: value.float() for key, value in llama.items()}
        trained = {key: value.float() for key, value in adapter.items()}
        own = {key.removeprefix("llama."): value for key, value in trained.items() if key.startswith("llama.")}
        outputs = {
            "image": image,
            "features": features,
            "tokens": tokens,
            "logits": language(base, tokens),
            "adapted_logits": language(base | own, tokens, projection(trained, features)),
        }
    np.savez_compressed(HERE / "outputs.npz", **{key: value.numpy() for key, value in outputs.items()})


if __name__ == "__main__":
    main()
