"""`python -m spikeserve.gateway --openpi` in front of a real server, called as openpi-client calls it."""

import asyncio
import concurrent.futures
import contextlib
import functools
import io
import json
import pathlib
import socket
import subprocess
import sys
import threading
import unittest.mock
import urllib.request

import gymnasium
import msgpack
import numpy as np
import pytest
import spikeserve
import websockets
from gateways import running_gateway
from security import until
from serving import running_server
from spikeserve.gateway.__main__ import main
from spikeserve.gateway.connection import Connection
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.sync.client import connect

SEED = 1_000_000
MAPPING = {
    "observation": [
        {"key": "state/cart", "size": 2},
        {"key": "pole", "elements": [2, 0], "size": 3, "scale": 0.5},
    ],
    "reward": "score",
}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def server(recordings):
    with running_server(flags=[f"--record_dir={recordings}"]) as started:
        yield started.grpc


@pytest.fixture(scope="module")
def gateway(server):
    with running_gateway(server, "--policy=cartpole", "--record", "--max-connections=3") as address:
        yield address


def play(policy, environment, seed, **first):
    """Plays an episode. Returns its return and the answers."""
    observation, _ = environment.reset(seed=seed)
    message = {"observation": observation, **first}
    answers, total, over = [], 0.0, False
    while not over:
        answers.append(policy.infer(message))
        action = int(answers[-1]["actions"][0, 0])
        observation, reward, terminated, truncated, _ = environment.step(action)
        total += reward
        message = {"observation": observation, "reward": reward}
        over = terminated or truncated
    ended = policy.infer(message | {"terminated": terminated, "truncated": truncated})
    assert (ended["episode_return"], ended["steps"]) == (total, len(answers))
    return total, answers


def test_cartpole_is_played(gateway, server):
    """The answers are those of the Python client, and the server has recorded whole episodes."""
    with gymnasium.make("CartPole-v1") as environment, WebsocketClientPolicy(gateway) as policy:
        assert policy.metadata["policy"] == "cartpole"
        assert policy.metadata["observation_size"] == 4
        assert policy.metadata["action_space"] == {"type": "Discrete", "n": 2}
        total, answers = play(policy, environment, SEED)
        assert total == 500
        assert answers[0]["actions"].shape == (1, 1) and answers[0]["actions"].dtype == np.int64
        assert "prev_total_ms" not in answers[0]["server_timing"]
        assert answers[1]["server_timing"]["prev_total_ms"] >= answers[0]["server_timing"]["infer_ms"] > 0
        assert answers[0]["policy_timing"]["infer_ms"] > 0
        with spikeserve.Client(server) as client, client.open_session("cartpole") as session:
            observation, _ = environment.reset(seed=SEED)
            for answer in answers[:20]:
                decision = session.act(observation, 1.0)
                assert answer["actions"][0, 0] == decision.action
                assert (answer["step"], answer["return_to_go"]) == (decision.step, decision.return_to_go)
                np.testing.assert_array_equal(answer["action_probabilities"][0], decision.action_probabilities)
                observation, *_ = environment.step(decision.action)
        again, _ = play(policy, environment, SEED)  # the next episode of the same session
        assert again == total


def test_a_reset_begins_an_episode(gateway):
    with WebsocketClientPolicy(gateway) as policy:
        observation = {"observation": np.zeros(4)}
        assert [policy.infer(observation)["step"] for _ in range(3)] == [0, 1, 2]
        assert policy.infer(observation | {"reset": True, "reward": 1.0})["step"] == 0
        assert policy.infer(observation | {"reset": np.bool_(False)})["step"] == 1
    with WebsocketClientPolicy(gateway) as another:
        assert another.metadata["session_id"] != policy.metadata["session_id"]
        assert another.infer(observation)["step"] == 0


def test_boxes_have_their_units(server):
    with running_gateway(server, "--policy=pendulum") as address, WebsocketClientPolicy(address) as policy:
        (high,) = policy.metadata["action_space"]["high"]
        assert high == 2.0
        answer = policy.infer({"observation": [1.0, 0.0, 0.0]})
        assert answer["actions"].shape == (1, 1) and answer["actions"].dtype == np.float32
        assert abs(answer["actions"][0, 0]) <= 2
        assert "action_probabilities" not in answer


def test_a_mapping_file_makes_the_vector(server, gateway, tmp_path):
    path = tmp_path / "mapping.json"
    path.write_text(json.dumps(MAPPING))
    cart, pole = np.float32([0.01, -0.02]), np.array([0.08, 99.0, 0.06])
    with running_gateway(server, "--policy=cartpole", f"--mapping={path}") as address:
        with WebsocketClientPolicy(address) as mapped, WebsocketClientPolicy(gateway) as plain:
            assert mapped.metadata["observation_keys"] == ["state/cart", "pole"]
            image = np.zeros((32, 32, 3), np.uint8)
            for step in range(3):
                entries = {"state": {"cart": cart}, "pole": pole, "score": 1.0, "image": image, "prompt": "balance"}
                answer = mapped.infer(entries)
                expected = plain.infer({"observation": [*cart, np.float32(0.03), np.float32(0.04)], "reward": 1})
                np.testing.assert_array_equal(answer["action_probabilities"], expected["action_probabilities"])
                assert answer["return_to_go"] == expected["return_to_go"]
            # A key with a slash, as most users of openpi write it.
            assert mapped.infer({"state/cart": cart, "pole": pole})["step"] == 3
            with pytest.raises(RuntimeError, match="pole: expected 3 numbers, received shape"):
                mapped.infer({"state/cart": cart, "pole": pole[:2]})


def array(dtype=b"<f4", data=b"\0" * 16, shape=(4,)):
    """Returns an array that no NumPy would encode like this."""
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype.decode(), b"shape": list(shape)}


BAD = {
    "missing": ({"state": [0.0]}, "observation: expected an entry, received a dictionary of state"),
    "short": ({"observation": np.zeros(3)}, "observation: expected 4 numbers, as the policy observes, received 3"),
    "nan": ({"observation": np.array([0, np.nan, 0, 0])}, "observation: expected finite numbers"),
    "text": ({"observation": "up"}, "observation: expected numbers, received str"),
    "ragged": ({"observation": [[1], [1, 2]]}, "observation: expected numbers, received list"),
    "list": ([1, 2], "observation: expected a dictionary, received list"),
    "reward": ({"observation": np.zeros(4), "reward": "much"}, "reward: expected a number, received str"),
    "infinite": ({"observation": np.zeros(4), "reward": np.inf}, "reward: expected a finite number, received inf"),
    "objects": ({"observation": array(b"|O")}, "array: dtype: expected numbers, such as <f4, received |O"),
    "dtype": ({"observation": array(b"<f9")}, "array: dtype: expected numbers, such as <f4, received '<f9'"),
    "bytes": ({"observation": array(data=b"\0" * 15)}, "array: data: expected 16 bytes, received 15"),
    "shape": ({"observation": array(shape=(-4,))}, "array: shape: expected sizes, received [-4]"),
    "huge": ({"observation": array(shape=(1 << 62, 1 << 62))}, "array: data: expected "),
    "end": ({"observation": np.zeros(4), "terminated": True}, "episode: expected an action before its end"),
}


def test_bad_input_gets_the_error_of_the_protocol(gateway):
    """A text frame. The session is as it was, so the client continues."""
    with WebsocketClientPolicy(gateway) as policy:
        for message, reason in BAD.values():
            with pytest.raises(RuntimeError) as refused:
                policy.infer(message)
            assert reason in str(refused.value)
        frames = (b"", b"\xc1", packb({}) + b"\0", b"\x91" * 5000, b"\xa1\xff", "text", msgpack.packb({1: 2}))
        for frame in frames:
            policy.ws.send(frame)
            assert isinstance(policy.ws.recv(), str)
        assert policy.infer({"observation": np.zeros(4)})["step"] == 0


HEADERS = {
    "an array of nothing": b"\xdd\x00\xff\xff\xff" + b"\xc0" * 0xFFFFFF,
    "a map of nothing": b"\xdf\x00\x7f\xff\xff" + b"\xc0" * 0xFFFFFF,
    "lists of lists": b"\xdc\x10\x00" + (b"\xdc\x10\x00" + b"\x90" * 4096) * 4096,
    "a length without its values": b"\xdd\xff\xff\xff\xff",
    "many short maps": b"\xdd\x00\x40\x00\x00" + b"\x82\xa1a\x01\xa1b\x02" * 0x400000,
}


@pytest.mark.parametrize("frame", HEADERS.values(), ids=HEADERS)
def test_lengths_are_bounded_before_anything_is_made(gateway, frame):
    with WebsocketClientPolicy(gateway) as policy:
        policy.ws.send(frame[: 1 << 20])
        assert policy.ws.recv() == (
            "message: expected at most 4096 values; send numbers as arrays, received more"
        )
        assert policy.infer({"observation": [0.0] * 4, "image": np.zeros((500, 500, 3), np.uint8)})["step"] == 0


def test_large_frames_take_no_memory_and_stop_no_robot(server):
    """Three at a time, as large as they may be. Another robot goes on, and the gateway stays small."""
    frame = HEADERS["many short maps"][: 1 << 20]

    def peak(pid):
        status = pathlib.Path(f"/proc/{pid}/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) >> 10  # MiB

    with running_gateway(server, "--policy=cartpole") as address:
        with contextlib.ExitStack() as stack:
            robot, *attackers = (stack.enter_context(WebsocketClientPolicy(address)) for _ in range(4))
            before = peak(address.process.pid)
            for step in range(3):
                for attacker in attackers:
                    attacker.ws.send(frame)
                assert robot.infer({"observation": np.zeros(4)})["step"] == step
                for attacker in attackers:
                    assert attacker.ws.recv().startswith("message: expected at most 4096 values")
        # Each frame once as it is received and once as a whole.
        assert peak(address.process.pid) - before < 3 * 2 * 1 + 32


@pytest.mark.parametrize(
    "send", [lambda ws: [ws.ping() for _ in range(5000)], lambda ws: ws.send([b""] * 5000)], ids=["pings", "fragments"]
)
def test_more_frames_than_a_robot_needs_end_the_connection(gateway, send):
    with WebsocketClientPolicy(gateway) as policy:
        with pytest.raises(websockets.ConnectionClosedError):
            send(policy.ws)
            policy.ws.recv()
        assert policy.ws.close_code == 1008, policy.ws.close_reason
    with WebsocketClientPolicy(gateway) as policy:  # in fragments, as some clients send
        message = packb({"observation": np.zeros(4), "image": np.zeros(1_000_000, np.uint8)})
        policy.ws.send([message[i : i + 4096] for i in range(0, len(message), 4096)])
        assert unpackb(policy.ws.recv())["step"] == 0


def upgrade(**more):
    """Returns the request for a connection."""
    fields = {"Host": "h", "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    fields |= {"Sec-WebSocket-Key": "A" * 22 + "=="} | more
    return ("GET / HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in fields.items()) + "\r\n").encode()


def test_what_is_sent_before_the_answer_is_not_read(gateway):
    host, port = gateway.removeprefix("ws://").split(":")
    with socket.create_connection((host, int(port))) as stranger, contextlib.suppress(ConnectionError):
        stranger.sendall(upgrade() + (b"\x89\x80" + bytes(4)) * 10_000)
        assert len(stranger.makefile("rb").read()) < 2000  # 20,000 bytes, if all were answered


def test_pings_are_answered_in_one_piece():
    """asyncio logs each write to a connection that its client has cut."""
    transport = unittest.mock.Mock()
    transport.is_closing.return_value = False

    async def receive(data):
        connection = Connection(ServerProtocol(state=State.OPEN), unittest.mock.Mock())
        connection.transport = transport
        connection.data_received(data)

    asyncio.run(receive((b"\x89\x80" + bytes(4)) * 100 + b"\x88\x80" + bytes(4)))  # and an end
    transport.write.assert_called_once_with(b"\x8a\0" * 100 + b"\x88\0")
    transport.write_eof.assert_called_once_with()


def test_texts_of_errors_are_bounded(gateway):
    long = "x" * 1_000_000
    messages = [
        {long: 0},
        {"observation": {b"__ndarray__": True, b"dtype": long, b"data": b"", b"shape": []}},
        {"observation": {b"__ndarray__": True, b"dtype": "<f4", b"data": b"", b"shape": [long]}},
        {"observation": {b"__npgeneric__": True, b"dtype": "<f4", b"data": long}},
        {"observation": np.full(1 << 16, np.nan)},
        {"observation": {long: np.zeros(4)}},
        {"observation": np.zeros(4), "reward": long},
        {str(i): i for i in range(2000)},
    ]
    with WebsocketClientPolicy(gateway) as policy:
        for message in messages:
            with pytest.raises(RuntimeError) as refused:
                policy.infer(message)
            assert len(str(refused.value)) < 2000
        assert policy.infer({"observation": np.zeros(4)})["step"] == 0


def test_what_is_too_much_is_refused(server):
    with running_gateway(server, "--policy=cartpole", "--max-connections=1", "--max-message-bytes=999") as address:
        with WebsocketClientPolicy(address) as policy:
            with pytest.raises(websockets.InvalidStatus) as refused:
                WebsocketClientPolicy(address)
            assert refused.value.response.status_code == 503
            assert b"connections: expected no more" in refused.value.response.body
            with pytest.raises(websockets.ConnectionClosedError) as closed:
                policy.infer({"observation": np.zeros(4), "image": np.zeros(999)})
            assert closed.value.rcvd.code == 1009


def test_connections_at_once_take_no_more_places(server):
    """They are admitted together, while the gateway waits for the server."""
    with running_gateway(server, "--policy=cartpole", "--max-connections=1") as address:
        ready = threading.Barrier(8)

        def connected(_):
            ready.wait()
            try:
                return WebsocketClientPolicy(address)
            except (websockets.InvalidStatus, websockets.ConnectionClosed):
                return None

        with concurrent.futures.ThreadPoolExecutor(8) as threads:
            policies = [policy for policy in threads.map(connected, range(8)) if policy]
        assert len(policies) == 1
        assert policies[0].infer({"observation": np.zeros(4)})["step"] == 0
        policies[0].ws.close()


def test_one_token_leaves_others_their_places(tokens):
    """Of seven places, one has as many as are then free, and so have the others, one after the other."""
    with (
        running_server(flags=[f"--tokens={tokens}"]) as server,
        running_gateway(server.grpc, "--policy=cartpole", "--max-connections=7") as address,
        contextlib.ExitStack() as robots,
    ):

        def connect_all(token):
            connected = 0
            with pytest.raises(websockets.InvalidStatus) as refused:
                while True:
                    robots.enter_context(WebsocketClientPolicy(address, api_key=token))
                    connected += 1
            assert refused.value.response.status_code == 503
            return connected

        assert [connect_all(token) for token in ("agent", "rival", "slow")] == [4, 2, 1]
        robots.close()

        def is_served():
            with contextlib.suppress(websockets.InvalidStatus), WebsocketClientPolicy(address, api_key="slow") as policy:
                return policy.infer({"observation": np.zeros(4)})["step"] == 0

        until(is_served)


IGNORED = {
    "text": "pick up the cube",
    "array of text": np.asarray("pick up the cube"),
    "arrays of text": [np.asarray(["a", "b"])],
    "bytes": np.asarray([b"ab"]),
    "time stamps": np.array(["2026-01-01T00:00:00"], "M8[s]"),
    "objects": array(b"|O"),
    "cut off": array(data=b"\0" * 15),
    "by number": {1: {2: np.zeros(3)}},
    "none": None,
}


def test_entries_that_the_mapping_does_not_name_are_ignored(gateway):
    with WebsocketClientPolicy(gateway) as policy:
        for step, value in enumerate(IGNORED.values()):
            assert policy.infer({"observation": np.zeros(4), "prompt": value})["step"] == step
        for key in ("observation", "reward", "reset"):
            message = {"observation": np.zeros(4)} | {key: np.asarray(["up"])}
            with pytest.raises(RuntimeError, match=f"{key}: array: dtype: expected numbers, such as <f4, received <U2"):
                policy.infer(message)


def test_a_robot_that_paused_begins_an_episode_in_a_new_session(server):
    """Longer than the server keeps a session."""

    def lose(session_id):
        with spikeserve.Client(server) as client:
            client.run(spikeserve.Session(client, session_id).cursor.close())

    def session_ids():
        with spikeserve.AdminClient(server) as admin:
            labelled = [session for session in admin.list_sessions().sessions if session.policy == "cartpole-small"]
            return {session.session_id for session in labelled}

    with running_gateway(server, "--policy=cartpole-small") as address, WebsocketClientPolicy(address) as policy:
        first = policy.metadata["session_id"]
        observation = {"observation": np.zeros(4)}
        lose(first)  # before its first message
        assert policy.infer(observation)["step"] == 0
        assert policy.infer(observation)["step"] == 1
        (second,) = session_ids()
        assert second != first
        lose(second)  # in the middle of an episode
        assert policy.infer(observation | {"reset": True, "reward": 1.0})["step"] == 0
        assert policy.infer(observation)["step"] == 1
        policy.infer(observation | {"terminated": True})
        lose(*session_ids())  # between two episodes, of a robot that never sends reset
        assert policy.infer(observation)["step"] == 0
        lose(*session_ids())
        with pytest.raises(RuntimeError, match="NOT_FOUND"):
            policy.infer(observation)  # in the middle of an episode


def test_health_and_web_pages(gateway):
    with urllib.request.urlopen(gateway.replace("ws://", "http://") + "/healthz") as answer:
        assert answer.read() == b"OK\n"
    with pytest.raises(websockets.InvalidStatus) as refused:
        connect(gateway, origin="http://example.org")
    assert refused.value.response.status_code == 403


def test_api_keys_are_the_tokens_of_the_server(tokens):
    others = ("Api-Key \xe9", "Bearer nope", "Bearer agent", "agent", "api-key agent", "Basic YTph", "")
    with running_server(flags=[f"--tokens={tokens}"]) as server:
        for own in ("agent", ""):  # the gateway's, which it lends to nobody
            with running_gateway(server.grpc, "--policy=cartpole", token=own) as address:
                with WebsocketClientPolicy(address, api_key="agent") as policy:
                    assert policy.infer({"observation": np.zeros(4)})["step"] == 0
                for headers in (None, *({"Authorization": each} for each in ("Api-Key wrong", *others))):
                    with pytest.raises(websockets.InvalidStatus) as refused:
                        connect(address, additional_headers=headers)
                    assert refused.value.response.status_code == 401, headers


def test_strangers_take_turns(tokens):
    """The gateway asks the server about two tokens of an address at a time that nobody has, not about all."""
    crowd = 60
    with running_server(flags=[f"--tokens={tokens}"]) as server, contextlib.ExitStack() as stack:
        address = stack.enter_context(running_gateway(server.grpc, "--policy=cartpole"))
        host, port = address.removeprefix("ws://").split(":")
        robot = stack.enter_context(WebsocketClientPolicy(address, api_key="agent"))
        opened, most = pathlib.Path(f"/proc/{address.process.pid}/fd"), 0
        before = len(list(opened.iterdir()))
        strangers = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(crowd)]
        for i, stranger in enumerate(strangers):
            stranger.sendall(upgrade(Authorization=f"Api-Key nope{i}"))
        for stranger in strangers:
            most = max(most, len(list(opened.iterdir())))
            assert b" 401 " in stranger.makefile("rb").readline()
            assert robot.infer({"observation": np.zeros(4)})["actions"].shape == (1, 1)
        assert most < before + 1.5 * crowd


def test_a_lost_session_ends_the_connection(tmp_path):
    with running_server(status=-9) as server, running_gateway(server.grpc, "--policy=cartpole") as address:
        with WebsocketClientPolicy(address) as policy:
            policy.infer({"observation": np.zeros(4)})
            with spikeserve.Client(server.grpc) as client:
                client.run(spikeserve.Session(client, policy.metadata["session_id"]).cursor.close())
            with pytest.raises(RuntimeError, match="NOT_FOUND"):
                policy.infer({"observation": np.zeros(4)})
            with pytest.raises(websockets.ConnectionClosedError) as closed:
                policy.infer({"observation": np.zeros(4)})
            assert closed.value.rcvd.code == 1011
        server.process.kill()


def test_the_connection_closes_its_session(gateway, server):
    with WebsocketClientPolicy(gateway) as policy:
        session_id = policy.metadata["session_id"]
        with spikeserve.Client(server) as client:
            assert spikeserve.Session(client, session_id).state().step == 0
            policy.ws.close()
            with pytest.raises(spikeserve.errors.SessionLostError):
                while True:  # until the gateway has seen the end of the connection
                    spikeserve.Session(client, session_id).state()


MAPPINGS = {
    "json": ("{", "mapping.json: expected a JSON file"),
    "empty": ('{"observation": []}', "observation: expected a list of keys or objects, received []"),
    "unknown": ('{"observations": ["a"]}', "expected any of observation, names, reward, reset, terminated, truncated"),
    "key": ('{"observation": [{"size": 3}]}', "observation[0].key: expected the key of an entry, received None"),
    "elements": ('{"observation": [{"key": "a", "elements": [-1]}]}', "observation[0].elements: expected indices"),
    "size": ('{"observation": [{"key": "a", "size": 3}]}', "mapping: observation: expected 4 numbers, as cartpole"),
}


@pytest.mark.parametrize(("text", "reason"), MAPPINGS.values(), ids=MAPPINGS)
def test_bad_mappings_are_refused_by_name(text, reason, server, tmp_path):
    (tmp_path / "mapping.json").write_text(text)
    assert reason in refused(server, "--policy=cartpole", f"--mapping={tmp_path}/mapping.json")


def test_bad_flags_are_refused_by_name(server):
    assert "policy: expected one that is served (" in refused(server, "--policy=cart")
    assert "--listen: expected HOST:PORT, received 8000" in refused(server, "--policy=cartpole", "--listen=8000")
    assert "--max-connections: expected a positive number" in refused(server, "--policy=x", "--max-connections=0")


def refused(server, *flags):
    """Returns why a gateway does not start."""
    command = ["gateway", "--openpi", f"--server={server}", "--listen=127.0.0.1:0", *flags]
    errors = io.StringIO()
    with unittest.mock.patch.object(sys, "argv", command), contextlib.redirect_stderr(errors):
        assert main() == 1
    return errors.getvalue()


def test_missing_packages_name_the_extra(server):
    blocked = "import sys; sys.modules['websockets'] = None; from spikeserve.gateway.__main__ import main; exit(main())"
    command = [sys.executable, "-c", blocked, "--openpi", "--policy=cartpole", f"--server={server}"]
    done = subprocess.run(command, capture_output=True, text=True)
    expected = "websockets: expected the package, which the extra [gateway] of the client installs, received none\n"
    assert (done.returncode, done.stderr) == (1, f"spikeserve gateway: {expected}")


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
