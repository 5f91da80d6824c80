"""X.509: root, authority and leaves, all Ed25519. A leaf's common name is a pseudonym; its extension holds a second key.

Zenoh's TLS and QUIC accept Ed25519, so one key signs handshakes and messages; the two cannot be confused, as each signs its
own context first. A leaf of a node may only act as a TLS client, so a stolen one cannot stand in for a router.
"""

from __future__ import annotations

import datetime
import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from tutelage.errors import ConfigError
from tutelage.sgc.envelope import sealing_key
from tutelage.sgc.reasons import Reason, Refused
from tutelage.sgc.rules import NODE_NAME, Role

PSEUDONYM = re.compile(r"[0-9a-f]{32}")
KEYS_EXTENSION = x509.ObjectIdentifier("2.25.146681842836801373152868853488318874993")
"""Role (1 byte: 0 node, 1 router) and X25519 public key (32 bytes). The arc 2.25 is open to all (X.667)."""
_ROLES = (Role.NODE, Role.ROUTER)
_BACKDATED = datetime.timedelta(minutes=5)  # clocks of the fleet may be late by this much
_MAX_DER = 8192
UNREADABLE = (
    ValueError,
    TypeError,
    InvalidSignature,
    UnsupportedAlgorithm,
    x509.InvalidVersion,
    x509.ExtensionNotFound,
    x509.DuplicateExtension,
    x509.UnsupportedGeneralNameType,
)
"""What reading a certificate from a stranger may raise."""


@dataclass(frozen=True)
class Keys:
    """What a leaf, or a request for one, binds together.

    Attributes:
        common_name: pseudonym in a leaf, name of the node in a request.
        role: node or router.
        signing, sealing: public keys.
        addresses: IP addresses and host names of a router.
    """

    common_name: str
    role: Role
    signing: Ed25519PublicKey
    sealing: X25519PublicKey
    addresses: tuple[str, ...] = ()


def raw(key: Ed25519PublicKey | X25519PublicKey) -> bytes:
    """A public key as its 32 bytes."""
    return key.public_bytes_raw()


def authority_certificate(
    name: str,
    key: Ed25519PublicKey,
    issuer: x509.Certificate | None,
    issuer_key: Ed25519PrivateKey,
    start: float,
    days: float,
) -> x509.Certificate:
    """A root (issuer None, signs itself), or the authority that it signs.

    start: seconds since 1970.
    """
    subject = _named(name)
    builder = _builder(subject, issuer.subject if issuer else subject, key, issuer_key, start, days * 24)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0 if issuer else 1), critical=True)
    return builder.add_extension(_usage(signs_certificates=True), critical=True).sign(issuer_key, None)


def leaf_certificate(
    keys: Keys, issuer: x509.Certificate, issuer_key: Ed25519PrivateKey, start: float, hours: float
) -> x509.Certificate:
    """A short-lived certificate of a node or router."""
    builder = _builder(_named(keys.common_name), issuer.subject, keys.signing, issuer_key, start, hours)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if keys.role == Role.ROUTER:
        usages.insert(0, ExtendedKeyUsageOID.SERVER_AUTH)
        builder = builder.add_extension(x509.SubjectAlternativeName(_general_names(keys.addresses)), critical=False)
    builder = builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    return builder.add_extension(_extension(keys), critical=False).sign(issuer_key, None)


def request(keys: Keys, key: Ed25519PrivateKey) -> bytes:
    """A signing request (PKCS#10, PEM). It holds the node's name: it is for the authority only."""
    builder = x509.CertificateSigningRequestBuilder().subject_name(_named(keys.common_name))
    builder = builder.add_extension(_extension(keys), critical=False)
    if keys.addresses:
        builder = builder.add_extension(x509.SubjectAlternativeName(_general_names(keys.addresses)), critical=False)
    return builder.sign(key, None).public_bytes(serialization.Encoding.PEM)


def read_request(pem: bytes) -> Keys:
    """What a signing request asks for; its signature proves that the sender has the key.

    Raises:
        Refused: MALFORMED or FORGED.
    """
    try:
        asked = x509.load_pem_x509_csr(pem[:_MAX_DER])
        genuine = asked.is_signature_valid
        keys = _keys(asked)
    except UNREADABLE as error:
        raise Refused(Reason.MALFORMED, f"not a signing request: {str(error).partition('. See')[0]}") from None
    if not NODE_NAME.fullmatch(keys.common_name):
        raise Refused(Reason.MALFORMED, f"a signing request for the impossible name {keys.common_name!r}")
    if not genuine:
        raise Refused(Reason.FORGED, f"the signing request of {keys.common_name} is not signed by its own key")
    return keys


def read_leaf(certificate: x509.Certificate) -> Keys:
    """What a leaf says. Whether to believe it is for `Trust` to decide.

    Raises:
        Refused: MALFORMED.
    """
    try:
        keys = _keys(certificate)
        if certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
            raise ValueError("an authority's certificate")
    except UNREADABLE as error:
        raise Refused(Reason.MALFORMED, f"not a certificate of a node: {error}") from None
    if not PSEUDONYM.fullmatch(keys.common_name):
        raise Refused(Reason.MALFORMED, "the common name of a certificate is not a pseudonym")
    return keys


def load(der: bytes) -> x509.Certificate:
    """Read a certificate.

    Raises:
        Refused: MALFORMED.
    """
    try:
        return x509.load_der_x509_certificate(der[:_MAX_DER])
    except UNREADABLE as error:
        raise Refused(Reason.MALFORMED, f"not a certificate: {error}") from None


def der(certificate: x509.Certificate) -> bytes:
    """A certificate as bytes."""
    return certificate.public_bytes(serialization.Encoding.DER)


def pem(*certificates: x509.Certificate) -> bytes:
    """Certificates as text, leaf first."""
    return b"".join(one.public_bytes(serialization.Encoding.PEM) for one in certificates)


def check_addresses(addresses: Sequence[str]) -> None:
    """Can these be addresses of a router?

    Raises:
        ConfigError: one line that names the address.
    """
    _general_names(tuple(addresses))


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: Ed25519PublicKey,
    issuer_key: Ed25519PrivateKey,
    start: float,
    hours: float,
) -> x509.CertificateBuilder:
    begin = datetime.datetime.fromtimestamp(start, datetime.UTC).replace(microsecond=0)
    builder = x509.CertificateBuilder(subject_name=subject, issuer_name=issuer, public_key=key)
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(begin - _BACKDATED).not_valid_after(begin + datetime.timedelta(hours=hours))
    builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key())
    return builder.add_extension(identifier, critical=False)


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _extension(keys: Keys) -> x509.UnrecognizedExtension:
    return x509.UnrecognizedExtension(KEYS_EXTENSION, bytes([_ROLES.index(keys.role)]) + raw(keys.sealing))


def _keys(holder: x509.Certificate | x509.CertificateSigningRequest) -> Keys:
    signing = holder.public_key()
    if not isinstance(signing, Ed25519PublicKey):
        raise ValueError("its key is not Ed25519")
    (common_name,) = holder.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    extension = holder.extensions.get_extension_for_oid(KEYS_EXTENSION).value
    if not isinstance(extension, x509.UnrecognizedExtension) or len(extension.value) != 33 or extension.value[0] > 1:
        raise ValueError("its extension with role and key is damaged")
    try:
        names = holder.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        addresses = tuple(str(name.value) for name in names)
    except x509.ExtensionNotFound:
        addresses = ()
    return Keys(str(common_name.value), _ROLES[extension.value[0]], signing, sealing_key(extension.value[1:]), addresses)


def _general_names(addresses: Sequence[str]) -> list[x509.GeneralName]:
    found: list[x509.GeneralName] = []
    for address in addresses:
        try:
            found.append(x509.IPAddress(ipaddress.ip_address(address)))
        except ValueError:
            if not re.fullmatch(
                r"(?=.{1,253}$)[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*", address
            ):
                raise ConfigError(f"{address!r} is neither an IP address nor a host name") from None
            found.append(x509.DNSName(address))
    if not found:
        raise ConfigError("a router needs at least one address at which others reach it, such as --address 192.0.2.7")
    return found
