"""The protocol of openpi-client 0.1.2, written from its source, because the package needs NumPy 1."""

import functools

import msgpack
import numpy as np
from websockets.sync.client import connect


def pack_array(value):
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return value


def unpack_array(value):
    if b"__ndarray__" in value:
        return np.ndarray(buffer=value[b"data"], dtype=np.dtype(value[b"dtype"]), shape=value[b"shape"])
    if b"__npgeneric__" in value:
        return np.dtype(value[b"dtype"]).type(value[b"data"])
    return value


packb = functools.partial(msgpack.packb, default=pack_array)
unpackb = functools.partial(msgpack.unpackb, object_hook=unpack_array)


class WebsocketClientPolicy:
    """Does what the class of this name does."""

    def __init__(self, address, api_key=None):
        headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self.ws = connect(address, compression=None, max_size=None, additional_headers=headers)
        self.metadata = unpackb(self.ws.recv())

    def infer(self, observation):
        self.ws.send(packb(observation))
        response = self.ws.recv()
        if isinstance(response, str):
            raise RuntimeError(f"Error in inference server:\n{response}")
        return unpackb(response)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ws.close()
