"""Checks of shared memory and of metrics scrapes."""

import asyncio

import pytest

from imud.cli.doctor.command import examine, exit_status
from imud.cli.doctor.daemon import prometheus, shared_memory
from imud.cli.doctor.surroundings import DoctorCheck, fetch_over_http
from imud.publishers.metrics.publisher import MetricsOptions, MetricsPublisher
from tests.support.metrics import ask
from tests.support.publisher_context import publisher_context
from tests.support.surroundings import Machine

PROMETHEUS, SHARED = DoctorCheck("p", prometheus), DoctorCheck("s", shared_memory)
AT = ("127.0.0.1", 9321, "/scrapes")


@pytest.fixture
def running(machine: Machine) -> Machine:
    machine.configure()
    machine.status = []
    return machine


def test_scrapes(running: Machine) -> None:
    for page, severity, words in [
        ('{"scrapes":0,"age_s":9.0}', "note", "no scrape of 127.0.0.1 port 9321 since imud opened it 9 s ago"),
        ('{"scrapes":0,"age_s":3000.0}', "note", "opened it 50 minutes ago"),
        ('{"scrapes":7,"age_s":9.0}', "ok", "7 scrapes, the last 9 s ago"),
        ('{"scrapes":7,"age_s":301.0}', "warning", "for 5 minutes, after 7 scrapes"),
        ("<html>", "error", "is not imud"),
    ]:
        running.pages[AT] = page
        running.tells(PROMETHEUS, severity, words)
    for age_s, severity in [(300.0, "note"), (301.0, "warning")]:
        running.configure(more="metrics: {port: 9321}\n")
        running.pages[AT] = f'{{"scrapes":0,"age_s":{age_s}}}'
        examined = examine([PROMETHEUS], running.surroundings())
        assert [finding.severity for finding in examined[0].findings] == [severity]
        assert exit_status(examined) == (severity == "warning")


def test_no_answer_another_address_and_switched_off(running: Machine) -> None:
    running.tells(PROMETHEUS, "error", "do not reply at 127.0.0.1 port 9321: Connection refused")
    running.configure(more="metrics: {enabled: false}\n")
    assert running.find(PROMETHEUS)[0].severity == "note"
    running.configure(more="metrics: {port: 0}\n")
    assert running.find(PROMETHEUS)[0].severity == "not checked"
    running.configure(more="metrics: {address: 0.0.0.0}\n")
    running.pages[AT] = '{"scrapes":7,"age_s":9.0}'
    assert running.find(PROMETHEUS)[0].severity == "ok"


def test_without_daemon_or_configuration(machine: Machine) -> None:
    assert machine.find(PROMETHEUS)[0].severity == "not checked"
    machine.configure()
    assert "no daemon runs" in machine.told(PROMETHEUS)[0][1]


def test_the_endpoint_itself_is_understood(running: Machine) -> None:
    async def serve() -> list[str]:
        made = MetricsPublisher(MetricsOptions(port=0), publisher_context(lambda: (), 1, lambda: 5_000_000_000))
        made.start()
        pages = []
        try:
            pages.append(await asyncio.to_thread(fetch_over_http, "127.0.0.1", made.port, "/scrapes"))
            await ask(made.port)
            pages.append(await asyncio.to_thread(fetch_over_http, "127.0.0.1", made.port, "/scrapes"))
            with pytest.raises(OSError, match="got 404"):
                await asyncio.to_thread(fetch_over_http, "127.0.0.1", made.port, "/other")
        finally:
            made.close()
        return pages

    severities = []
    for page in asyncio.run(serve()):
        running.pages[AT] = page
        severities.append(str(running.find(PROMETHEUS)[0].severity))
    assert severities == ["note", "ok"]


RINGS, FLIGHT = "shm: {directory: /dev/shm}\n", "recorder: {flight: {enabled: true, directory: /dev/shm/imud-flight}}\n"


@pytest.mark.parametrize(
    ("more", "removes", "severities"),
    [
        (RINGS + FLIGHT, "yes", ["warning", "warning"]), (RINGS + FLIGHT, "no", ["ok", "ok"]),
        (FLIGHT, "yes", ["warning"]), (FLIGHT.replace("true", "false"), "yes", []),
        ("shm: {directory: /dev/shmem}\n", "yes", []), ("", "yes", []),
    ],
)  # fmt: skip
def test_files_in_shared_memory_that_systemd_removes(
    machine: Machine, more: str, removes: str, severities: list[str]
) -> None:
    machine.configure(more=more)
    assert machine.find(SHARED) == [], "without a service nothing removes them"
    machine.unit(f"RemoveIPC={removes}")
    told = machine.told(SHARED)
    assert [severity for severity, _ in told] == severities
    assert all("RemoveIPC=no" in text for severity, text in told if severity == "warning")
