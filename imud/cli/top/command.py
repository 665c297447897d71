"""`imud top`: watch all devices in the terminal; the thread that reads the daemon for it."""

import argparse
import sys
from collections.abc import Callable
from threading import Event as Flag
from threading import Thread
from time import monotonic, monotonic_ns
from typing import Final

import msgspec

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.top.history import News
from imud.client import Client
from imud.client.watch import EventStream, Watch, event_of
from imud.contracts.status import DeviceStatus
from imud.errors import BadArgument, ImudError
from imud.event import Event
from imud.sample import Sample

NEWS_S: Final = 0.25
"""Time between two pieces of news."""
STATUS_S: Final = 1.0
"""Time between two looks at the status, for few devices."""
STATUS_DEVICES: Final = 50
"""With more devices the status is asked for less often: each costs the daemon some 50 µs."""
RETRY_S: Final = 1.0
OVERVIEW_HZ: Final = 4.0
DEVICE_HZ: Final = 20.0
SAMPLES_MAX: Final = 4096
"""Of one piece of news; what comes beyond waits in the socket, and the daemon counts what does not fit there."""


class Feed:
    """Reader of the daemon at `path`. Synchronization: `on_news` is called in the feed's thread."""

    def __init__(self, path: str, on_news: Callable[[News], None]) -> None:
        self._path = path
        self._on_news = on_news
        self._device: str | None = None
        self._stop = Flag()
        self._thread = Thread(target=self._run, name="feed", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End, within a second or so; may be called twice."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2 * STATUS_S)

    def look_at(self, device: str | None) -> None:
        """Read samples of this device only, and more of them; None for all devices."""
        self._device = device

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with Client(self._path) as client:
                    self._read(client)
            except (ImudError, TimeoutError) as error:
                self._on_news(News(str(error), now_ns=monotonic_ns()))
                self._stop.wait(RETRY_S)

    def _read(self, client: Client) -> None:
        """Read until the end, or until the connection is lost, which raises."""
        client.events()
        device, watch, status_due_s = self._device, _watch(client, self._device), 0.0
        while not self._stop.is_set():
            if self._device != device:
                device = self._device
                watch = _watch(client, device)
            news = News()
            if monotonic() >= status_due_s:
                answer = client.status()
                statuses = msgspec.convert(answer["devices"], tuple[DeviceStatus, ...])
                clients = len(answer["socket"]["clients"])
                news = News(statuses=statuses, clients=clients)
                status_due_s = monotonic() + STATUS_S * max(len(statuses) / STATUS_DEVICES, 1)
            samples = _samples(watch)
            self._on_news(news._replace(samples=samples, events=_events(client), now_ns=monotonic_ns()))


def _watch(client: Client, device: str | None) -> Watch:
    if device is None:
        return client.watch(rate_hz=OVERVIEW_HZ, timeout_s=NEWS_S)
    try:
        return client.watch([device], rate_hz=DEVICE_HZ, timeout_s=NEWS_S)
    except ImudError:  # it is not in the configuration any more; the next status shows that
        return client.watch(rate_hz=OVERVIEW_HZ, timeout_s=NEWS_S)


def _samples(watch: Watch) -> tuple[Sample, ...]:
    """Take what comes in NEWS_S."""
    found: list[Sample] = []
    end_s = monotonic() + NEWS_S
    try:
        while monotonic() < end_s and len(found) < SAMPLES_MAX:
            found.append(next(watch))
    except TimeoutError:
        pass
    return tuple(found)


def _events(client: Client) -> tuple[Event, ...]:
    """Take the events that came meanwhile."""
    found: list[Event] = []
    while isinstance(message := client.kept_message(EventStream.NAMES), dict):
        found.append(event_of(message.get("params", {})))
    return tuple(found)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud top`."""
    add_socket(parser)


def run(args: argparse.Namespace) -> int:
    """Show the table until `q`. Raises BadArgument without a terminal, or without the library that draws."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise BadArgument("imud top: expected a terminal; `imud status` and `imud watch` write to anything")
    try:
        from imud.cli.top.app import TopApp
    except ModuleNotFoundError as error:
        raise BadArgument(f"imud top: it needs {error.name}: pip install 'imud[top]'") from None
    TopApp(lambda on_news: Feed(args.socket, on_news)).run()
    return 0


TOP = CliCommand(add_arguments, run)
