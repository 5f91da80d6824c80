"""A simulated player of Concentration, who is called away now and then and forgets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tutelage.errors import ConfigError
from tutelage.experiments.user_study.concentration import Table


@dataclass(frozen=True)
class PlayerConfig:
    """Assumptions about a person; they are ours, set before the first table was made, and no part of the dissertation.

    Attributes:
        pace: timesteps of undisturbed play that a turn of two cards takes.
        memory: cards that a person keeps in mind; the one not seen for longest is forgotten first.
        forget: probability to forget each card when called away.
    """

    pace: float = 3.0
    memory: int = 5
    forget: float = 0.5

    def __post_init__(self) -> None:
        if not self.pace > 0 or self.memory < 1 or not 0 <= self.forget <= 1:
            raise ConfigError(f"a player needs pace > 0, memory >= 1 and forget in [0, 1], got {self}")


class Player:
    """Plays whenever no robot needs help.

    Args:
        table: the games.
        config: what kind of person.
        rng: their guesses and lapses.
    """

    def __init__(self, table: Table, config: PlayerConfig, rng: np.random.Generator) -> None:
        self.table, self.config, self._rng = table, config, rng
        self._known: dict[int, int] = {}  # card -> picture, the one seen last at the end
        self._time = 0.0
        self._called = False

    def free(self) -> None:
        """A timestep without a request."""
        self._called = False
        self._time += 1.0
        while self._time >= self.config.pace:
            self._time -= self.config.pace
            self._turn()

    def called(self) -> None:
        """A timestep with a request; at the first one, thoughts are interrupted."""
        if not self._called:
            self._called, self._time = True, 0.0
            kept = self._rng.random(len(self._known)) >= self.config.forget
            self._known = {card: picture for (card, picture), keep in zip(self._known.items(), kept, strict=True) if keep}

    def _turn(self) -> None:
        """Two cards: a pair that is known, else an unknown card and, if that is remembered, its partner."""
        game = self.table.game
        first, second = self._pair() or (self._unknown(), None)
        picture = self._see(first)
        if second is None:
            second = next((card for card, known in self._known.items() if known == picture and card != first), None)
        self._see(self._unknown() if second is None else second)
        if self.table.game is not game:
            self._known.clear()
        else:
            self._known = {card: p for card, p in self._known.items() if card in game.face_down}

    def _pair(self) -> tuple[int, int] | None:
        partner: dict[int, int] = {}
        for card, picture in self._known.items():
            if picture in partner:
                return partner[picture], card
            partner[picture] = card
        return None

    def _unknown(self) -> int:
        down = self.table.game.face_down
        return int(self._rng.choice([card for card in down if card not in self._known] or down))

    def _see(self, card: int) -> int:
        picture = self.table.turn(card).picture
        self._known.pop(card, None)
        self._known[card] = picture
        while len(self._known) > self.config.memory:
            del self._known[next(iter(self._known))]
        return picture
