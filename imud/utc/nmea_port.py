"""RMC sentences from a GNSS receiver on a serial port of its own. The link that is given does the port's business."""

import asyncio

from imud.contracts.link import StreamLink
from imud.errors import LinkError
from imud.utc.reconnecting import ReconnectingSource
from imud.utc.retry import Retry
from imud.utc.source import MakePort, RmcSettings


class NmeaPortSource(ReconnectingSource):
    """A serial port that talks NMEA 0183."""

    def __init__(self, link: StreamLink, retry: Retry | None = None) -> None:
        super().__init__(f"NMEA receiver on {link.title}", retry)
        self._link = link
        self._ended = asyncio.Event()

    async def _listen(self) -> None:
        link = self._link
        self._ended.clear()
        self.problem = f"{self.title}: the port is not there"
        await link.wait_present()
        try:
            link.open()
            self.problem = f"{self.title} sent no sentence yet: is its rate {link.baud} bit/s?"
            link.start(self._take, self._end)
            await self._ended.wait()
        except LinkError as error:
            self.problem = str(error)
        finally:
            link.close()

    def _end(self, error: LinkError | None) -> None:
        self.problem = str(error) if error else f"{self.title} ended"
        self._ended.set()


def make(settings: RmcSettings, make_port: MakePort) -> NmeaPortSource:
    """The source."""
    return NmeaPortSource(make_port(settings.port, settings.baud))
