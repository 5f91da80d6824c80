"""Opened packets become messages: the frames of each stream, in order, are put together."""

from __future__ import annotations

from collections.abc import Callable

from tutelage.sgc import frames
from tutelage.sgc.messages import Message, make_message
from tutelage.sgc.reasons import Refusals, Refused
from tutelage.sgc.sealing import Opened

_WHOLE = frames.Kind.WHOLE


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
        self.unfinished: dict[bytes, frames.Assembly] = {}
        """Messages of which pieces are still to come, by the salt of the stream."""

    def messages(self, opened: list[Opened], received: float) -> list[Message]:
        """The messages that these frames complete. received: seconds since 1970."""
        messages, alias = [], self._alias
        for body, sender, sequence, salt, sent, _, authentic, _, label in opened:
            whole = label[0] == _WHOLE and not self.unfinished  # as nearly all are
            payload = body if whole else self._assemble(salt, sequence, label, body)
            if payload is not None:
                messages.append(make_message((payload, sender, alias, sequence, sent * 1e-9, received, authentic)))
        if self.unfinished:
            present = self._present()
            self.unfinished = {each: assembly for each, assembly in self.unfinished.items() if each in present}
        return messages

    def _assemble(self, salt: bytes, sequence: int, label: bytes, body: bytes) -> bytes | None:
        """The message that a frame completes, if any."""
        assembly = self.unfinished.pop(salt, None) or frames.Assembly()
        try:
            return assembly.take(sequence, label, body)
        except Refused as refused:
            self._refusals.add(refused.reason)
            return None
        finally:
            if assembly.unfinished:
                self.unfinished[salt] = assembly
