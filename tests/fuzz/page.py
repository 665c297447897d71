"""Messages of a page of `imud web`: the hub with two devices, and one message of a page per line."""

from collections.abc import Sequence
from typing import Final

import msgspec

from imud.client.feed import Feed, News, Wish
from imud.web.hub import DEVICES_MAX, FRAMES_MAX, Browser, BrowserHub
from imud.web.messages import RATES_HZ, SPECTRA, Look, decode_body
from imud.web.server import LOOK_BYTES_MAX
from tests.fuzz.target import Target
from tests.support.metrics import device
from tests.support.socket_rig import sample

SUBJECTS_MAX: Final = 4  # state, problem, and the statuses of two devices


class _Feed(Feed):
    """Feed without a thread. It stores the newest wish."""

    def __init__(self) -> None:
        super().__init__("", None)
        self.wish: Wish | None = None

    def want(self, wanted: Wish | None) -> None:
        self.wish = wanted


def names() -> Sequence[str]:
    return ["messages"]


def make(_name: str) -> Target:
    return Target(run, seeds, words=words)


def run(data: bytes) -> None:
    """Two pages send the lines in turn. The hub refuses a line with ValueError only, and its queues have limits."""
    hub = BrowserHub(lambda function, news: function(news))
    feed, compared = _Feed(), _Feed()
    hub.attach(feed, compared)
    browsers = (Browser(), Browser())
    for browser in browsers:
        hub.add(browser)
    news = News(statuses=(device("bow"), device("mast")), now_ns=sample("bow").t_ns, samples=(sample("bow"),))
    for number, line in enumerate(data.split(b"\n")):
        try:
            look = decode_body(line[:LOOK_BYTES_MAX].decode("utf-8", "replace"), Look)
        except ValueError:
            continue
        hub.look(browsers[number % 2], look)
        hub.spread(news)
    for browser in browsers:
        assert browser.mailbox.waiting <= FRAMES_MAX + SUBJECTS_MAX + len(browser.look.devices)
    for wish in (feed.wish, compared.wish):
        assert wish is None or len(wish.devices or ()) <= DEVICES_MAX
    assert len(hub._buckets) <= 2 * len(browsers)
    assert set(hub._arrival_ns) <= {"bow", "mast"}


def seeds() -> list[bytes]:
    looks = [Look("overview"), Look("nothing", acknowledged=2**62), Look("device", "none")]
    looks += [Look("device", "bow", rate_hz=rate_hz) for rate_hz in RATES_HZ]
    looks += [Look("device", "bow", "mast", spectrum=spectrum) for spectrum in SPECTRA]
    lines = [msgspec.json.encode(look) for look in looks]
    odd = [b"", b"{}", b"[]", b'{"look":"all"}', b'{"acknowledged":-5}', b'{"device":5}', b"[" * 5000, b"\xff"]
    return [b"\n".join(lines), b"\n".join(odd), *lines, b"\n".join(line for line in lines for _ in range(40))[:4000]]


def words() -> list[bytes]:
    members = [field.name for field in msgspec.structs.fields(Look)]
    values = ["overview", "device", "nothing", "bow", "mast", *SPECTRA, *map(str, RATES_HZ)]
    return [text.encode() for text in (*members, *values)]
