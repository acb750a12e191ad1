"""Answers over LLaMA's own vocabulary: ids, token counts, the grammar of numbers (1 minute, npm and node).

Usage: python -m benchmarks.llama_tokens [--out FOLDER]

Fetches llama-tokenizer-js 1.2.2 (MIT, which holds the vocabulary) with npm into a temporary folder, makes a
tokenizer.json of it, and compares with what the package itself encodes. --out keeps the tokenizer's folder, for
--tokenizer of other programs; LLaMA's vocabulary is its owners' and is not part of this project. Exits with 77 where
npm can not fetch it.
"""

import dataclasses
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tokenizers import Tokenizer, decoders, models, normalizers

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.encode import encode_text
from dsvla_jax.encoding.grammar import SEPARATOR, build_answer_grammar
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.prompts import STYLES, format_answer, format_prompt
from dsvla_jax.model.integer_trie import integer_trie
from dsvla_jax.sim.tasks import TASKS

PACKAGE = "llama-tokenizer-js@1.2.2"
DIGITS = [29900, 29896, 29906, 29941, 29946, 29945, 29953, 29955, 29947, 29929]
LONGEST = 512
UNAVAILABLE = 77
DUMP = """
import fs from "fs";
import llama from "./package/llama-tokenizer.js";
const merges = [...llama.merges.entries()].sort((a, b) => a[1] - b[1]).map((entry) => entry[0]);
const texts = JSON.parse(fs.readFileSync("texts.json"));
fs.writeFileSync("dump.json", JSON.stringify({
  vocabulary: llama.vocabById, merges, encoded: texts.map((text) => llama.encode(text)) }));
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to keep."""

    out: Path | None = None
    """A new folder for the tokenizer, as a checkpoint's."""


def examples() -> list[tuple[str, np.ndarray, str, str]]:
    """Style, integers, prompt and answer of every task, with random poses."""
    rng, codec, found = np.random.default_rng(0), PoseCodec(), []
    for task in TASKS.values():
        for style in STYLES:
            size = (task.num_arms, 1)
            position = rng.uniform([-1.0, -1.0, 0.0], [1.0, 1.0, 2.0], (task.num_arms, 3))
            pose = np.concatenate([position, rng.normal(size=(task.num_arms, 4))], axis=1)
            integers = np.asarray(codec.encode(pose, rng.integers(0, 2, size)[:, 0]))
            instruction = max(task.all_instructions(), key=len)
            prompt = format_prompt(instruction, integers, integers[:, :3], style)
            found.append((style, integers, prompt, format_answer(integers, style)))
    return found


def fetch(folder: Path, texts: list[str]) -> dict[str, Any] | None:
    """The package's vocabulary, merges and own encoding of the texts; None where it can not be had."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        return None
    packed = subprocess.run(["npm", "pack", "--silent", PACKAGE], cwd=folder, capture_output=True, text=True)
    if packed.returncode:
        return None
    shutil.unpack_archive(folder / packed.stdout.split()[-1], folder)
    (folder / "texts.json").write_text(json.dumps(texts))
    (folder / "dump.mjs").write_text(DUMP)
    subprocess.run(["node", "dump.mjs"], cwd=folder, check=True)
    return json.loads((folder / "dump.json").read_text())


def write_tokenizer(folder: Path, dump: dict[str, Any]) -> None:
    """The folder of a LLaMA checkpoint's tokenizer: SentencePiece's BPE as the `tokenizers` library writes it."""
    vocabulary = {piece: number for number, piece in enumerate(dump["vocabulary"])}
    merges = [tuple(merge.split(" ")) for merge in dump["merges"]]
    tokenizer = Tokenizer(models.BPE(vocabulary, merges, unk_token="<unk>", fuse_unk=True, byte_fallback=True))
    tokenizer.normalizer = normalizers.Sequence([normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")])
    tokenizer.decoder = decoders.Sequence(
        [decoders.Replace("▁", " "), decoders.ByteFallback(), decoders.Fuse(), decoders.Strip(" ", 1, 0)]
    )
    tokenizer.add_special_tokens(["<unk>", "<s>", "</s>"])
    folder.mkdir(parents=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    (folder / "tokenizer_config.json").write_text(json.dumps({"bos_token": "<s>", "eos_token": "</s>"}) + "\n")


def main(options: Options) -> int:
    found = examples()
    with tempfile.TemporaryDirectory() as temporary:
        dump = fetch(Path(temporary), [prompt + SEPARATOR + answer for _, _, prompt, answer in found])
        if dump is None:
            print(f"{PACKAGE} can not be fetched: npm and node are needed, and a registry in reach", file=sys.stderr)
            return UNAVAILABLE
        folder = options.out or Path(temporary) / "llama"
        write_tokenizer(folder, dump)
        tokenizer = load_tokenizer(folder)
    wrong = 0
    for (style, integers, prompt, answer), encoded in zip(found, dump["encoded"], strict=True):
        text, answered = encode_text(tokenizer, prompt, answer, 2 * LONGEST)
        wrong += text.tokens[text.mask].tolist() != [*encoded, tokenizer.eos_id]
        grammar = build_answer_grammar(tokenizer, len(integers), style)
        wrong += grammar.tokens(integers) != text.tokens[answered].tolist()
    print(f"{len(found)} prompts with answers: {wrong} differ from {PACKAGE}'s tokens or from the grammar's")
    print(f"digits 0 to 9: {[tokenizer.encode(f'a{digit}')[-1] for digit in range(10)]}")
    wrong += [tokenizer.encode(f"a{digit}")[-1] for digit in range(10)] != DIGITS
    counts: dict[tuple[int, str], list[tuple[int, int]]] = {}
    for style, integers, prompt, answer in found:
        text, answered = encode_text(tokenizer, prompt, answer, 2 * LONGEST)
        asked = int(text.mask.sum() - answered.sum())
        counts.setdefault((len(integers), style), []).append((asked, int(answered.sum())))
    for (arms, style), lengths in sorted(counts.items()):
        asked, answered = (f"{min(column)} to {max(column)}" for column in zip(*lengths, strict=True))
        print(f"{style}, {arms} arm(s): prompts of {asked} tokens with begin, answers of {answered} with end")
        wrong += max(map(sum, lengths)) > LONGEST
        grammar = build_answer_grammar(tokenizer, arms, style)
        read = [len(integer_trie(slot).branches.tokens) for slot in grammar.slots[:8]]
        print(f"  branches of an arm's number trees: {read}")
    return int(wrong > 0)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
