"""Statements with a signature: what the authority says, and what nodes say of themselves."""

from __future__ import annotations

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.wire import pack, unpack


def sign(context: bytes, body: bytes, key: Ed25519PrivateKey) -> bytes:
    """The body and a signature of it.

    context: what kind of statement this is, so that no signature can be taken for one of another kind.
    """
    return pack(body, key.sign(pack(context, body)))


def verified(context: bytes, statement: bytes, key: Ed25519PublicKey, reason: Reason = Reason.FORGED) -> bytes:
    """The body of what `sign` gave.

    Raises:
        Refused: MALFORMED, or `reason` if the signature is not by this key.
    """
    body, signature = unpack(statement, 2)
    try:
        key.verify(signature, pack(context, body))
    except InvalidSignature:
        raise Refused(reason, f"the signature of a {context.decode()} is not by the key that it should be") from None
    return body
