"""Reads and writes policy files with NumPy only: tensors by name, and metadata strings. Floats are written as float32."""

import json

import numpy as np


DTYPES = {"F32": "<f4", "I16": "<i2", "I8": "<i1"}  # by name in the file, widest first


def read_policy(path):
    data = path.read_bytes()
    header_end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:header_end])
    metadata = header.pop("__metadata__")
    tensors = {}
    for name, entry in header.items():
        begin, end = (header_end + offset for offset in entry["data_offsets"])
        dtype = DTYPES[entry["dtype"]]
        tensors[name] = np.frombuffer(data[begin:end], dtype).reshape(entry["shape"]).copy()
    return tensors, metadata


def write_policy(path, tensors, metadata):
    header, chunks, offset = {"__metadata__": metadata}, [], 0
    for name, tensor in sorted(tensors.items()):
        dtype = next((key for key, kind in DTYPES.items() if tensor.dtype == kind), "F32")
        chunk = np.ascontiguousarray(tensor, DTYPES[dtype]).tobytes()
        header[name] = {
            "dtype": dtype,
            "shape": list(tensor.shape),
            "data_offsets": [offset, offset + len(chunk)],
        }
        chunks.append(chunk)
        offset += len(chunk)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.parent.mkdir(parents=True)
    path.write_bytes(len(text).to_bytes(8, "little") + text + b"".join(chunks))


def copy_without_wiring(source, destination):
    """Copies a version of a policy without its model of the wiring, for sessions that do not play as in training."""
    tensors, metadata = read_policy(source / "policy.safetensors")
    del metadata["wiring"]
    write_policy(destination / "policy.safetensors", tensors, metadata)


def without_norms(tensors, metadata):
    """Returns a policy in float32 as one without norms."""
    config = json.dumps(json.loads(metadata["config"]) | {"norm": "none"})
    return {name: tensor for name, tensor in tensors.items() if ".norm." not in name}, metadata | {"config": config}
