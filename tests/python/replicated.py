"""Three servers that share their sessions in one Redis server, and sessions of the Python client on them."""

import contextlib
import math
from dataclasses import asdict

import spikeserve
from links import Link
from redis_servers import DURABLE, Redis, stopping
from restartable_server import RestartableServer
from spikeserve.wire import METHODS

REPLICAS = 3
SESSIONS = 24
STEPS = 30
EPISODES = 2


class Fleet:
    """Redis and the replicas, and their links to Redis if they have some."""

    def __init__(self, redis, replicas, links):
        self.redis = redis
        self.replicas = replicas
        self.links = links

    @property
    def addresses(self):
        """Returns the servers as a client takes them."""
        return ",".join(replica.address for replica in self.replicas)


@contextlib.contextmanager
def running_fleet(*flags, replicas=REPLICAS, http=False, redis_flags=DURABLE, prefix=(), relays=(), linked=False):
    """Starts Redis and the replicas, which have HTTP ports if `http` and run with `prefix`, and yields the Fleet.

    `relays` are those of their datagrams; none: they take none. `linked`: each has a Link to Redis, in `Fleet.links`.
    """
    with stopping([Redis(*redis_flags, password="")]) as [redis], contextlib.ExitStack() as stack:
        started, links = [], []
        for relay in relays or [None] * replicas:
            if linked:
                links.append(stack.enter_context(Link(f"127.0.0.1:{redis.port}")))
            port = links[-1].port if linked else redis.port
            store = f"--session_store=redis://127.0.0.1:{port}"
            replica = RestartableServer(store, *flags, http=http, prefix=prefix, relay=relay)
            stack.callback(replica.kill)
            replica.start()
            started.append(replica)
        yield Fleet(redis, started, links)


def refusal_of(client, method, request):
    """Returns why a server refuses a request, which it has to do."""
    try:
        answer = client.call(method, request)
    except (spikeserve.FailedPreconditionError, spikeserve.InvalidArgumentError) as error:
        return error.message
    raise AssertionError(f"{method} of {request.session_id}: expected that it is refused, received {answer}")


def claim(client, session_id):
    """Lets a server own a session: it is asked to end an episode that no session has, which may be right for a newer copy."""
    refusal_of(client, "EndEpisode", METHODS["EndEpisode"].request(session_id=session_id, episode=2**31, steps=1))


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
