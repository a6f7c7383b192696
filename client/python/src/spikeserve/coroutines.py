"""Runs coroutines without an event loop, so that the blocking and the asyncio client share them.

The calls of both are written once, as coroutines. What a blocking connection awaits blocks the
thread and is done when it returns, so that its coroutines end without being suspended.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def finish(work: Coroutine[Any, Any, T]) -> T:
    """Returns the result of a coroutine that is never suspended."""
    try:
        work.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise RuntimeError(f"{work}: expected its result, received a wait for an event loop")


def blocking(
    method: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Any, P], T]:
    """Returns the blocking form of a method of an asyncio class, for the blocking class."""

    @functools.wraps(method)
    def call(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return finish(method(self, *args, **kwargs))

    return call
