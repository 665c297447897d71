"""Contract: what takes news of a feed in tests, which wait for what they need."""

from collections.abc import Callable
from queue import Queue

from imud.client.feed import News

LIMIT_S = 60.0


class Listener:
    """Takes news; the test waits for what it needs."""

    def __init__(self) -> None:
        self._news: Queue[News] = Queue()
        self.on_news = self._news.put

    def wait_for(self, is_there: Callable[[News], object]) -> News:
        """Return the first news of which something holds; those before are gone."""
        while not is_there(news := self._news.get(timeout=LIMIT_S)):
            pass
        return news
