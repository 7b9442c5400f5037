"""Byte-level BPE small enough to read: one token for each word that the data knows.

Must not know a model.
"""

from __future__ import annotations

import collections
import itertools
from collections.abc import Iterable


def byte_alphabet() -> list[str]:
    """Return the 256 printable stand-ins for bytes of byte-level BPE, in a fixed order."""
    from tokenizers.pre_tokenizers import ByteLevel

    return sorted(ByteLevel.alphabet())


def learn_merges(words: Iterable[str], *, suffix: str) -> tuple[list[str], list[tuple[str, str]]]:
    """Return (tokens, merges) of a BPE that makes each word one token, pieces shared if possible.

    `words` are already in byte-level form; `suffix` closes a word (CLIP: `</w>`, Qwen: none). Ties
    are broken by the alphabet, so that the same words give the same tokenizer on every machine.
    """
    pieces = {word: [*word[:-1], word[-1] + suffix] for word in sorted(set(words)) if word}
    tokens: list[str] = []
    merges: list[tuple[str, str]] = []
    while True:
        pairs: collections.Counter[tuple[str, str]] = collections.Counter()
        for parts in pieces.values():
            pairs.update(itertools.pairwise(parts))
        if not pairs:
            return tokens, merges
        best = min(pairs, key=lambda pair: (-pairs[pair], pair))
        merges.append(best)
        tokens.append(best[0] + best[1])
        for parts in pieces.values():
            at = 0
            while at < len(parts) - 1:
                if (parts[at], parts[at + 1]) == best:
                    parts[at : at + 2] = [best[0] + best[1]]
                at += 1
