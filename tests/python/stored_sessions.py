"""Plays many sessions on a server with a store, and compares what it answers."""

import contextlib
import math

import grpc
import pytest
from security import until
from serving import SHIPPED_POLICIES, message_class, running_server

SESSIONS = 64
STEPS = 40
EPISODES = 2
DEADLINE_SECONDS = 60
LEARNING = [
    None,
    None,
    {"modulator": "target", "learning_rate": 0.05},
    {"modulator": "realized", "learning_rate": 0.5},
]


def opening(i):
    """Returns the request that opens session i: greedy, sampled, or learning by itself, on two policies."""
    fields = {
        "session_id": f"{i:032x}",
        "policy": ["cartpole", "pendulum"][i % 2],
        "version": 1 + i // 8 % 2 if i % 2 == 0 else 1,
        "seed": i,
        "durability": "SYNC",
    }
    kind = i // 2 % 4
    if kind > 0:
        fields |= {"action_selection": "SAMPLE", "temperature": 0.7}
    if LEARNING[kind] is not None:
        fields["learning"] = LEARNING[kind]
    return fields


def observation(i, t):
    size = [4, 3][i % 2]
    return [0.3 * math.sin(0.7 * t + i + k) for k in range(size)]


def acting(i, episode, step):
    t = episode * STEPS + step
    return {
        "session_id": f"{i:032x}",
        "step": step,
        "decision": t,
        "observation": observation(i, t),
        "reward": 0.1 * (t % 7),
    }


def ending(i, episode):
    return {
        "session_id": f"{i:032x}",
        "reward": 1.0 + i,
        "terminated": True,
        "episode": episode,
        "steps": STEPS,
    }


def comparable(response):
    """Returns the bytes of an answer without what differs from run to run."""
    copy = type(response)()
    copy.CopyFrom(response)
    copy.stats.ClearField("compute_seconds")
    copy.ClearField("durable_decision")
    return copy.SerializeToString(deterministic=True)


class Restartable:
    """A server that can be killed and started again on the same store."""

    def __init__(self, store, flags=(), policies=SHIPPED_POLICIES, log=None, prefix=()):
        self.log = log
        self.prefix = prefix
        self.flags = [f"--session_store={store}", *flags]
        self.policies = policies
        self.stack = contextlib.ExitStack()

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.close()

    def start(self):
        self.addresses = self.stack.enter_context(
            running_server(self.policies, self.flags, self.log, self.prefix)
        )

    def restart(self):
        self.close()
        self.start()

    def __getattr__(self, name):
        """Returns an attribute of the running server, or a method of its PolicyService."""
        return getattr(self.addresses if hasattr(self.addresses, name) else self.addresses.agent, name)

    def close(self):
        """Kills the server. Asserts that it has not ended otherwise."""
        self.kill()
        self.stack.close()


@contextlib.contextmanager
def replicas_on(redis, count=2, **options):
    """Starts servers that share one store. A test may stop or kill them."""
    with contextlib.ExitStack() as stack:
        store = f"redis://127.0.0.1:{redis.port}"
        started = tuple(stack.enter_context(Restartable(store, **options)) for _ in range(count))
        yield started
        for server in started:
            server.resume()


def play(service, disturb=lambda episode, step: None, batch=None, **fields):
    """Plays all sessions, opened with more `fields`, and returns everything that the server answered, by session."""
    batch = batch or (lambda requests: service().ActBatch(requests=requests))
    answers = {i: [] for i in range(SESSIONS)}
    for i in range(SESSIONS):
        service().OpenSession(**opening(i) | fields)
    for episode in range(EPISODES):
        for step in range(STEPS):
            disturb(episode, step)
            response = batch([acting(i, episode, step) for i in range(SESSIONS)])
            for i, result in enumerate(response.results):
                assert result.code == 0, result
                answers[i].append(comparable(result.response))
        for i in range(SESSIONS):
            ended = service().EndEpisode(**ending(i, episode))
            answers[i].append(ended.SerializeToString(deterministic=True))
    for i in range(SESSIONS):
        view = service().GetSession(session_id=f"{i:032x}", include_head_delta=True)
        answers[i].append(view.SerializeToString(deterministic=True))
    return answers


def learn(service, seed=1):
    """Plays an episode that teaches the shared head of the default version of cartpole."""
    learning = {"scope": "FLEET", "modulator": "realized", "learning_rate": 0.5}
    fields = {"action_selection": "SAMPLE", "seed": seed, "learning": learning}
    session = service.OpenSession(policy="cartpole", **fields).session_id
    for step in range(20):
        service.Act(session_id=session, step=step, observation=[0.1, 0.2, -0.1, 0.0], reward=float(step % 3))
    service.EndEpisode(session_id=session, reward=5.0, terminated=True)


def undisturbed_play():
    """Plays all sessions on a server without a store."""
    with Restartable("memory") as server:
        return play(lambda: server, durability="NONE")


def expected_decision(channel, error):
    """Returns the decision that the details of an error name."""
    trailers = dict(error.trailing_metadata())
    status = message_class(channel, "google.rpc.Status")
    [detail] = status.FromString(trailers["grpc-status-details-bin"]).details
    info = message_class(channel, "google.rpc.ErrorInfo")()
    assert detail.Unpack(info)
    assert (info.reason, info.domain) == ("OUT_OF_ORDER", "spikeserve")
    return int(info.metadata["expected_decision"])


def until_answered(call):
    """Repeats a call while its outcome is UNAVAILABLE, as the client libraries do, and returns the answer."""

    def answers():
        try:
            return [call()]
        except grpc.RpcError as error:
            assert error.code() == grpc.StatusCode.UNAVAILABLE, error
            return []

    return until(answers)[0]


def decide(server, i, decision):
    """Returns what session i answers in the end."""
    return comparable(until_answered(lambda: server.Act(**acting(i, 0, decision))))


def decisions(server, i, begin, end):
    return [decide(server, i, decision) for decision in range(begin, end)]


def decision_instead_of(server, i, decision):
    """Returns the decision that the server expects in the place of one that it refuses in the end."""

    def refused():
        with pytest.raises(grpc.RpcError) as error:
            server.Act(**acting(i, 0, decision))
        return error.value if error.value.code() != grpc.StatusCode.UNAVAILABLE else None

    error = until(refused)
    assert error.code() == grpc.StatusCode.FAILED_PRECONDITION
    return expected_decision(server.channel, error)


def undisturbed_answers(sessions):
    """Returns the answers of the first episode of each session, by session, on a server that nothing disturbs."""
    answers = {}
    with Restartable("memory") as server:
        for i in sessions:
            server.OpenSession(**opening(i) | {"durability": "NONE"})
            answers[i] = [comparable(server.Act(**acting(i, 0, step))) for step in range(STEPS)]
    return answers
