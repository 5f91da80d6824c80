"""Private keys as files that only their owner may read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tutelage.files import write_atomic
from tutelage.sgc.errors import KeysError


def holds(folder: Path, name: str) -> bool:
    """Is there a file of this name?

    Raises:
        KeysError: nobody may look.
    """
    try:
        return (folder / name).exists()
    except OSError as error:
        raise KeysError(f"cannot look into {folder}: {error.strerror}; is it yours?") from None


def make_folder(path: Path) -> None:
    """A folder for keys, which only its owner may enter.

    Raises:
        KeysError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        os.chmod(path, 0o700)
    except OSError as error:
        raise KeysError(f"cannot make the folder {path}: {error.strerror}; choose another") from None


def key_pem(key: Ed25519PrivateKey | X25519PrivateKey, passphrase: bytes | None = None) -> bytes:
    """A key as text (PKCS#8, PEM), encrypted if there is a passphrase."""
    encryption = serialization.BestAvailableEncryption(passphrase) if passphrase else serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)


def save_key(path: Path, key: Ed25519PrivateKey | X25519PrivateKey, passphrase: bytes | None = None) -> None:
    """Write a key (PKCS#8, PEM, mode 0600), encrypted if there is a passphrase."""
    write_atomic(path, key_pem(key, passphrase), private=True)


def load_signing_key(path: Path, passphrase: bytes | None = None) -> Ed25519PrivateKey:
    """Read an Ed25519 key.

    Raises:
        ValueError, TypeError: not such a key, or not with this passphrase. OSError: cannot be read.
    """
    key = _load(path, passphrase)
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError(f"{path.name} holds a key of another kind")
    return key


def load_sealing_key(path: Path) -> X25519PrivateKey:
    """Read an X25519 key.

    Raises:
        ValueError, TypeError: not such a key. OSError: cannot be read.
    """
    key = _load(path, None)
    if not isinstance(key, X25519PrivateKey):
        raise ValueError(f"{path.name} holds a key of another kind")
    return key


def _load(path: Path, passphrase: bytes | None) -> Any:
    return serialization.load_pem_private_key(path.read_bytes(), passphrase)
