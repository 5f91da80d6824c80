"""Where a proxy listens, and what it then needs: loopback is open to this machine, anywhere else wants TLS and proof."""

from __future__ import annotations

import hmac
import ipaddress
import re
import ssl
from dataclasses import dataclass
from pathlib import Path

from tutelage.errors import ConfigError


@dataclass(frozen=True)
class Tls:
    """Files, PEM: certificate (chain) and key of the proxy; the authority whose certificates clients must have, if any."""

    certificate: Path
    key: Path
    clients: Path | None = None

    def read(self) -> tuple[bytes, bytes, bytes | None]:
        """Their contents.

        Raises:
            ConfigError: a file cannot be read.
        """
        try:
            clients = self.clients.read_bytes() if self.clients is not None else None
            return self.certificate.read_bytes(), self.key.read_bytes(), clients
        except OSError as error:
            raise ConfigError(f"cannot read {error.filename}: {error.strerror}") from None

    def context(self) -> ssl.SSLContext:
        """For a server of the standard library.

        Raises:
            ConfigError: a file cannot be read, or they do not belong together.
        """
        self.read()  # for its error
        try:
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=self.clients)
        except ssl.SSLError as error:
            raise ConfigError(f"cannot use {self.clients} as an authority: {error.reason or error}") from None
        try:
            context.load_cert_chain(self.certificate, self.key, password="")  # one with a passphrase must not ask for it
        except ssl.SSLError as error:
            raise ConfigError(f"cannot use {self.certificate} with {self.key}: {error.reason or error}") from None
        if self.clients is not None:
            context.verify_mode = ssl.CERT_REQUIRED
        return context


def parse_address(address: str) -> tuple[str, int]:
    """HOST:PORT, also [IPv6]:PORT.

    Raises:
        ConfigError: it is none.
    """
    host, colon, port = address.rpartition(":")
    if not host or not colon or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise ConfigError(f"{address!r} is no address; write HOST:PORT, such as 127.0.0.1:9090")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Is this an address that only this machine can reach?"""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_listen(what: str, host: str, token: str | None, tls: Tls | None) -> None:
    """Refuse to be open to others without protection.

    Raises:
        ConfigError: what is missing.
    """
    if is_loopback(host):
        return
    if tls is None:
        raise ConfigError(f"{what} on {host} needs TLS (certificate and key), as others than this machine can reach it")
    if token is None and tls.clients is None:
        raise ConfigError(f"{what} on {host} needs a token or an authority for client certificates")


def read_token(path: Path) -> str:
    """A token from a file.

    Raises:
        ConfigError: no such file, or a token of less than 16 characters.
    """
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the token in {path}: {error}") from None
    if len(token) < 16:
        raise ConfigError(f"the token in {path} has {len(token)} characters; it needs 16 at least")
    return token


def has_token(given: list[str], wanted: str) -> bool:
    """Is one of these the token, with or without Bearer in front? Takes equally long for all wrong ones."""
    return any(hmac.compare_digest(each.removeprefix("Bearer ").encode(), wanted.encode()) for each in given)
