"""The tokenizers of real language models, and the folder in which any tokenizer is kept.

A tokenizer's folder is that of a Hugging Face checkpoint: `tokenizer.json` (the `tokenizers` library's) or
`tokenizer.model` (SentencePiece's), with `tokenizer_config.json`, `special_tokens_map.json`, `config.json` or
`generation_config.json` to say which tokens begin and end a text. A word vocabulary is a `tokenizer.json` of its own.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import sentencepiece
import tokenizers

from dsvla_jax.encoding.text import Tokenizer, WordTokenizer
from dsvla_jax.errors import UserError

# Embeddings have more rows than the vocabulary has tokens where their number was rounded up, by fewer than so many.
PADDING_ROWS = 1024
_NAMES = ("tokenizer_config.json", "special_tokens_map.json")  # name special tokens by their text
_NUMBERS = ("config.json", "generation_config.json")  # by their number


@dataclasses.dataclass(frozen=True)
class HuggingFaceTokenizer:
    """A tokenizer of the `tokenizers` library, with nothing added to a text and no special token read out of it.

    content: the text of tokenizer.json.
    """

    content: str
    bos_id: int
    eos_id: int
    pad_id: int

    # A vocabulary of real size has no token of which the number's value alone says what it means.
    number_values = None

    @functools.cached_property
    def _tokenizer(self) -> tokenizers.Tokenizer:
        tokenizer = tokenizers.Tokenizer.from_str(self.content)
        tokenizer.no_padding()
        tokenizer.no_truncation()
        tokenizer.encode_special_tokens = True  # "</s>" in an instruction is text, not the end of it
        return tokenizer

    @functools.cached_property
    def _vocab_size(self) -> int:
        return max(self._tokenizer.get_vocab(with_added_tokens=True).values()) + 1

    @property
    def vocab_size(self) -> int:
        """See `Tokenizer`."""
        return self._vocab_size

    def encode(self, text: str) -> list[int]:
        """See `Tokenizer`."""
        return self._tokenizer.encode(text, add_special_tokens=False).ids

    def decode(self, tokens: Sequence[int]) -> str:
        """See `Tokenizer`."""
        return self._tokenizer.decode([int(token) for token in tokens], skip_special_tokens=True)

    def save(self, folder: Path) -> None:
        """Writes a tokenizer's folder."""
        (folder / "tokenizer.json").write_text(self.content, encoding="utf-8")
        names = {"bos_token": self.bos_id, "eos_token": self.eos_id, "pad_token": self.pad_id}
        texts = {name: self._tokenizer.id_to_token(number) for name, number in names.items()}
        (folder / "tokenizer_config.json").write_text(json.dumps(texts, indent=1) + "\n", encoding="utf-8")

    def __getstate__(self) -> dict[str, object]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


@dataclasses.dataclass(frozen=True)
class SentencePieceTokenizer:
    """A SentencePiece model. content: the bytes of tokenizer.model, which also says what begins and ends a text."""

    content: bytes

    number_values = None

    @functools.cached_property
    def _model(self) -> sentencepiece.SentencePieceProcessor:
        return sentencepiece.SentencePieceProcessor(model_proto=self.content)

    @property
    def vocab_size(self) -> int:
        """See `Tokenizer`."""
        return self._model.vocab_size()

    @property
    def bos_id(self) -> int:
        """See `Tokenizer`."""
        return self._model.bos_id()

    @property
    def eos_id(self) -> int:
        """See `Tokenizer`."""
        return self._model.eos_id()

    @property
    def pad_id(self) -> int:
        """See `Tokenizer`."""
        return self._model.pad_id() if self._model.pad_id() >= 0 else self.eos_id

    def encode(self, text: str) -> list[int]:
        """See `Tokenizer`."""
        return self._model.encode(text)

    def decode(self, tokens: Sequence[int]) -> str:
        """See `Tokenizer`."""
        # The library writes nothing for control tokens, but would write " ⁇ " for the unknown one, as it should.
        return self._model.decode([int(token) for token in tokens])

    def save(self, folder: Path) -> None:
        """Writes a tokenizer's folder."""
        (folder / "tokenizer.model").write_bytes(self.content)

    def __getstate__(self) -> dict[str, object]:
        return {"content": self.content}


def load_tokenizer(folder: str | Path) -> Tokenizer:
    """The tokenizer of a folder (see the module's text); raises UserError where there is none that can be read."""
    folder = Path(folder)
    file, model = folder / "tokenizer.json", folder / "tokenizer.model"
    if file.exists():
        return _load_json(folder, file)
    if model.exists():
        return _load_sentencepiece(model)
    raise UserError(
        f"tokenizer: {file} is missing, and so is tokenizer.model; expected the vocabulary that the language model was "
        "trained with: put it there, or name its folder with --tokenizer"
    )


def save_tokenizer(tokenizer: Tokenizer, folder: Path) -> None:
    """Writes a folder from which `load_tokenizer` reads the same tokenizer, whatever kind it is."""
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(folder)


def fits_rows(tokenizer: Tokenizer, rows: int) -> bool:
    """Whether an embedding of so many rows can be of the tokenizer: one a token, and few that only fill up."""
    return tokenizer.vocab_size <= rows < tokenizer.vocab_size + PADDING_ROWS


def vocabulary_digest(tokenizer: Tokenizer) -> str:
    """SHA-256 of all that makes the tokenizer what it is: equal where the vocabulary is, on every machine."""
    digest = hashlib.sha256(type(tokenizer).__name__.encode())
    for field in dataclasses.fields(tokenizer):  # pyright: ignore[reportArgumentType]
        value = getattr(tokenizer, field.name)
        digest.update(value if isinstance(value, bytes) else json.dumps(value).encode())
    return digest.hexdigest()


def _load_json(folder: Path, file: Path) -> Tokenizer:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"tokenizer: {file}: expected JSON; the file is damaged ({error})") from error
    if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
        try:
            return WordTokenizer.load(file)
        except ValueError as error:
            raise UserError(f"tokenizer: {error}; nor is it a file of the `tokenizers` library") from error
    text = file.read_text(encoding="utf-8")
    try:
        tokenizer = tokenizers.Tokenizer.from_str(text)
    except Exception as error:  # the library raises nothing more specific
        raise UserError(f"tokenizer: {file}: the `tokenizers` library can not read it: {error}") from error
    eos = _special_token(folder, tokenizer, "eos")
    if eos is None:
        raise UserError(
            f"tokenizer: {folder}: no file says which token ends a text; expected eos_token in one of "
            f"{', '.join(_NAMES)}, or eos_token_id in one of {', '.join(_NUMBERS)}: copy them from the checkpoint"
        )
    # Vocabularies without a token of their own for it begin a text, and pad it, with the one that ends it.
    bos, pad = (_special_token(folder, tokenizer, name) for name in ("bos", "pad"))
    return HuggingFaceTokenizer(text, eos if bos is None else bos, eos, eos if pad is None else pad)


def _special_token(folder: Path, tokenizer: tokenizers.Tokenizer, name: str) -> int | None:
    for file in (folder / name for name in (*_NAMES, *_NUMBERS)):
        if not file.exists():
            continue
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise UserError(f"tokenizer: {file}: expected JSON; the file is damaged ({error})") from error
        text: str | dict[str, str] | None = content.get(f"{name}_token")
        number: int | list[int] | None = content.get(f"{name}_token_id")
        text = text.get("content") if isinstance(text, dict) else text
        number = next(iter(number), None) if isinstance(number, list) else number
        if text is not None:
            number = tokenizer.token_to_id(text)
            if number is None:
                raise UserError(f"tokenizer: {file}: {name}_token {text!r} is not in the vocabulary of tokenizer.json")
        if number is not None:
            if tokenizer.id_to_token(number) is None:
                raise UserError(f"tokenizer: {file}: {name}_token_id {number} is no token of tokenizer.json")
            return number
    return None


def _load_sentencepiece(file: Path) -> SentencePieceTokenizer:
    tokenizer = SentencePieceTokenizer(file.read_bytes())
    try:
        bos, eos = tokenizer.bos_id, tokenizer.eos_id
    except RuntimeError as error:
        raise UserError(f"tokenizer: {file}: not a SentencePiece model, or a damaged one") from error
    if bos < 0 or eos < 0:
        raise UserError(
            f"tokenizer: {file}: the model was trained without a token that begins or ends a text "
            f"(bos_id {bos}, eos_id {eos}); expected both"
        )
    return tokenizer
