"""Serves a trivial policy as openpi's WebsocketPolicyServer does: openpi_server.py HOST PORT. Prints "ready".

Runs in the Python of openpi-client. The policy swings Pendulum up by its energy, and holds it.
"""

import asyncio
import contextlib
import sys

import numpy as np
from openpi_client import msgpack_numpy
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed


def infer(observation):
    """Returns the action for an observation."""
    cosine, sine, speed = observation["observation"]
    if cosine > 0.9:
        torque = -10.0 * sine - 2.0 * speed
    else:
        torque = 2.0 if speed * (speed**2 / 6 + 5.0 * cosine - 5.0) < 0 else -2.0
    return {"actions": np.clip(np.float32([[torque]]), -2.0, 2.0)}


async def answer(connection):
    packer = msgpack_numpy.Packer()
    with contextlib.suppress(ConnectionClosed):
        await connection.send(packer.pack({}))
        async for message in connection:
            await connection.send(packer.pack(infer(msgpack_numpy.unpackb(message))))


async def main():
    async with serve(answer, sys.argv[1], int(sys.argv[2]), compression=None, max_size=None) as server:
        print("ready", flush=True)
        await server.serve_forever()


asyncio.run(main())
