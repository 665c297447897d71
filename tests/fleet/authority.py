"""Certificates for tests with TLS, made by openssl."""

import subprocess
from collections.abc import Sequence
from pathlib import Path


class Authority:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._run("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem", "-days", "2",
                  "-subj", "/CN=imud test authority")  # fmt: skip
        for name, more in (("broker", "subjectAltName=IP:127.0.0.1"), ("gateway", "extendedKeyUsage=clientAuth")):
            self._run("req", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-out", f"{name}.csr",
                      "-subj", f"/CN={name}")  # fmt: skip
            (folder / "extension").write_text(more)
            self._run("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial",
                      "-out", f"{name}.pem", "-days", "2", "-extfile", "extension")  # fmt: skip

    def _run(self, *words: str) -> None:
        subprocess.run(["openssl", *words], cwd=self.folder, check=True, capture_output=True)

    def __getitem__(self, name: str) -> str:
        return str(self.folder / name)

    def listener(self, port: int) -> Sequence[str]:
        """Return the lines of mosquitto's configuration for a TLS port that requires client certificates."""
        return (
            f"listener {port} 127.0.0.1", f"cafile {self['ca.pem']}", f"certfile {self['broker.pem']}",
            f"keyfile {self['broker.key']}", "require_certificate true", "allow_anonymous true",
        )  # fmt: skip
