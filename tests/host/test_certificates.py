"""Certificates and keys in PEM files."""

import base64
import ssl
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.host.certificates import EncryptedKey, certificate_validities, load_client_certificate
from tests.fleet.authority import Authority

HEAD = b"-----BEGIN CERTIFICATE-----\n"
TAIL = b"\n-----END CERTIFICATE-----\n"


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("authority"))


def test_validity_as_openssl_prints_it(authority: Authority) -> None:
    pem = Path(authority["ca.pem"]).read_bytes()
    (validity,) = certificate_validities(pem)
    assert (validity.end - validity.start).days == 2
    printed_fields = ssl._ssl._test_decode_cert(authority["ca.pem"])  # type: ignore[attr-defined]
    for name, time in (("notBefore", validity.start), ("notAfter", validity.end)):
        assert datetime.strptime(printed_fields[name], "%b %d %H:%M:%S %Y GMT").replace(tzinfo=UTC) == time
    assert len(certificate_validities(b"text\n" + pem + Path(authority["gateway.pem"]).read_bytes())) == 2


@pytest.mark.parametrize("content", [b"", b"text", HEAD + TAIL, HEAD + b"MIIB" + TAIL, HEAD + b"?" + TAIL])
def test_files_without_a_certificate(content: bytes) -> None:
    with pytest.raises(ValueError, match=r"^no (valid )?certificate$"):
        certificate_validities(content)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match="certificate"):
        certificate_validities(HEAD + base64.b64encode(content) + TAIL)


def test_pairs_of_certificate_and_key(authority: Authority, tmp_path: Path) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    load_client_certificate(context, authority["gateway.pem"], authority["gateway.key"])
    with pytest.raises(ValueError, match="KEY_VALUES_MISMATCH"):
        load_client_certificate(context, authority["gateway.pem"], authority["broker.key"])
    authority._run("rsa", "-aes128", "-in", "gateway.key", "-passout", "pass:a", "-out", "secret.key")
    with pytest.raises(EncryptedKey):
        load_client_certificate(context, authority["gateway.pem"], authority["secret.key"])
    with pytest.raises(FileNotFoundError):
        load_client_certificate(context, authority["gateway.pem"], str(tmp_path / "none"))
