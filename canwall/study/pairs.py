"""Order of a two-alternative comparison: pairs of walls, each of a reference and another one."""

from typing import NamedTuple

import numpy as np


class Trial(NamedTuple):
    """One trial: two walls, of which one is chosen.

    Attributes:
        pair: Number of the pair, from 0.
        reference_first: True if the reference is the first of the two.
    """

    pair: int
    reference_first: bool


def balanced_trials(pairs: int, repeats: int, random: np.random.Generator) -> list[Trial]:
    """Return trials in random order, in blocks that have each pair once.

    The reference is the first wall in half of the trials of each pair, so that a person who prefers
    the first or the last of two walls does not shift the result. If the number of repeats is odd,
    chance decides on the one left over.

    Args:
        pairs: Number of pairs.
        repeats: Trials of each pair.
        random: Source of chance.
    """
    first = [random.permuted(_halves(repeats, random)) for _ in range(pairs)]
    return [
        Trial(int(pair), bool(first[pair][block]))
        for block in range(repeats)
        for pair in random.permutation(pairs)
    ]


def _halves(repeats: int, random: np.random.Generator) -> list[bool]:
    half = [True, False] * (repeats // 2)
    return half + [bool(random.integers(2))] * (repeats % 2)
