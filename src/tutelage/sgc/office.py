"""Where nodes and routers get their certificates renewed: beside the authority's folder, by a node that the policy names."""

from __future__ import annotations

import logging
import threading
import time

from tutelage.errors import TutelageError
from tutelage.sgc.authority import LEAF_HOURS, Authority
from tutelage.sgc.certificates import read_request
from tutelage.sgc.envelope import open_sealed
from tutelage.sgc.grants import MAX_CONTROL
from tutelage.sgc.home import Home
from tutelage.sgc.reasons import Reason, Refusals, Refused
from tutelage.sgc.renewal import CONTEXT
from tutelage.sgc.wire import unpack

log = logging.getLogger(__name__)

AGAIN = 10.0
"""Seconds within which the same node gets the same bundle again: a question that is repeated costs no new certificate."""


class Office:
    """Answers the questions of `renewal`."""

    def __init__(self, authority: Authority, home: Home, *, hours: float = LEAF_HOURS) -> None:
        """hours: validity of the certificates."""
        self.refusals = Refusals()
        self.renewed = 0
        self._authority, self._home, self._hours = authority, home, hours
        self._lock = threading.Lock()
        self._given: dict[str, tuple[float, int, bytes]] = {}

    def answer(self, question: bytes) -> bytes | None:
        """A bundle or deny list; b"" if the node has the newest; None for what is no question of a member."""
        try:
            return self._answer(question)
        except Refused as refused:
            self.refusals.add(refused.reason)
        except TutelageError as error:
            log.error("a certificate could not be renewed: %s", error)
        return None

    def _answer(self, question: bytes) -> bytes:
        if len(question) > MAX_CONTROL:
            raise Refused(Reason.OVERSIZE, f"a question of {len(question)} bytes")
        request, serials, renew = unpack(open_sealed(self._home.sealing_key, CONTEXT, bytes(question)), 3)
        keys, now = read_request(request), time.monotonic()
        serial, deny_serial = int.from_bytes(serials[:8], "big"), int.from_bytes(serials[8:], "big")
        with self._lock:
            self._authority.refresh()
            roster = self._authority.roster
            newest = roster.serial_of(keys.role)
            if serial == newest and renew == b"\0":
                return self._authority.deny_notice() if deny_serial < roster.deny_serial else b""
            when, given, bundle = self._given.get(keys.common_name, (0.0, -1, b""))
            if given != newest or now - when > AGAIN:
                bundle = self._authority.renew(request, hours=self._hours)
                self._given[keys.common_name] = now, newest, bundle
                self.renewed += 1
            return bundle
