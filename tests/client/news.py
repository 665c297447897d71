"""A receiver of `News` for tests."""

from collections.abc import Callable
from queue import Queue

from imud.client.feed import News

LIMIT_S = 60.0


class Listener:
    """A receiver that waits for a condition."""

    def __init__(self) -> None:
        self._news: Queue[News] = Queue()
        self.on_news = self._news.put

    def wait_for(self, is_there: Callable[[News], object]) -> News:
        """Return the first `News` that fulfills a condition. Discard earlier `News`."""
        while not is_there(news := self._news.get(timeout=LIMIT_S)):
            pass
        return news
