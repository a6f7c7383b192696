"""The Open Inference Protocol over HTTP: requests as curl sends them, and the unmodified client of Triton."""

import concurrent.futures
import contextlib
import http.client
import json
import math
import subprocess

import gymnasium
import numpy as np
import pytest
import tritonclient.http
from security import TOKENS
from serving import http_call, run, running_server, series
from tritonclient import grpc as triton_grpc
from tritonclient.utils import InferenceServerException

SEED = 1_000_000
OBSERVATION = [0.01, -0.02, 0.03, 0.04]
LIMIT = 4 << 20  # bytes of a body


def call(server, method, path, body=None, token=None, **headers):
    """Returns the code, the headers and the body, parsed if it is JSON, of a request."""
    body = json.dumps(body) if isinstance(body, dict) else body
    status, headers, content = http_call(server.http, method, path, body, token, **headers)
    return status, headers, json.loads(content) if headers["Content-Type"] == "application/json" else content


def infer_body(sequence, *, start=False, end=False, reward=0.0, observation=OBSERVATION, **more):
    inputs = [{"name": "observation", "shape": [len(observation)], "datatype": "FP32", "data": list(observation)}]
    inputs.append({"name": "reward", "shape": [1], "datatype": "FP32", "data": [reward]})
    parameters = {"sequence_id": sequence, "sequence_start": start, "sequence_end": end}
    return {"inputs": inputs, "parameters": parameters, **more}


def infer(server, body, path="/v2/models/cartpole/infer", **arguments):
    return call(server, "POST", path, body, **arguments)


def test_health_and_metadata(server):
    assert call(server, "GET", "/v2/health/live")[::2] == (200, {"live": True})
    assert call(server, "GET", "/v2/health/ready")[::2] == (200, {"ready": True})
    code, _, about = call(server, "GET", "/v2")
    assert (code, about["name"]) == (200, "spikeserve")
    assert {"sequence", "binary_tensor_data"} <= set(about["extensions"])
    assert call(server, "GET", "/v2/")[2] == about
    code, _, model = call(server, "GET", "/v2/models/cartpole")
    assert (code, model["name"], model["versions"]) == (200, "cartpole", ["1", "2"])
    assert model["inputs"][0] == {"name": "observation", "datatype": "FP32", "shape": [4]}
    assert [output["name"] for output in model["outputs"]] == ["action", "probabilities", "return_to_go", "spikes"]
    assert call(server, "GET", "/v2/models/cartpole/versions/1")[2] == model
    assert call(server, "GET", "/v2/models/cartpole/ready")[::2] == (200, {"name": "cartpole", "ready": True})
    assert call(server, "GET", "/v2/models/cartpole/versions/1/ready")[0] == 200
    assert call(server, "GET", "/v2/models/cartpole/versions/9/ready")[::2] == (404, {"name": "cartpole", "ready": False})
    code, _, error = call(server, "GET", "/v2/models/chess")
    assert code == 404 and "chess" in error["error"]


def test_the_answers_are_those_of_grpc(server):
    """In JSON, a float has as many digits as it takes to read the same float."""
    client = triton_grpc.InferenceServerClient(server.grpc)
    reward = 0.0
    for step in range(4):
        observation = np.asarray(OBSERVATION, np.float32) * (step + 1)
        body = infer_body("json", start=step == 0, reward=reward, observation=observation.tolist(), id=f"request {step}")
        code, _, answer = infer(server, body)
        assert (code, answer["id"], answer["model_name"], answer["model_version"]) == (200, f"request {step}", "cartpole", "2")
        tensors = [
            triton_grpc.InferInput("observation", [4], "FP32").set_data_from_numpy(observation),
            triton_grpc.InferInput("reward", [1], "FP32").set_data_from_numpy(np.float32([reward])),
        ]
        expected = client.infer("cartpole", tensors, sequence_id=9, sequence_start=step == 0)
        for output in answer["outputs"]:
            dtype = {"FP32": np.float32, "INT64": np.int64}[output["datatype"]]
            np.testing.assert_array_equal(np.asarray(output["data"], dtype), expected.as_numpy(output["name"]))
            assert output["shape"] == [len(output["data"])]
        reward = 1.0
    client.close()


def triton_tensors(observation, reward, binary):
    tensors = []
    for name, values in (("observation", observation), ("reward", [reward])):
        array = np.asarray(values, np.float32)
        tensor = tritonclient.http.InferInput(name, list(array.shape), "FP32")
        tensors.append(tensor.set_data_from_numpy(array, binary_data=binary))
    return tensors


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "json"])
def test_tritons_client_plays(server, binary):
    """It sends and receives tensors as bytes unless it is told otherwise."""
    with contextlib.closing(tritonclient.http.InferenceServerClient(server.http)) as client:
        assert client.is_server_live() and client.is_server_ready() and client.is_model_ready("cartpole")
        assert not client.is_model_ready("chess")
        assert client.get_server_metadata()["name"] == "spikeserve"
        assert client.get_model_metadata("cartpole", "2")["platform"] == "spikeserve"
        outputs = None
        if not binary:
            outputs = [tritonclient.http.InferRequestedOutput("action", binary_data=False)]
        environment = gymnasium.make("CartPole-v1")
        observation, _ = environment.reset(seed=SEED)
        reward, total, start, over = 0.0, 0.0, True, False
        while True:
            inputs = triton_tensors(observation, reward, binary)
            sequence = {"sequence_id": f"http {binary}", "sequence_start": start, "sequence_end": over}
            result = client.infer("cartpole", inputs, outputs=outputs, **sequence)
            if over:
                break
            action = int(result.as_numpy("action")[0])
            observation, reward, terminated, truncated, _ = environment.step(action)
            total += reward
            start, over = False, terminated or truncated
        assert total == 500
        assert (result.as_numpy("spikes") is None) == (not binary)  # only the outputs that were asked for
        with pytest.raises(InferenceServerException, match="expected a running sequence of model"):
            client.infer("cartpole", triton_tensors(observation, 0.0, binary), sequence_id="ended")


def test_curl_sends_a_request(server):
    body = json.dumps(infer_body("curl", start=True))
    done = run("curl", "--silent", "--fail-with-body", "--data", body, f"http://{server.http}/v2/models/cartpole/infer")
    assert json.loads(done.stdout)["outputs"][0]["name"] == "action"


def test_a_client_that_waits_is_told_to_continue(server):
    """As curl does with a body of more than 1 MiB."""
    body = json.dumps(infer_body("large", start=True)) + " " * (2 << 20)
    command = ["curl", "--silent", "--fail-with-body", "--data-binary", "@-", "--expect100-timeout", "600"]
    command += ["--header", "Expect: 100-continue", "--max-time", "30", f"http://{server.http}/v2/models/cartpole/infer"]
    done = subprocess.run(command, input=body, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["model_name"] == "cartpole"


def changed(**fields):
    return infer_body("bad", start=True) | fields


def with_input(**fields):
    body = infer_body("bad", start=True)
    body["inputs"][0] |= fields
    return body


def nested(depth):
    return json.loads("[" * depth + "1.0" + "]" * depth)


BAD = {
    "no json": ("{", "body: "),
    "empty": ("", "body: "),
    "array": ("[]", "body: expected a JSON object, received an array of 0"),
    "twice": ('{"id": "a", "id": "b", "inputs": []}', "body: "),
    "deep": ("[" * 100_000, "body: "),
    "no inputs": ({"id": "1"}, 'expected key "inputs", received none'),
    "unknown": (changed(colour=1), "colour"),
    "inputs": (changed(inputs=3), "inputs: expected an array, received 3"),
    "id": (changed(id=3), "id: expected a string, received 3"),
    "name": (with_input(name=7), "inputs[0].name: expected a string, received 7"),
    "shape": (with_input(shape=[4.5]), "inputs[0].shape[0]: expected"),
    "no data": (with_input(data=None), "inputs[0].data: expected an array, received null"),
    "text": (with_input(data=[0, 1, "x", 3]), 'inputs[0].data[2]: expected a number that fits float32, received "x"'),
    "huge": (with_input(data=[0, 1, 2, 1e300]), "inputs[0].data[3]: expected a number that fits float32"),
    "dimensions": (with_input(data=nested(9)), "expected at most 8 dimensions"),
    "length": (with_input(data=[0, 1, 2]), 'input "observation": expected what its shape [4] holds, received 12 bytes'),
    "type": (with_input(datatype="INT64"), 'input "observation": expected datatype FP32, received "INT64"'),
    "other": (with_input(name="image"), 'input "image": expected observation or reward'),
    "both": (with_input(parameters={"binary_data_size": 16}), "inputs[0]: expected either data or parameters."),
    "parameter": (changed(parameters={"a": []}), "parameters.a: expected true, false, a number or a string"),
    "binary": (changed(parameters={"binary_data_output": 1}), "parameters.binary_data_output: expected true or false"),
    "no sequence": (changed(parameters={}), "parameters.sequence_id: expected an integer other than 0 or a string"),
    "kind of id": (changed(parameters={"sequence_id": True}), "expected an int64_param or a string_param"),
    "long id": (changed(parameters={"sequence_id": "x" * 257}), "at most 256 bytes"),
    "seed": (changed(parameters={"sequence_id": 1, "sequence_start": True, "seed": 0.5}), "parameters.seed"),
    "record": (changed(parameters={"sequence_id": 1, "sequence_start": True, "record": 1}), "parameters.record: expected a bool"),
    "input twice": (changed(inputs=2 * infer_body("bad")["inputs"][:1]), "expected one of this name, received two"),
    "flag": (changed(parameters={"sequence_id": 1, "sequence_start": 1}), "parameters.sequence_start: expected a bool"),
    "output": (changed(outputs=[{"name": "colour"}]), "outputs: expected any of [action, "),
    "output name": (changed(outputs=[{}]), 'outputs[0]: expected key "name", received none'),
    "wish": (
        changed(outputs=[{"name": "action", "parameters": {"binary_data": 1}}]),
        "outputs[0].parameters.binary_data: expected true or false",
    ),
    "size": (changed(inputs=infer_body("bad", start=True, observation=[0.0] * 3)["inputs"]), "observation: expected"),
}


@pytest.mark.parametrize(("body", "reason"), BAD.values(), ids=BAD)
def test_malformed_bodies_are_refused_by_name(server, body, reason):
    code, _, answer = infer(server, body)
    assert code == 400, answer
    assert reason in answer["error"]
    code, _, answer = infer(server, infer_body("bad"))
    assert code == 404, "a request that fails starts no sequence"


@pytest.mark.parametrize(
    ("length", "size", "more", "reason"),
    [
        ("x", 16, b"", "Inference-Header-Content-Length: expected a length in bytes"),
        ("999999", 16, b"", "Inference-Header-Content-Length: expected at most "),
        (None, 17, b"", "inputs[0].parameters.binary_data_size: expected at most 16, "),
        (None, -1, b"", "inputs[0].parameters.binary_data_size: expected"),
        (None, 16, b"more", "body: expected as many bytes behind its JSON"),
        (None, 12, b"", "body: expected as many bytes behind its JSON"),
    ],
    ids=["text", "long", "beyond", "negative", "more", "fewer"],
)
def test_malformed_binary_tensors_are_refused_by_name(server, length, size, more, reason):
    body = infer_body("binary", start=True)
    tensor = body["inputs"][0]
    del tensor["data"]
    tensor["parameters"] = {"binary_data_size": size}
    encoded = json.dumps(body).encode()
    headers = {"Inference_Header_Content_Length": length or str(len(encoded))}
    code, _, answer = infer(server, encoded + np.float32(OBSERVATION).tobytes() + more, **headers)
    assert code == 400, answer
    assert reason in answer["error"]


def test_binary_and_json_mix(server):
    """The length of the JSON is in the answer, and one output of two is in bytes."""
    body = infer_body("mixed", start=True)
    del body["inputs"][0]["data"]
    body["inputs"][0]["parameters"] = {"binary_data_size": 16}
    body["outputs"] = [{"name": "probabilities", "parameters": {"binary_data": True}}, {"name": "action"}]
    encoded = json.dumps(body).encode()
    raw = np.float32(OBSERVATION).tobytes()
    code, headers, content = infer(server, encoded + raw, Inference_Header_Content_Length=str(len(encoded)))
    assert (code, headers["Content-Type"]) == (200, "application/octet-stream")
    length = int(headers["Inference-Header-Content-Length"])
    outputs = {output["name"]: output for output in json.loads(content[:length])["outputs"]}
    assert outputs["probabilities"]["parameters"] == {"binary_data_size": 8}
    assert math.isclose(np.frombuffer(content[length:], np.float32).sum(), 1, rel_tol=1e-6)
    assert outputs["action"]["data"][0] in (0, 1)


def test_bodies_are_bounded(server):
    connection = http.client.HTTPConnection(server.http, timeout=30)
    connection.putrequest("POST", "/v2/models/cartpole/infer")
    connection.putheader("Content-Length", str(LIMIT + 1))
    connection.endheaders()  # and no body: the server does not wait for it
    response = connection.getresponse()
    assert response.status == 413
    expected = "Content-Length: expected at most 4194304 (--max_message_bytes), received 4194305"
    assert json.load(response) == {"error": expected}
    connection.close()
    assert infer(server, json.dumps(infer_body("bounded", start=True)) + " " * (LIMIT - 1000))[0] == 200
    connection = http.client.HTTPConnection(server.http, timeout=30)
    connection.putrequest("POST", "/v2/models/cartpole/infer")
    connection.endheaders()  # without a length, and not in chunks
    assert connection.getresponse().status == 411
    connection.close()
    assert infer(server, b"{}", Content_Encoding="br")[0] == 415


def test_paths_and_methods(server):
    code, _, answer = call(server, "GET", "/v2/models/cartpole/infer")
    assert (code, answer) == (405, {"error": "method: expected POST"})
    code, _, answer = call(server, "POST", "/v2/models/cartpole", "{}")
    assert (code, answer) == (405, {"error": "method: expected GET"})
    for path in ("/v2/models", "/v2/models/", "/v2/x", "/v2/models/a/versions", "/v2/models/a/infer/b", "/v2/health"):
        code, _, answer = call(server, "GET", path)
        assert code == 404 and answer["error"].startswith("path: expected /v2, "), path
    assert call(server, "POST", "/metrics", "{}")[0] == 405
    assert call(server, "PUT", "/v2", "{}")[0] == 405


def test_pages_of_other_sites_send_nothing(server):
    code, _, answer = infer(server, infer_body("page", start=True), Origin="http://evil.example")
    assert code == 403 and answer["error"].startswith("Origin: expected none")


def test_versions_keep_their_sequences_apart(server):
    path = "/v2/models/cartpole/versions/1/infer"
    assert infer(server, infer_body("v", start=True), path)[2]["model_version"] == "1"
    assert infer(server, infer_body("v"))[2]["model_version"] == "1"
    code, _, answer = infer(server, infer_body("v"), "/v2/models/cartpole/versions/2/infer")
    assert code == 400 and "model_version: expected none, or 1" in answer["error"]


def test_an_answer_says_what_looks_miswired(server):
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=SEED)
    reward, over, start, said = 0.0, False, True, []
    while not over:
        swapped = [float(observation[i]) for i in (0, 2, 1, 3)]
        answer = infer(server, infer_body("miswired", start=start, reward=reward, observation=swapped))[2]
        said.append(answer.get("parameters", {}).get("wiring"))
        observation, reward, terminated, truncated, _ = environment.step(answer["outputs"][0]["data"][0])
        over, start = terminated or truncated, False
    assert said[0] is None
    assert said[-1] == "observation[1] (cart_velocity) and observation[2] (pole_angle) look exchanged"


def test_metrics_count_the_calls(server):
    def count():
        return sum(series(server, "spikeserve_rpc_duration_seconds_count", code="OK", method="ModelInfer"))

    before = count()
    assert infer(server, infer_body("metrics", start=True))[0] == 200
    assert count() == before + 1


def test_tokens_tenants_and_rates_are_those_of_grpc(tokens):
    assert {entry["role"] for entry in TOKENS["tokens"]} == {"agent", "viewer", "operator"}
    with running_server(flags=[f"--tokens={tokens}"]) as server:
        body = infer_body(7, start=True)
        assert infer(server, body)[0] == 401
        assert infer(server, body, token="wrong")[0] == 401
        code, _, answer = infer(server, body, token="viewer")
        assert code == 403 and "role: expected agent or operator" in answer["error"]
        assert call(server, "GET", "/v2/health/live")[0] == 401
        assert call(server, "GET", "/v2/models/cartpole", token="viewer")[0] == 200
        assert infer(server, body, token="agent")[0] == 200
        # Of another tenant, the same id is another sequence.
        assert infer(server, infer_body(7, reward=1.0), token="rival")[0] == 404
        assert infer(server, infer_body(7, reward=1.0), token="agent")[0] == 200
        # Triton's client by gRPC continues with the sequence.
        client = triton_grpc.InferenceServerClient(server.grpc)
        tensors = [
            triton_grpc.InferInput("observation", [4], "FP32").set_data_from_numpy(np.float32(OBSERVATION)),
            triton_grpc.InferInput("reward", [1], "FP32").set_data_from_numpy(np.float32([1])),
        ]
        headers = {"authorization": "Bearer agent"}
        assert client.infer("cartpole", tensors, sequence_id=7, headers=headers).as_numpy("action").shape == (1,)
        client.close()
        # 5 decisions a second: a busy machine would need 20 seconds for these to be within the rate.
        with concurrent.futures.ThreadPoolExecutor(20) as threads:
            bodies = [infer_body(f"slow {number}", start=True) for number in range(100)]
            codes = set(threads.map(lambda body: infer(server, body, token="slow")[0], bodies))
        assert codes == {200, 429}
        code, _, answer = infer(server, infer_body(1, start=True, id="x" * 300), token="small")
        assert code == 429 and "200" in answer["error"], "max_message_bytes of the tenant"


def test_a_server_that_drains_is_not_ready():
    with running_server() as server:
        for cancel, code in ((False, 503), (True, 200)):
            server.admin.Drain(cancel=cancel)
            assert call(server, "GET", "/v2/health/ready")[::2] == (code, {"ready": code == 200})
            assert call(server, "GET", "/v2/health/live")[0] == 200


def test_a_server_that_stops_is_not_ready():
    with running_server() as server:
        assert call(server, "GET", "/v2/health/ready")[0] == 200
        server.process.terminate()
        codes = set()
        with contextlib.suppress(ConnectionError, TimeoutError, http.client.HTTPException):
            while True:
                codes.add(call(server, "GET", "/v2/health/ready")[0])
        assert codes <= {200, 503}


def test_many_requests_at_a_time_are_answered(server):
    """Each of many connections gets its own answer."""

    def play(number):
        codes = [infer(server, infer_body(f"many {number}", start=step == 0, reward=1.0))[0] for step in range(5)]
        return set(codes)

    with concurrent.futures.ThreadPoolExecutor(40) as threads:
        assert set().union(*threads.map(play, range(40))) == {200}
