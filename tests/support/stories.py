"""Decorators of tests that are coroutines. Each test is a story that a bench runs.

`played` makes a bench for each test. `told` calls a function that runs a story. `in_bench` uses the fixture `bench`.
"""

import inspect
from collections.abc import Callable, Coroutine
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
Story = Coroutine[Any, Any, None]


class Bench(Protocol):
    """The environment of a test. It runs the test's story in its own time."""

    def play(self, story: Callable[[], Story], /) -> object: ...


B = TypeVar("B", bound=Bench)


def played(make: Callable[..., B]) -> Callable[[Callable[Concatenate[B, P], Story]], Callable[P, None]]:
    """Run a test on the bench that `make` returns. The bench is the first argument of the test.

    `make` receives the fixtures and parameters of the test with the names of its own parameters.
    """
    names = inspect.signature(make).parameters

    def decorate(test: Callable[Concatenate[B, P], Story]) -> Callable[P, None]:
        def run(*args: P.args, **kwargs: P.kwargs) -> None:
            bench = make(**{name: one for name, one in kwargs.items() if name in names})
            bench.play(partial(test, bench, *args, **kwargs))

        return _without_first_argument(run, test)

    return decorate


def told(
    play: Callable[..., object], *arguments: Any, **options: Any
) -> Callable[[Callable[Concatenate[T, P], Story]], Callable[P, None]]:
    """Pass a test to `play`, with these arguments. `play` gives the first argument of the test."""

    def decorate(test: Callable[Concatenate[T, P], Story]) -> Callable[P, None]:
        def run(*args: P.args, **kwargs: P.kwargs) -> None:
            def story(first: T) -> Story:
                return test(first, *args, **kwargs)

            play(story, *arguments, **options)

        return _without_first_argument(run, test)

    return decorate


def in_bench(test: Callable[P, Story]) -> Callable[P, None]:
    @wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        bench: Any = kwargs["bench"]
        bench.run(test(*args, **kwargs))

    return run


def _without_first_argument(run: Callable[P, None], test: Callable[..., Story]) -> Callable[P, None]:
    """Give `run` the name and the marks of a test, and its arguments without the first, which is not a fixture."""
    made = wraps(test)(run)
    del made.__wrapped__
    _, *rest = inspect.signature(test).parameters.values()
    made.__signature__ = inspect.Signature(rest)  # type: ignore[attr-defined]  # pytest reads the names of fixtures here
    return made
