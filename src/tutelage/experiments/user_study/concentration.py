"""Concentration, also called Memory: find the pairs among cards that lie face down. Played between requests (B.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tutelage.errors import ConfigError, ContractError

PRACTICE_CARDS, CARDS = 12, 24
"""Cards of the game in which it is learned, and of those during the study."""


@dataclass(frozen=True)
class Turned:
    """A card that was turned over. pair: whether it completes a pair; None: it is the first card of a turn."""

    card: int
    picture: int
    pair: bool | None


class Concentration:
    """One game. A turn is two cards; a pair stays face up, two others are turned back.

    Args:
        cards: how many, an even number.
        rng: shuffles them.

    Raises:
        ConfigError: an impossible number of cards.
    """

    def __init__(self, cards: int, rng: np.random.Generator) -> None:
        if cards < 2 or cards % 2:
            raise ConfigError(f"Concentration needs an even number of cards, got {cards}")
        self.cards = cards
        self._pictures = rng.permutation(np.arange(cards) // 2)
        self._found = np.zeros(cards, dtype=bool)
        self._first: int | None = None
        self.turns = 0

    def turn(self, card: int) -> Turned:
        """Turn a card over.

        Raises:
            ContractError: no such card, or it lies face up.
        """
        if not 0 <= card < self.cards or self._found[card] or card == self._first:
            raise ContractError(f"card {card} cannot be turned over: choose one of 0 to {self.cards - 1} that is face down")
        picture = int(self._pictures[card])
        if self._first is None:
            self._first = card
            return Turned(card, picture, None)
        pair = bool(self._pictures[self._first] == picture)
        self._found[[card, self._first]] |= pair
        self._first = None
        self.turns += 1
        return Turned(card, picture, pair)

    @property
    def face_down(self) -> list[int]:
        """The cards that may be turned over."""
        return [card for card in range(self.cards) if not self._found[card] and card != self._first]

    @property
    def face_up(self) -> dict[int, int]:
        """What can be seen: card to picture. A page shows no more than this."""
        seen = [*np.flatnonzero(self._found).tolist(), *([] if self._first is None else [self._first])]
        return {card: int(self._pictures[card]) for card in seen}

    @property
    def pairs(self) -> int:
        """Pairs found so far."""
        return int(self._found.sum()) // 2

    @property
    def over(self) -> bool:
        """Whether all pairs are found."""
        return bool(self._found.all())


class Table:
    """Games one after the other: a finished one is followed by a new one (appendix B.4).

    Args:
        cards: of each game.
        rng: shuffles them.
    """

    def __init__(self, cards: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._before = 0
        self.game = Concentration(cards, rng)

    def turn(self, card: int) -> Turned:
        """Turn a card of the present game over; the last pair of a game brings a new one.

        Raises:
            ContractError: no such card, or it lies face up.
        """
        turned = self.game.turn(card)
        if self.game.over:
            self._before += self.game.pairs
            self.game = Concentration(self.game.cards, self._rng)
        return turned

    @property
    def pairs(self) -> int:
        """Pairs found in all games."""
        return self._before + self.game.pairs
