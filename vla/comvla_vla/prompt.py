"""From a spoken-language instruction to token ids."""

from __future__ import annotations

from functools import lru_cache

from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Punctuation, WhitespaceSplit
from tokenizers.pre_tokenizers import Sequence as PreTokenizers

from comvla.errors import InstructionError
from comvla_vla.config import PromptConfig

UNKNOWN, BOS, STOP = "<unk>", "<s>", "</s>"


def word_tokenizer(words: list[str]) -> Tokenizer:
    """A closed vocabulary of whole words for small policies; ids 0 to 2 are unknown, begin and stop."""
    vocabulary = {token: i for i, token in enumerate([UNKNOWN, BOS, STOP, *sorted(set(words))])}
    tokenizer = Tokenizer(WordLevel(vocabulary, unk_token=UNKNOWN))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = PreTokenizers([WhitespaceSplit(), Punctuation("removed")])
    return tokenizer


class Prompt:
    """Builds and checks the prompt of one model."""

    def __init__(self, config: PromptConfig, tokenizer: Tokenizer) -> None:
        self.config = config
        self.tokenizer = tokenizer
        self._cached_ids = lru_cache(maxsize=256)(self._ids)

    def ids(self, instruction: str) -> tuple[int, ...]:
        """Prompt ids of an instruction, begin-of-sequence first.

        Raises:
            InstructionError: empty, not text, longer than the model's prompt, or with words a closed
                vocabulary does not hold.
        """
        if not isinstance(instruction, str):
            raise InstructionError(f"an instruction is a string, got {type(instruction).__name__}")
        return self._cached_ids(instruction)

    def _ids(self, instruction: str) -> tuple[int, ...]:
        text = " ".join(instruction.split())
        if not text:
            raise InstructionError("the instruction is empty: say what the robot should do")
        if self.config.lowercase:
            text = text.lower()
        encoding = self.tokenizer.encode(
            self.config.template.format(instruction=text), add_special_tokens=False
        )
        if self.config.unknown_words == "error":
            self._refuse_unknown(encoding.ids, encoding.offsets, text)
        ids = [self.config.bos_id, *encoding.ids]
        if self.config.trailing_id is not None and ids[-1] != self.config.trailing_id:
            ids.append(self.config.trailing_id)
        if len(ids) > self.config.max_tokens:
            raise InstructionError(
                f"the instruction makes a prompt of {len(ids)} tokens, the model reads at most "
                f"{self.config.max_tokens}: say it in fewer words"
            )
        return tuple(ids)

    def _refuse_unknown(self, ids: list[int], offsets: list[tuple[int, int]], text: str) -> None:
        unknown_id = self.tokenizer.token_to_id(UNKNOWN)
        unknown = [text[a:b] for i, (a, b) in zip(ids, offsets, strict=True) if i == unknown_id]
        if unknown or not ids:
            known = sorted(w for w in self.tokenizer.get_vocab() if not w.startswith("<"))
            raise InstructionError(
                f"the model never saw {', '.join(map(repr, unknown)) or 'any word of this instruction'}; "
                f"it knows: {' '.join(known)}"
            )
