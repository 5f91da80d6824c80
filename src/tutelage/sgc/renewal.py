"""Certificates that renew themselves: nodes and routers ask, a node beside the fleet's authority answers (`office`).

Every minute a node says which policy it has and whether its certificate has passed a third of its life; the answer is a new
bundle or deny list if there is one. So a change of the policy or a revocation reaches everybody within a minute, by itself,
and a node can miss the office for two thirds of a certificate's life. Questions are sealed to the office, bundles to the
node that asked.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey

from tutelage.errors import TutelageError
from tutelage.sgc import lanes
from tutelage.sgc.envelope import seal_to
from tutelage.sgc.home import Home
from tutelage.sgc.wire import pack

log = logging.getLogger(__name__)

CONTEXT = b"tutelage renewal 1"
POLL = 60.0
"""Seconds between two questions of a node."""
DUE = 1 / 3
"""Part of a certificate's life after which it is renewed."""
ANSWER_SECONDS = 5.0

Ask = Callable[[str, bytes, float], bytes]
"""Key, payload and timeout in seconds -> answer; raises `TutelageError` if there is none."""


def due(home: Home) -> bool:
    """Has the certificate passed a third of its life?"""
    member = home.member
    return time.time() >= member.not_before + DUE * (member.not_after - member.not_before)


def question(home: Home, *, renew: bool) -> bytes | None:
    """What to ask the office; None if the policy names none.

    renew: ask for a new certificate; else only for what changed in policy and deny list.
    """
    renewals = home.access.renewals
    if renewals is None:
        return None
    serials = home.access.serial.to_bytes(8, "big") + home.trust.deny_list.serial.to_bytes(8, "big")
    sealing = X25519PublicKey.from_public_bytes(renewals.sealing)
    return seal_to(sealing, CONTEXT, pack(home.request(), serials, bytes([renew])))


class Renewer:
    """Asks for a node or router, now and then, on a thread of its own."""

    def __init__(self, home: Home, ask: Ask, *, every: float = POLL, due: Callable[[Home], bool] = due) -> None:
        """
        Args:
            home: whose certificate.
            ask: how to reach the office.
            every: seconds.
            due: when to ask for a new certificate.
        """
        self._home, self._ask, self._every, self._due = home, ask, every, due
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sgc-renewal", daemon=True)

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def close(self) -> None:
        """Ask no more; does not wait for an answer."""
        self._closed.set()

    def once(self) -> bool:
        """Ask once. True if something new came, and was accepted.

        Raises:
            TutelageError: nobody answered, or the answer is not acceptable.
        """
        asked = question(self._home, renew=self._due(self._home))
        if asked is None:
            return False
        answer = self._ask(lanes.key(self._home.access.control, lanes.RENEW), asked, ANSWER_SECONDS)
        if not answer or self._closed.is_set():
            return False
        self._home.accept(answer)
        return True

    def _run(self) -> None:
        pause = min(2.0, self._every)  # the first time soon, but not before there is a connection
        while not self._closed.wait(pause):
            try:
                self.once()
                pause = self._every
            except TutelageError as error:
                log.debug("%s: %s", self._home.name, error)
                pause = min(self._every, max(2.0, 2 * pause))
            self._warn()

    def _warn(self) -> None:
        left = self._home.expires - time.time()
        if 0 < left < (1 - DUE) / 2 * (self._home.expires - self._home.member.not_before):
            log.warning(
                "the certificate of %s expires in %.1f hours; renew it: tutelage keys renew %s",
                self._home.name, left / 3600, self._home.path,
            )  # fmt: skip
