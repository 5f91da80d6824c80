"""Opened packets become messages: the frames of each stream, in order, are put together."""

from __future__ import annotations

from collections.abc import Callable

from tutelage.sgc import frames
from tutelage.sgc.messages import Message, make_message
from tutelage.sgc.reasons import Refusals, Refused
from tutelage.sgc.sealing import Opened


class Assembler:
    """Puts the messages of one topic together. Not for several threads at once."""

    def __init__(self, alias: str, refusals: Refusals, present: Callable[[], set[bytes]]) -> None:
        """
        Args:
            alias: of the topic.
            refusals: counts frames that cannot be read.
            present: salts of the senders' present starts; what earlier ones left incomplete is forgotten.
        """
        self._alias, self._refusals, self._present = alias, refusals, present
        self._assemblies: dict[bytes, frames.Assembly] = {}

    def messages(self, opened: list[Opened], received: float) -> list[Message]:
        """The messages that these frames complete. received: seconds since 1970."""
        messages, alias = [], self._alias
        for body, sender, sequence, salt, sent, _, authentic, _, label in opened:
            try:
                payload = (self._assemblies.get(salt) or self._begin(salt)).take(sequence, label, body)
            except Refused as refused:
                self._refusals.add(refused.reason)
                continue
            if payload is not None:
                messages.append(make_message((payload, sender, alias, sequence, sent * 1e-9, received, authentic)))
        return messages

    def _begin(self, salt: bytes) -> frames.Assembly:
        present = self._present()
        self._assemblies = {each: assembly for each, assembly in self._assemblies.items() if each in present}
        assembly = self._assemblies[salt] = frames.Assembly()
        return assembly
