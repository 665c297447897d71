"""Certificates and keys in PEM files: whether OpenSSL accepts them, and when they expire.

`ssl` reads no expiry of a client certificate. This module therefore reads the member `validity` itself (RFC 5280,
section 4.1).
"""

import base64
import binascii
import re
import ssl
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final, NamedTuple

PEM_BYTES_MAX: Final = 1 << 20  # maximum size of a PEM file, bytes. All CA certificates of Debian are 0.2 MB.

_BLOCK: Final = re.compile(rb"-----BEGIN CERTIFICATE-----(.*?)-----END CERTIFICATE-----", re.DOTALL)
_SEQUENCE: Final = 0x30
_VERSION: Final = 0xA0  # explicit tag 0 of the optional version
_UTC_TIME: Final = 0x17  # YYMMDDHHMMSSZ; other times have a year of four digits
_LONG_LENGTH: Final = 0x80  # length byte with this bit: the other bits are the number of length bytes that follow


class Validity(NamedTuple):
    """Time in which a certificate is valid."""

    start: datetime
    end: datetime


def certificate_validities(pem: bytes) -> Sequence[Validity]:
    """Return the validity of each certificate in a PEM file. Raises ValueError if the file has no certificate or
    contains an invalid one."""
    blocks = _BLOCK.findall(pem)
    if not blocks:
        raise ValueError("no certificate")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(cadata=pem.decode("ascii", "replace"))
        return [_validity_of(base64.b64decode(block)) for block in blocks]
    except (ssl.SSLError, binascii.Error, IndexError) as error:
        raise ValueError("no valid certificate") from error


class EncryptedKey(ValueError):
    """A key with a passphrase, which imud cannot request."""


def load_client_certificate(context: ssl.SSLContext, certificate: str, key: str | None) -> None:
    """Load a certificate and its key (None: from the same file). Raises ValueError with the reason,
    EncryptedKey, OSError."""
    try:
        context.load_cert_chain(certificate, key, _no_passphrase)
    except ssl.SSLError as error:
        raise ValueError(error.reason or "no certificate with its key") from error


def _no_passphrase() -> str:
    # without this function, OpenSSL would request the passphrase on the terminal and wait
    raise EncryptedKey("a key with a passphrase")


def _validity_of(der: bytes) -> Validity:
    """Return the validity of a certificate. Raises ValueError, IndexError for other bytes."""
    _, certificate, _ = _element(der)
    _, fields, _ = _element(certificate)
    tag, _, rest = _element(fields)
    if tag == _VERSION:
        fields = rest
    for _ in ("serial number", "signature", "issuer"):
        _, _, fields = _element(fields)
    tag, times, _ = _element(fields)
    if tag != _SEQUENCE:
        raise ValueError("expected the validity of a certificate, got another element")
    start_tag, start, times = _element(times)
    end_tag, end, _ = _element(times)
    return Validity(_time_of(start_tag, start), _time_of(end_tag, end))


def _element(der: bytes) -> tuple[int, bytes, bytes]:
    """Return tag and content of the first element, and the bytes after it."""
    tag, length, start = der[0], der[1], 2
    if length & _LONG_LENGTH:
        start += length & ~_LONG_LENGTH
        length = int.from_bytes(der[2:start])
    return tag, der[start : start + length], der[start + length :]


def _time_of(tag: int, text: bytes) -> datetime:
    digits = text.decode("ascii")
    if tag == _UTC_TIME:
        century = "20" if int(digits[:2]) < 50 else "19"  # RFC 5280, section 4.1.2.5.1
        digits = century + digits
    return datetime.strptime(digits, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
