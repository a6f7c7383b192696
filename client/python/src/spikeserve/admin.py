"""`AdminClient` and `AsyncAdminClient`: the calls of operators, one method for each RPC.

The methods are made from the wire contract, so every RPC of PolicyAdmin has one. A method takes the
fields of the request as keyword arguments and returns the response message, whose fields are its
attributes. The comments of the contract are the docstrings.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from spikeserve.async_connection import AsyncConnection
from spikeserve.caller import Caller
from spikeserve.calls import Call
from spikeserve.connection import Connection
from spikeserve.coroutines import blocking
from spikeserve.wire import ADMIN_METHODS, ADMIN_SERVICE, Message, comment_of

# Loading a version reads files and tries the policy, which takes longer than a decision.
TIMEOUT = 60.0


class AdminClient(Connection):
    """The calls of PolicyAdmin at the server "HOST:PORT". Thread-safe.

    For example `admin.set_default_version(policy="cartpole", version=2).version`. The `data` of
    `push_policy` is a list of the parts of the file, of any sizes. The arguments of the constructor
    are those of Client, with a longer timeout unless the options have another one than theirs.
    """

    _table = ADMIN_METHODS
    _default_timeout = TIMEOUT

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Callable[..., Any]: ...


class AsyncAdminClient(AsyncConnection):
    """Asyncio form of AdminClient. Its methods are coroutines."""

    _table = ADMIN_METHODS
    _default_timeout = TIMEOUT

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Callable[..., Any]: ...


def method_name(rpc: str) -> str:
    """Returns the name of the method for an RPC: set_default_version for SetDefaultVersion."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", rpc).lower()


def _describe(rpc: str, fields: dict[str, Any], timeout: float | None) -> Call[Message]:
    method = ADMIN_METHODS[rpc]
    request = method.request(**fields)
    return Call(rpc, request, lambda response: response, timeout, repeatable=method.repeatable)


def _asynchronous(rpc: str) -> Callable[..., Any]:
    async def call(self: Caller, *, timeout: float | None = None, **fields: Any) -> Message:
        return await self.perform(_describe(rpc, fields, timeout))

    return call


def _signature(rpc: str) -> inspect.Signature:
    keyword = inspect.Parameter.KEYWORD_ONLY
    names = [field.name for field in ADMIN_METHODS[rpc].request.DESCRIPTOR.fields] + ["timeout"]
    return inspect.Signature(
        [inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)]
        + [inspect.Parameter(name, keyword, default=None) for name in names]
    )


def _add_methods(client: type, make: Callable[[str], Callable[..., Any]]) -> None:
    for rpc in ADMIN_METHODS:
        method = make(rpc)
        method.__name__ = method_name(rpc)
        method.__qualname__ = f"{client.__name__}.{method.__name__}"
        method.__doc__ = comment_of(ADMIN_SERVICE, rpc)
        method.__signature__ = _signature(rpc)  # type: ignore[attr-defined]
        setattr(client, method.__name__, method)


_add_methods(AdminClient, lambda rpc: blocking(_asynchronous(rpc)))
_add_methods(AsyncAdminClient, _asynchronous)
