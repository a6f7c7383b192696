"""The server of the protocol of openpi: `websocket_policy_server.py` of Physical Intelligence.

A client connects, receives the metadata, and sends one observation for each action. Frames are
binary, MessagePack with arrays. A text frame is an error.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import http
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

import grpc
import numpy as np
import websockets
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.frames import CloseCode

from spikeserve.async_client import AsyncClient
from spikeserve.async_session import AsyncSession
from spikeserve.channels import ClientOptions
from spikeserve.check import check, names_like
from spikeserve.errors import (
    PermissionDeniedError,
    SessionLostError,
    SpikeserveError,
    UnauthenticatedError,
)
from spikeserve.gateway.connection import Connection
from spikeserve.gateway.mapping import ObservationMapping, Step
from spikeserve.gateway.numpy_msgpack import pack, unpack
from spikeserve.gateway.places import Places
from spikeserve.gateway.turns import Turns
from spikeserve.printing import say
from spikeserve.spaces import Discrete
from spikeserve.values import Decision, EpisodeSummary, Policy, SessionOptions

_API_KEY = "Api-Key "  # of the header Authorization, as openpi-client sends it
_LONGEST_REASON = 120  # bytes, of a close frame
_LONGEST_ERROR = 1024  # characters, of a text frame
_CROWDED = "connections: expected no more of one token than are free; try again later"


@dataclass(frozen=True)
class GatewaySettings:
    """What a gateway serves."""

    policy: str
    session: SessionOptions = field(default_factory=SessionOptions)
    mapping: ObservationMapping = field(default_factory=ObservationMapping)
    server: str | None = None  # None: as Client
    credentials: grpc.ChannelCredentials | None = None
    max_connections: int = 512  # which tokens divide; see Places
    max_message_bytes: int = 1 << 20  # four images of 224 x 224 are 0.6 MB
    # Of the gateway's own call when it starts. A connection has the token of its API key, or none:
    # whoever reaches the gateway, perhaps through a proxy, does not get the rights of another.
    token: str = ""


class OpenpiGateway:
    """Answers clients of openpi. A connection is a session. Belongs to one event loop."""

    def __init__(self, settings: GatewaySettings) -> None:
        self._settings = settings
        self._clients: dict[str, tuple[AsyncClient, int]] = {}  # by token, with their users
        self._connections = Places(settings.max_connections)
        self._known: collections.Counter[str] = collections.Counter()  # tokens of connections
        self._turns = Turns()

    async def listen(self, host: str, port: int) -> Server:
        """Starts to listen. Port 0 picks one."""
        return await serve(
            self._handle,
            host,
            port,
            create_connection=Connection,
            origins=[None],  # no web page: openpi-client sends no Origin
            process_request=self._admit,
            compression=None,
            max_size=self._settings.max_message_bytes,
            max_queue=1,  # a client that sends faster than it is answered waits
            server_header=None,
        )

    async def _admit(self, connection: ServerConnection, request: Any) -> Any:
        """Answers a request that does not become a connection, with the reason as its body."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        token = _token_of(request)
        if token is None:
            text = "authorization: expected one header Api-Key TOKEN, received another form\n"
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, text)
        if not self._connections.has(_group_of(connection, token)):
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{_CROWDED}\n")
        try:
            async with self._turn(connection, token) as has_turn:
                if not has_turn:
                    return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{_CROWDED}\n")
                async with self._client(token) as client:
                    await self._find_policy(client)
        except UnauthenticatedError as error:
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, f"{error}\n")
        except PermissionDeniedError as error:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{error}\n")
        except (SpikeserveError, ValueError) as error:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{error}\n")
        return None

    def _turn(
        self, connection: ServerConnection, token: str
    ) -> contextlib.AbstractAsyncContextManager[bool]:
        """Returns the turn of a request: at once if a connection has its token, which is known."""
        if token in self._known:
            return contextlib.nullcontext(True)
        return self._turns.turn(str(connection.remote_address[0]))

    @contextlib.asynccontextmanager
    async def _client(self, token: str) -> AsyncIterator[AsyncClient]:
        """Yields the client of a token, which connections with the same token share."""
        settings = self._settings
        client, users = self._clients.get(token, (None, 0))
        if client is None:
            client = AsyncClient(settings.server, ClientOptions(token=token), settings.credentials)
        self._clients[token] = (client, users + 1)
        try:
            yield client
        finally:
            _, users = self._clients[token]
            if users > 1:
                self._clients[token] = (client, users - 1)
            else:
                del self._clients[token]
                await client.close()

    async def check_policy(self) -> None:
        """ValueError unless the server serves the policy, and the mapping fits it."""
        try:
            async with self._client(self._settings.token) as client:
                await self._find_policy(client)
        except UnauthenticatedError:
            if self._settings.token:
                raise  # without one, the tokens of clients decide

    async def _find_policy(self, client: AsyncClient) -> Policy:
        name, version = self._settings.policy, self._settings.session.version
        policies = await client.list_policies()
        for policy in policies:
            is_wanted = policy.version == version if version else policy.is_default
            if policy.name == name and is_wanted:
                size, length = policy.observation_size, self._settings.mapping.length
                expected = f"{size} numbers, as {name} observes"
                check(length in (None, size), "mapping: observation", expected, length)
                return policy
        served = names_like(name, (policy.name for policy in policies))
        wanted = f"{name}/{version}" if version else name
        raise ValueError(f"policy: expected one that is served ({served}), received {wanted}")

    async def _handle(self, connection: ServerConnection) -> None:
        token = _token_of(connection.request)
        assert token is not None  # _admit has refused the others
        with self._connections.taken(_group_of(connection, token)) as is_taken:
            if not is_taken:  # others were faster
                await connection.close(CloseCode.TRY_AGAIN_LATER, _CROWDED)
                return
            try:
                self._known[token] += 1
                async with self._client(token) as client:
                    await self._converse(connection, client)
            except websockets.ConnectionClosed:
                pass
            except SpikeserveError as error:
                await _fail(connection, error)
            finally:
                self._known[token] -= 1
                self._known += collections.Counter()  # forgets tokens without connections

    async def _converse(self, connection: ServerConnection, client: AsyncClient) -> None:
        """Answers the frames of a connection. Its session is replaced by `_Robot` if it is lost."""
        robot = _Robot(client, self._settings)
        async with robot:
            await connection.send(pack(self._metadata(robot.session)))
            previous = None
            async for frame in connection:
                began = time.monotonic()
                answer = robot.answer(frame)
                del frame  # it may be large, and would be kept until the next one was received
                try:
                    reply = await answer
                except SessionLostError:
                    raise
                except (ValueError, SpikeserveError) as error:
                    # The session is as it was, so the client may continue.
                    await connection.send(_short(error))
                    continue
                reply["server_timing"] = {"infer_ms": (time.monotonic() - began) * 1000}
                if previous is not None:
                    reply["server_timing"]["prev_total_ms"] = previous * 1000
                await connection.send(pack(reply))
                previous = time.monotonic() - began

    def _metadata(self, session: AsyncSession) -> dict[str, Any]:
        opening = session.opening
        assert opening is not None
        space: dict[str, Any]
        if isinstance(opening.action_space, Discrete):
            space = {"type": "Discrete", "n": opening.action_space.n}
        else:
            low, high = (
                np.asarray(bound, np.float32)
                for bound in (opening.action_space.low, opening.action_space.high)
            )
            space = {"type": "Box", "low": low, "high": high}
        mapping = self._settings.mapping
        return {
            "server": "spikeserve",
            "policy": opening.policy,
            "version": opening.version,
            "session_id": session.session_id,
            "observation_size": opening.observation_size,
            "observation_keys": [part.key for part in mapping.observation],
            "reset_key": mapping.reset,
            "reward_key": mapping.reward,
            "action_space": space,
            "action_horizon": 1,
            "context_length": opening.context_length,
            "target_return": opening.target_return,
            "recording": opening.recording,
        }


class _Robot:
    """The session of a connection. Use it as a context."""

    def __init__(self, client: AsyncClient, settings: GatewaySettings) -> None:
        self._client = client
        self._settings = settings
        self.session: AsyncSession

    async def __aenter__(self) -> None:
        await self._open()

    async def __aexit__(self, *_: object) -> None:
        await self.session.close()

    async def _open(self) -> None:
        settings = self._settings
        names = settings.mapping.names
        opening = self._client.open_session(settings.policy, settings.session, observation=names)
        self.session = await opening

    async def answer(self, frame: str | bytes) -> dict[str, Any]:
        """Answers a message. SessionLostError if the server has lost the session of its episode.

        If a message begins an episode, it gets a new session: a robot may pause for longer than
        the server keeps one.
        """
        check(isinstance(frame, bytes), "message", "a binary frame", "a text frame")
        assert isinstance(frame, bytes)
        message = unpack(frame)
        step = self._read(message)
        begins = step.reset or self.session.step == 0
        try:
            return await self._perform(step)
        except SessionLostError:
            if not begins or step.terminated or step.truncated:
                raise
        await self._open()
        return await self._perform(self._read(message))

    def _read(self, message: Any) -> Step:
        assert self.session.opening is not None
        return self._settings.mapping.read(message, self.session.opening.observation_size)

    async def _perform(self, step: Step) -> dict[str, Any]:
        session = self.session
        if step.terminated or step.truncated:
            check(session.step > 0, "episode", "an action before its end", "none")
            return _ended(await _end(session, step))
        if step.reset and session.step > 0:
            cut_off = Step(step.observation, step.reward, truncated=True)
            await _end(session, cut_off, with_observation=False)
        return _acted(await session.act(step.observation, step.reward))


async def _end(session: AsyncSession, step: Step, with_observation: bool = True) -> EpisodeSummary:
    return await session.end_episode(
        step.reward,
        step.terminated,
        step.truncated,
        observation=step.observation if with_observation else None,
    )


def _acted(decision: Decision) -> dict[str, Any]:
    """Returns an answer. Arrays have a leading dimension, the horizon of openpi, which is 1."""
    discrete = isinstance(decision.action, int)
    action = np.asarray(decision.action, np.int64 if discrete else np.float32)
    reply: dict[str, Any] = {
        "actions": action.reshape(1, -1),
        "step": decision.step,
        "return_to_go": decision.return_to_go,
        "spikes": decision.stats.spikes,
        "policy_timing": {"infer_ms": decision.stats.compute_seconds * 1000},
    }
    if decision.action_probabilities is not None:
        reply["action_probabilities"] = decision.action_probabilities.reshape(1, -1)
    return reply


def _ended(summary: EpisodeSummary) -> dict[str, Any]:
    return {
        "episode_return": summary.episode_return,
        "steps": summary.steps,
        "spikes": summary.spikes,
        "recording": summary.recording,
    }


def _token_of(request: Any) -> str | None:
    """Returns the token of the API key, "" without a header; None: the header has another form."""
    headers: list[str] = request.headers.get_all("Authorization")
    if not headers:
        return ""
    if len(headers) > 1 or not headers[0].startswith(_API_KEY):
        return None
    token = headers[0][len(_API_KEY) :]
    return token if token.isascii() and token.isprintable() else None  # else gRPC cannot send it


def _group_of(connection: ServerConnection, token: str) -> str:
    """Returns what connections share places by: their token, or without one their address."""
    return token or str(connection.remote_address[0])


def _short(error: Exception) -> str:
    text = str(error)
    return text if len(text) <= _LONGEST_ERROR else text[:_LONGEST_ERROR] + "..."


async def _fail(connection: ServerConnection, error: SpikeserveError) -> None:
    """Sends an error and closes the connection, as openpi's server does."""
    say(f"spikeserve gateway: {_short(error)}", error=True)
    with contextlib.suppress(websockets.ConnectionClosed):
        await connection.send(_short(error))
    reason = str(error).encode()[:_LONGEST_REASON].decode(errors="ignore")
    await connection.close(CloseCode.INTERNAL_ERROR, reason)


async def run(gateway: OpenpiGateway, host: str, port: int, stop: asyncio.Event) -> None:
    """Serves until `stop` is set, and closes the sessions. Prints the address."""
    await gateway.check_policy()
    server = await gateway.listen(host, port)
    actual = server.sockets[0].getsockname()
    shown = f"[{actual[0]}]" if ":" in actual[0] else actual[0]
    say(f"spikeserve gateway: serving openpi on ws://{shown}:{actual[1]}")
    await stop.wait()
    server.close()
    await server.wait_closed()
