"""Sealing and opening of messages end to end, against bare AES-256-GCM (the floor) and the primitives of each mode."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from benchmarks.timing import ratio, table, take_turns
from tutelage.sgc.authority import Authority
from tutelage.sgc.home import Home
from tutelage.sgc.keyring import Keyring
from tutelage.sgc.packet import HEADER
from tutelage.sgc.sealing import Opened, Opener, Sealer

SIZES = (64, 1000, 8192, 262_144, 14_000_000)
BATCH = 64
MODES = ("signature", "batch", "session", "chain")
POLICY = """
[topics.{mode}]
node = "robot"
interface = "/{mode}"
type = "bytes"
owner = "robot"
publish = ["robot"]
subscribe = ["server"]
authenticity = "{mode}"
"""


def run(quick: bool = False) -> dict[str, Any]:
    """Microseconds a message to seal and to open. `batch` is signatures with 64 messages of up to 8 KiB a packet; `session`
    has one receiver."""
    with tempfile.TemporaryDirectory() as folder:
        robot, server = _nodes(Path(folder))
        results = [measure(robot, server, size, quick) for size in SIZES]
    rows = [
        [
            f"{r['bytes']:,} B: {r['mode']}",
            r["seal"],
            r["seal / floor"],
            r["open"],
            r["open / floor"],
            r["both / primitives"],
        ]
        for result in results
        for r in result
    ]
    head = ["message", "seal us", "/ AES-GCM", "open us", "/ AES-GCM", "both / primitives"]
    print(table(head, rows))
    return {"sealing": [r for result in results for r in result]}


def measure(robot: Keyring, server: Keyring, size: int, quick: bool) -> list[dict[str, Any]]:
    """One size, all modes and their floors, which take turns."""
    many = BATCH if size <= 8192 else 4 if size < 1 << 20 else 1
    # Turns of about a millisecond: longer ones are often interrupted on a busy machine.
    counts = {mode: min(many, 4) if mode == "signature" else many for mode in (*MODES, "floor")}
    payload, bare = os.urandom(size), Bare()
    variants: dict[str, Callable[[], Any]] = {}
    before: dict[str, Callable[[], Any]] = {}
    for mode in MODES:
        if mode == "batch" and many < BATCH:
            continue
        pair = Pair(robot, server, mode, payload, counts[mode])
        variants |= {f"{mode} seal": pair.seal, f"{mode} open": pair.open}
        before[f"{mode} open"] = pair.seal
        for way, work in bare.of(mode, payload, counts[mode]).items():
            variants[f"{mode} {way} primitives"] = work
    for way, work in bare.of("floor", payload, many).items():
        variants[f"floor {way}"] = work
    seconds = take_turns(variants, rounds=15 if quick else 151 if size < 1 << 20 else 31, before=before)
    found = []
    for mode in [mode for mode in MODES if f"{mode} seal" in variants]:
        share = many / counts[mode]
        both = np.add(seconds[f"{mode} seal"], seconds[f"{mode} open"])
        primitives = np.add(seconds[f"{mode} seal primitives"], seconds[f"{mode} open primitives"])
        found.append(
            {
                "bytes": size,
                "mode": mode,
                "seal": 1e6 * float(np.median(seconds[f"{mode} seal"])) / counts[mode],
                "open": 1e6 * float(np.median(seconds[f"{mode} open"])) / counts[mode],
                "seal / floor": share * ratio(seconds, f"{mode} seal", "floor seal"),
                "open / floor": share * ratio(seconds, f"{mode} open", "floor open"),
                "both / primitives": float(np.median(both / primitives)),
            }
        )
    return found


class Pair:
    """A sealer and an opener of one mode."""

    def __init__(self, robot: Keyring, server: Keyring, mode: str, payload: bytes, count: int) -> None:
        topic = "signature" if mode == "batch" else mode
        self._sealer, self._opener = Sealer(robot, topic), Opener(server, topic)
        if mode == "session":
            self._opener.complete_session(self._sealer.accept_session(self._opener.offer_session()))
        self._mode, self._payload, self._count = mode, payload, count
        self._packets: list[Any] = []
        self.seal()
        self.open()

    def seal(self) -> None:
        """All messages of a turn."""
        if self._mode == "batch":
            self._packets = [self._sealer.seal_many([self._payload] * self._count)]
        else:
            self._packets = [self._sealer.seal(self._payload) for _ in range(self._count)]
            if self._mode == "chain" and (anchor := self._sealer.flush()) is not None:
                self._packets.append(anchor)

    def open(self) -> None:
        """All of them, each of which must arrive."""
        messages: list[Opened] = []
        for packet in self._packets:
            messages += self._opener.open_many(packet)
        if len(messages) != self._count or messages[-1].payload != self._payload or not messages[-1].authentic:
            raise RuntimeError(f"{self._count} messages were sealed, {len(messages)} opened")


class Bare:
    """The same work without any of our code: what no implementation on these primitives can be faster than."""

    def __init__(self) -> None:
        self._cipher, self._key = AESGCM(AESGCM.generate_key(256)), Ed25519PrivateKey.generate()
        self._public = self._key.public_key()

    def of(self, mode: str, payload: bytes, count: int) -> dict[str, Callable[[], Any]]:
        """Seal and open a turn's messages: encryption, and what the mode's proof needs."""
        nonce, header = bytes(12), bytes(HEADER)
        if mode == "batch":
            payload, count = payload * count, 1
        sealed = self._cipher.encrypt(nonce, payload, header)
        digest = hashlib.sha256(payload).digest()
        signature = self._key.sign(digest)
        signatures = {"signature": count, "batch": 1, "chain": 1}.get(mode, 0)
        hashes = mode in ("signature", "batch", "chain")

        def seal() -> None:
            for _ in range(count):
                self._cipher.encrypt(nonce, payload, header)
                if hashes:
                    hashlib.sha256(payload).digest()
            for _ in range(signatures):
                self._key.sign(digest)

        def open_() -> None:
            for _ in range(count):
                self._cipher.decrypt(nonce, sealed, header)
                if hashes:
                    hashlib.sha256(payload).digest()
            for _ in range(signatures):
                self._public.verify(signature, digest)

        return {"seal": seal, "open": open_}


def _nodes(folder: Path) -> tuple[Keyring, Keyring]:
    authority = Authority.create(folder / "authority", "bench")
    policy = "version = 1\n" + "".join(POLICY.format(mode=mode) for mode in MODES if mode != "batch")
    (folder / "authority" / "policy.toml").write_text(policy, encoding="utf-8")
    authority.publish()
    keyrings = []
    for name in ("robot", "server"):
        home = Home.create(folder / name, name)
        home.accept(authority.issue(home.request()))
        keyrings.append(Keyring(home))
    robot, server = keyrings
    for alias in server.wanted():
        server.accept(alias, robot.answer(alias, server.ask(alias)))
    return robot, server
