"""What is sealed outside the messages: to one node (HPKE, RFC 9180), or to all who hold a secret (AES-256-GCM)."""

from __future__ import annotations

import os

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hpke
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from tutelage.sgc.reasons import Reason, Refused

_SUITE = hpke.Suite(hpke.KEM.X25519, hpke.KDF.HKDF_SHA256, hpke.AEAD.AES_256_GCM)
_NONCE = 12
_PROBE = X25519PrivateKey.generate()


def seal_to(key: X25519PublicKey, info: bytes, plaintext: bytes) -> bytes:
    """Only the holder of the private key can read it. Base mode: says nothing about who sealed it, so sign the inside.

    info: what it is, and for what; the reader must name the same.
    """
    return _SUITE.encrypt(plaintext, key, info)


def sealing_key(raw: bytes) -> X25519PublicKey:
    """A public key of a stranger, if it is one that can be sealed to: with a point of low order there is no shared secret.

    Raises:
        ValueError: not such a key.
    """
    key = X25519PublicKey.from_public_bytes(raw)
    _PROBE.exchange(key)
    return key


def open_sealed(key: X25519PrivateKey, info: bytes, sealed: bytes) -> bytes:
    """Read what `seal_to` gave.

    Raises:
        Refused: NOT_FOR_US: sealed to another key, for something else, or damaged; these cannot be told apart.
    """
    try:
        return _SUITE.decrypt(sealed, key, info)
    except (InvalidTag, ValueError):
        raise Refused(Reason.NOT_FOR_US, "sealed to another node, or damaged") from None


class Curtain:
    """Hides control messages of a topic or fleet from whoever only carries them.

    All who hold the secret can lift it, so it proves nothing about the sender: what is inside is signed.
    """

    def __init__(self, secret: bytes, purpose: bytes) -> None:
        """secret: 32 bytes; purpose: what the messages are, so that none can be taken for one of another kind."""
        self._cipher = AESGCM(derive(secret, b"", b"tutelage curtain 1 " + purpose))

    def hide(self, plaintext: bytes, header: bytes = b"") -> bytes:
        """Header in clear (but authenticated), then the rest."""
        nonce = os.urandom(_NONCE)  # random: 2**32 control messages under one secret stay safe
        return header + nonce + self._cipher.encrypt(nonce, plaintext, header)

    def lift(self, hidden: bytes, header: int = 0) -> bytes:
        """Read what `hide` gave.

        header: length of the header in bytes.

        Raises:
            Refused: MALFORMED or TAMPERED.
        """
        if len(hidden) < header + _NONCE + 16:
            raise Refused(Reason.MALFORMED, f"a control message of {len(hidden)} bytes")
        head, nonce, rest = hidden[:header], hidden[header : header + _NONCE], hidden[header + _NONCE :]
        try:
            return self._cipher.decrypt(nonce, rest, head)
        except InvalidTag:
            raise Refused(
                Reason.TAMPERED, "a control message that was not made with the topic's secret, or was changed"
            ) from None


def derive(key: bytes, salt: bytes, info: bytes, length: int = 32) -> bytes:
    """HKDF-SHA256 (RFC 5869)."""
    return HKDF(algorithm=SHA256(), length=length, salt=salt or None, info=info).derive(key)
