"""A server whose every answer means harm to the terminal or the memory of the client that asked it."""

import contextlib
import math
import os
import random
import subprocess
from concurrent import futures

import grpc
from serving import DEADLINE_SECONDS
from spikeserve.wire import ADMIN_METHODS, METHODS

ESCAPES = "\x1b]52;c;aGk=\x07\x1b[2J\r\x9b2J\u202e"
MOST_BYTES = 1 << 30  # of spikectl

INTEGERS = (-5, 0, 1, (1 << 31) - 1, -(1 << 31), (1 << 63) - 1)
NUMBERS = (math.nan, math.inf, -1e30, 0.0, 1.0)


def scalar(field, random):
    """Returns a value that a client may not expect."""
    if field.enum_type is not None:
        return random.choice([0, 1, 77])
    if field.cpp_type in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
        return random.choice(NUMBERS)
    if field.cpp_type == field.CPPTYPE_BOOL:
        return random.random() < 0.5
    if field.cpp_type == field.CPPTYPE_STRING:
        return ESCAPES.encode() if field.type == field.TYPE_BYTES else ESCAPES
    least = 0 if field.cpp_type in (field.CPPTYPE_UINT32, field.CPPTYPE_UINT64) else -(1 << 31)
    greatest = (1 << 31) - 1 if field.cpp_type in (field.CPPTYPE_INT32, field.CPPTYPE_UINT32) else (1 << 63) - 1
    return random.choice([value for value in INTEGERS if least <= value <= greatest])


def fill(message, random, depth=0):
    """Fills most fields of a message with values that a client may not expect. Returns the message."""
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        nested = field.message_type
        if random.random() < 0.15 or field.name == "next_page_token" or (nested is not None and depth > 4):
            continue
        if nested is not None and nested.GetOptions().map_entry:
            of_map = nested.fields_by_name["value"]
            if of_map.message_type is None:
                value[ESCAPES] = scalar(of_map, random)
            else:
                fill(value[ESCAPES], random, depth + 1)
        elif hasattr(value, "add"):
            for _ in range(random.choice((1, 2, 5))):
                fill(value.add(), random, depth + 1)
        elif nested is not None:
            fill(value, random, depth + 1)
        elif hasattr(value, "extend"):
            value.extend([scalar(field, random) for _ in range(random.choice((1, 4, 9)))])
        else:
            setattr(message, field.name, scalar(field, random))
    return message


def plausible(message):
    """Lets a message describe a policy that plays CartPole, so that clients read on."""
    for part in message.policies if hasattr(message, "policies") else [message]:
        known = part.DESCRIPTOR.fields_by_name
        for name, value in {"environment": "CartPole-v1", "observation_size": 4, "context_length": 4, "step": 0}.items():
            if name in known:
                setattr(part, name, value)
        if "action_space" in known:
            part.action_space.discrete.n = 2
        if part is not message:
            part.name, part.version = "x", 1
    return message


def check_shown(output):
    """Asserts that a terminal obeys none of these bytes. Returns them as text."""
    text = output.decode()
    assert not [c for c in text if c not in "\n\t" and (ord(c) < 32 or 127 <= ord(c) < 160 or ord(c) == 0x202E)], text
    return text


# What spikectl asks of such a server.
POLICY = ("--policy=x", "--version=1")
COMMANDS = [
    *(["policies", *flags] for flags in ([], ["--all"], ["--features"])),
    *([command, "--env=CartPole-v1", "--episodes=1"] for command in ("run", "adapt")),
    ["explain", "--env=CartPole-v1", "--steps=2"],
    *([command, "--session=x"] for command in ("explain", "doctor")),
    *(["admin", action, *POLICY] for action in ("load", "unload", "default")),
    ["admin", "label", *POLICY, "--label=a"],
    ["admin", "unlabel", POLICY[0], "--label=a"],
    *(["admin", action, POLICY[0]] for action in ("rollout", "head", "promote_head", "reset_head", "undo_corrections", "pause_learning")),
    ["pull", "pulled.safetensors", *POLICY],
    ["rm", *POLICY],
    ["hold", POLICY[0], "--wait=0s"],
    ["resume", "--id=x"],
    ["holds"],
    ["take", "--session=x", "--attention=0s"],
    *(["admin", action] for action in ("rollouts", "history", "reload", "sessions", "drain")),
]


class RandomAnswers(grpc.GenericRpcHandler):
    """Answers every call of the contract with values that nobody expects."""

    def __init__(self):
        self.begin(0)

    def begin(self, seed):
        """Begins another sequence of answers. Three of four describe a policy, so that clients read on."""
        self._random = random.Random(seed)
        self._is_plausible = seed % 4 > 0

    def _answer(self, method):
        message = fill(method.response(), self._random)
        return plausible(message) if self._is_plausible else message

    def service(self, details):
        """Returns the handler of a method."""
        method = (METHODS | ADMIN_METHODS).get(details.method.rpartition("/")[2])
        if method is None:  # a health check: SERVING
            return grpc.unary_unary_rpc_method_handler(lambda *_: b"\x08\x01")
        make = grpc.stream_stream_rpc_method_handler if method.streams else grpc.unary_unary_rpc_method_handler
        one, many = lambda *_: self._answer(method), lambda requests, _: (self._answer(method) for _ in requests)
        return make(many if method.streams else one, method.request.FromString, lambda message: message.SerializeToString())


@contextlib.contextmanager
def serving(handler):
    """Serves a generic handler. Yields HOST:PORT."""
    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers((handler,))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.stop(0).wait()


def spikectl(address, *arguments, token=""):
    """Runs spikectl with an end in time and memory. Returns its subprocess.CompletedProcess."""
    command = ["prlimit", f"--data={MOST_BYTES}", os.environ["SPIKECTL_PROGRAM"], *arguments, f"--server={address}"]
    environment = os.environ | {"SPIKESERVE_TOKEN": token}
    return subprocess.run(command, capture_output=True, timeout=DEADLINE_SECONDS, env=environment)
