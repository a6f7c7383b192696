"""Reads policy files for the contestants in Python."""

import json
import math
import struct

import numpy as np


def read_policy_file(path):
    """Returns the tensors as arrays by name, and the metadata."""
    with open(path, "rb") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        header = json.loads(file.read(size))
        data = bytearray(file.read())
    metadata = header.pop("__metadata__")
    tensors = {
        name: np.frombuffer(data, np.float32, math.prod(entry["shape"]), entry["data_offsets"][0]).reshape(entry["shape"])
        for name, entry in header.items()
    }
    return tensors, metadata
