"""Fixtures of tests with a broker."""

import shutil
from collections.abc import Iterator

import pytest

from imud.publishers.mqtt.spool import Spool
from tests.publishers.mqtt.authority import Authority


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(autouse=True)
def _closed_spools(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close what a test leaves open: from Python 3.13 on there is a warning for each database that is not closed."""
    opened: list[Spool] = []
    opening = Spool.open

    def noted(spool: Spool) -> None:
        opened.append(spool)
        opening(spool)

    monkeypatch.setattr(Spool, "open", noted)
    yield
    for spool in opened:
        spool.close()
