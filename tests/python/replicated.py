"""Three servers that share their sessions in one Redis server, and sessions of the Python client on them."""

import contextlib
import math
import pathlib
import signal
import socket
import subprocess
import tempfile
import time
from dataclasses import asdict

import spikeserve
from restartable_server import RestartableServer
from serving import DEADLINE_SECONDS

REPLICAS = 3
SESSIONS = 24
STEPS = 30
EPISODES = 2


def free_port():
    """Returns a port on which nobody listens now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class Redis:
    """A Redis server that writes its file every second, and can be killed and started again."""

    def __init__(self, folder, host="127.0.0.1", prefix=()):
        self.host = host
        self.port = free_port()
        self._folder = folder
        self._prefix = prefix
        self._process = None

    @property
    def store(self):
        """Returns --session_store of this Redis."""
        return f"redis://{self.host}:{self.port}"

    def start(self):
        """Starts the server and waits until it answers."""
        self._process = subprocess.Popen(
            [
                *self._prefix,
                *("redis-server", "--bind", self.host, "--port", str(self.port), "--save", ""),
                *("--appendonly", "yes", "--appendfsync", "everysec", "--dir", str(self._folder)),
                *("--protected-mode", "no"),
            ],
            stdout=subprocess.DEVNULL,
        )
        deadline = time.monotonic() + DEADLINE_SECONDS
        while not self._answers():
            assert time.monotonic() < deadline, "redis-server does not answer"
            time.sleep(0.01)

    def kill(self):
        """Kills the server, which may be stopped."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(timeout=DEADLINE_SECONDS)

    def stop(self):
        """Keeps the server from running until `resume`."""
        self._process.send_signal(signal.SIGSTOP)

    def resume(self):
        """Lets a stopped server run again."""
        self._process.send_signal(signal.SIGCONT)

    def _answers(self):
        with contextlib.suppress(OSError):
            with socket.create_connection((self.host, self.port)) as connection:
                connection.sendall(b"PING\r\n")
                return connection.recv(5) == b"+PONG"
        return False


class Fleet:
    """Redis and the replicas."""

    def __init__(self, redis, replicas):
        self.redis = redis
        self.replicas = replicas

    @property
    def addresses(self):
        """Returns the servers as a client takes them."""
        return ",".join(replica.address for replica in self.replicas)


@contextlib.contextmanager
def running_fleet(*flags, replicas=REPLICAS, http=False):
    """Starts Redis and the replicas, which have HTTP ports if `http`, and yields the Fleet."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        redis = Redis(pathlib.Path(folder))
        stack.callback(redis.kill)
        redis.start()
        started = []
        for _ in range(replicas):
            replica = RestartableServer(f"--session_store={redis.store}", *flags, http=http)
            stack.callback(replica.kill)
            replica.start()
            started.append(replica)
        yield Fleet(redis, started)


def options_of(i, durability):
    """Returns the options of session i: greedy, sampled, or learning by itself."""
    learning = [
        None,
        None,
        spikeserve.Learning(modulator="target", learning_rate=0.05),
        spikeserve.Learning(modulator="realized", learning_rate=0.5),
    ][i % 4]
    sample = i % 4 > 0
    return spikeserve.SessionOptions(
        seed=i,
        sample=sample,
        temperature=0.7 if sample else None,
        learning=learning,
        durability=durability,
    )


def policy_of(i):
    """Returns the policy of session i."""
    return ["cartpole", "pendulum"][i // 4 % 2]


def observation(i, t):
    """Returns what session i observes at its decision t."""
    size = {"cartpole": 4, "pendulum": 3}[policy_of(i)]
    return [0.3 * math.sin(0.7 * t + i + k) for k in range(size)]


def reward(t):
    """Returns the reward before decision t."""
    return 0.1 * (t % 7)


def comparable(decision):
    """Returns what a decision must be, whichever servers made it."""
    values = asdict(decision)
    del values["durable_decision"], values["stats"]["compute_seconds"]
    return repr(values)


def comparable_state(state):
    """Returns what the state of a session must be, except its id."""
    values = asdict(state)
    del values["session_id"]
    head = values.pop("head_delta")
    return repr(values), None if head is None else head.tobytes()
