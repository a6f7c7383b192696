"""The unmodified client of Triton calls a real server."""

import queue
import shutil

import grpc
import gymnasium
import numpy
import pytest
from documentation import run_examples
from google.protobuf import descriptor_pool
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)
from security import fails_with
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, running_server
from tritonclient import grpc as triton
from tritonclient.grpc import service_pb2, service_pb2_grpc
from tritonclient.utils import InferenceServerException

MODEL = "cartpole"
# Training uses smaller seeds.
FIRST_UNSEEN_SEED = 1_000_000
OBSERVATION = [0.01, -0.02, 0.03, 0.04]


@pytest.fixture
def client(address):
    opened = triton.InferenceServerClient(address)
    yield opened
    opened.close()


def tensors(observation, reward=0.0, batched=False):
    """Returns the two inputs of the client of Triton, which sends them as raw bytes."""
    inputs = []
    for name, values in (("observation", observation), ("reward", [reward])):
        array = numpy.asarray([values] if batched else values, numpy.float32)
        tensor = triton.InferInput(name, array.shape, "FP32")
        inputs.append(tensor.set_data_from_numpy(array))
    return inputs


def unary(client):
    """Returns a function that makes one decision with one call."""

    def infer(inputs, **sequence):
        return client.infer(MODEL, inputs, client_timeout=DEADLINE_SECONDS, **sequence)

    return infer


def streamed(client):
    """Returns a function that makes one decision with one request of a stream."""
    replies = queue.Queue()
    client.start_stream(lambda result, error: replies.put((result, error)))

    def infer(inputs, **sequence):
        client.async_stream_infer(MODEL, inputs, **sequence)
        result, error = replies.get(timeout=DEADLINE_SECONDS)
        if error is not None:
            raise error
        return result

    return infer


def play_episode(infer, sequence_id, seed):
    """Plays one episode and returns its return. Sends the last reward with sequence_end."""
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=seed)
    reward, episode_return, start, over = 0.0, 0.0, True, False
    while True:
        result = infer(
            tensors(observation, reward),
            sequence_id=sequence_id,
            sequence_start=start,
            sequence_end=over,
        )
        if over:
            environment.close()
            return episode_return
        action = int(result.as_numpy("action")[0])
        observation, reward, terminated, truncated, _ = environment.step(action)
        episode_return += reward
        start, over = False, terminated or truncated


@pytest.mark.parametrize("call", [unary, streamed])
@pytest.mark.parametrize("sequence_id", [7, "seven"])
def test_plays_cart_pole(client, call, sequence_id):
    infer = call(client)
    returns = [play_episode(infer, sequence_id, FIRST_UNSEEN_SEED + i) for i in range(2)]
    assert sum(returns) / len(returns) >= 495, returns


def refusal(infer, *arguments, **fields):
    with pytest.raises(InferenceServerException) as error:
        infer(*arguments, **fields)
    return error.value


def test_answers_agree_with_the_native_protocol(client):
    """The outputs of a step have the expected types, shapes and values."""
    result = unary(client)(tensors(OBSERVATION), sequence_id=1, sequence_start=True)
    action, probabilities = result.as_numpy("action"), result.as_numpy("probabilities")
    assert action.dtype == numpy.int64 and action.shape == (1,)
    assert probabilities.dtype == numpy.float32 and probabilities.shape == (2,)
    assert abs(probabilities.sum() - 1) < 1e-6 and probabilities.argmax() == action[0]
    assert result.as_numpy("return_to_go") == [500.0]
    assert result.as_numpy("spikes")[0] > 0
    later = unary(client)(tensors(OBSERVATION, reward=1.0), sequence_id=1, sequence_end=True)
    assert later.as_numpy("return_to_go") == [499.0]


def test_a_batch_dimension_of_one_comes_back(client):
    flat = unary(client)(tensors(OBSERVATION), sequence_id=2, sequence_start=True)
    batched = unary(client)(tensors(OBSERVATION, batched=True), sequence_id=3, sequence_start=True)
    assert batched.as_numpy("probabilities").shape == (1, 2)
    assert (batched.as_numpy("probabilities")[0] == flat.as_numpy("probabilities")).all()


def test_only_requested_outputs_come_back(client):
    wanted = [triton.InferRequestedOutput("spikes")]
    result = unary(client)(tensors(OBSERVATION), outputs=wanted, sequence_id=4, sequence_start=True)
    assert [output.name for output in result.get_response().outputs] == ["spikes"]
    error = refusal(
        unary(client),
        tensors(OBSERVATION),
        outputs=[triton.InferRequestedOutput("logits")],
        sequence_id=4,
    )
    assert "action, probabilities, return_to_go, spikes" in error.message()


def test_integer_and_string_ids_are_two_sequences(client):
    infer = unary(client)
    infer(tensors(OBSERVATION), sequence_id=5, sequence_start=True)
    assert "running sequence" in refusal(infer, tensors(OBSERVATION), sequence_id="5").message()


def test_a_start_begins_anew(client):
    infer = unary(client)
    infer(tensors(OBSERVATION), sequence_id=6, sequence_start=True)
    infer(tensors(OBSERVATION, reward=1.0), sequence_id=6)
    again = infer(tensors(OBSERVATION), sequence_id=6, sequence_start=True)
    assert again.as_numpy("return_to_go") == [500.0]


def test_an_end_ends(client):
    infer = unary(client)
    infer(tensors(OBSERVATION), sequence_id=8, sequence_start=True, sequence_end=True)
    error = refusal(infer, tensors(OBSERVATION, reward=1.0), sequence_id=8)
    assert error.status() == "StatusCode.NOT_FOUND"
    assert "sequence_start" in error.message()


def test_the_target_return_is_a_parameter_of_the_start(client):
    result = client.infer(
        MODEL,
        tensors(OBSERVATION),
        sequence_id=9,
        sequence_start=True,
        parameters={"target_return": 123.0},
    )
    assert result.as_numpy("return_to_go") == [123.0]


@pytest.mark.parametrize("call", [unary, streamed])
def test_a_refused_request_leaves_the_sequence_as_it_was(client, call):
    infer = call(client)
    infer(tensors(OBSERVATION), sequence_id=10, sequence_start=True)
    wrong = [
        (tensors([*OBSERVATION, 0.5], 1.0), "expected 4 numbers, received 5"),
        (tensors([float("nan"), 0, 0, 0], 1.0), "observation[0]: expected a finite number"),
        (tensors(OBSERVATION)[:1], "expected reward"),
        (tensors(OBSERVATION)[1:], "one of the name observation"),
        (tensors([OBSERVATION, OBSERVATION], 1.0), "expected shape [n] or [1, n]"),
    ]
    for inputs, message in wrong:
        assert message in refusal(infer, inputs, sequence_id=10).message()
    after = infer(tensors(OBSERVATION, reward=1.0), sequence_id=10)
    assert after.as_numpy("return_to_go") == [499.0]


IN_BYTES = {"name": "observation", "datatype": "FP32", "shape": [4]}
TYPED = IN_BYTES | {"contents": {"fp32_contents": OBSERVATION}}
REWARD = {"name": "reward", "datatype": "FP32", "shape": [1]}


@pytest.mark.parametrize(
    ("inputs", "raw", "message"),
    [
        ([TYPED], [bytes(16)], "expected no contents beside raw_input_contents"),
        ([IN_BYTES, REWARD], [bytes(16)], "expected one an input, 2, received 1"),
        ([IN_BYTES], [bytes(15)], "received 15 bytes of FP32"),
    ],
)
def test_contents_are_either_typed_or_in_bytes(address, inputs, raw, message):
    request = service_pb2.ModelInferRequest(model_name=MODEL, inputs=inputs, raw_input_contents=raw)
    request.parameters["sequence_id"].int64_param = 1
    with grpc.insecure_channel(address) as channel, fails_with(grpc.StatusCode.INVALID_ARGUMENT, message):
        service_pb2_grpc.GRPCInferenceServiceStub(channel).ModelInfer(request, timeout=DEADLINE_SECONDS)


def test_every_request_needs_a_sequence(client):
    error = refusal(unary(client), tensors(OBSERVATION))
    assert error.status() == "StatusCode.INVALID_ARGUMENT"
    assert "send sequence_id" in error.message()


def test_unknown_models_and_versions(client):
    error = refusal(
        client.infer, "nothing", tensors(OBSERVATION), sequence_id=1, sequence_start=True
    )
    assert error.status() == "StatusCode.NOT_FOUND"
    error = refusal(
        client.infer,
        MODEL,
        tensors(OBSERVATION),
        model_version="first",
        sequence_id=1,
        sequence_start=True,
    )
    assert "positive integer" in error.message()
    assert not client.is_model_ready("nothing")
    assert not client.is_model_ready(MODEL, "99")


def version(client):
    """Returns the policy version that a new sequence uses."""
    result = unary(client)(
        tensors(OBSERVATION), sequence_id=12, sequence_start=True, sequence_end=True
    )
    return result.get_response().model_version


def test_the_server_and_its_models_describe_themselves(client):
    assert client.is_server_live() and client.is_server_ready() and client.is_model_ready(MODEL)
    server = client.get_server_metadata()
    assert server.name == "spikeserve"
    assert {"sequence", "sequence(string_id)"} <= set(server.extensions)

    model = client.get_model_metadata(MODEL)
    assert version(client) in model.versions
    shapes = {tensor.name: (tensor.datatype, list(tensor.shape)) for tensor in model.inputs}
    assert shapes == {"observation": ("FP32", [4]), "reward": ("FP32", [1])}
    shapes = {tensor.name: (tensor.datatype, list(tensor.shape)) for tensor in model.outputs}
    assert shapes == {
        "action": ("INT64", [1]),
        "probabilities": ("FP32", [2]),
        "return_to_go": ("FP32", [1]),
        "spikes": ("INT64", [1]),
    }

    config = client.get_model_config(MODEL).config
    assert config.max_batch_size == 0
    assert config.sequence_batching.max_sequence_idle_microseconds == 600_000_000
    assert [(entry.name, entry.optional) for entry in config.input] == [
        ("observation", False),
        ("reward", True),
    ]
    index = client.get_model_repository_index().models
    assert (MODEL, version(client), "READY") in [
        (entry.name, entry.version, entry.state) for entry in index
    ]


def test_statistics_count_answers_and_refusals(client):
    served = version(client)

    def counts():
        (statistics,) = client.get_inference_statistics(MODEL, served).model_stats
        stats = statistics.inference_stats
        assert statistics.inference_count == stats.success.count == stats.compute_infer.count
        return stats.success.count, stats.fail.count

    successes, failures = counts()
    infer = unary(client)
    infer(tensors(OBSERVATION), sequence_id=11, sequence_start=True)
    refusal(infer, tensors([0.0]), sequence_id=11)
    infer(tensors(OBSERVATION, 1.0), sequence_id=11, sequence_end=True)
    assert counts() == (successes + 2, failures + 1)


def test_models_come_and_go_while_sequences_run(tmp_path):
    shutil.copytree(SHIPPED_POLICIES / MODEL, tmp_path / MODEL)
    with running_server(tmp_path) as server:
        client = triton.InferenceServerClient(server.grpc)
        infer = unary(client)
        infer(tensors(OBSERVATION), sequence_id=1, sequence_start=True)
        client.unload_model(MODEL)
        assert not client.is_model_ready(MODEL)
        states = {entry.state for entry in client.get_model_repository_index().models}
        assert states == {"UNAVAILABLE"}
        infer(tensors(OBSERVATION, 1.0), sequence_id=1)
        error = refusal(infer, tensors(OBSERVATION), sequence_id=2, sequence_start=True)
        assert error.status() == "StatusCode.NOT_FOUND"
        client.load_model(MODEL)
        assert client.is_model_ready(MODEL)
        infer(tensors(OBSERVATION), sequence_id=2, sequence_start=True)
        assert refusal(client.load_model, "nothing").status() == "StatusCode.NOT_FOUND"
        assert refusal(client.unload_model, "nothing").status() == "StatusCode.NOT_FOUND"
        error = refusal(client.load_model, MODEL, config="{}")
        assert "parameters: expected none" in error.message()
        client.close()


def test_names_and_numbers_are_the_public_ones(address):
    """Every field of the server's messages has the same number and type in Triton's messages."""
    with grpc.insecure_channel(address) as channel:
        pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))
        service = pool.FindServiceByName("inference.GRPCInferenceService")
        published = service_pb2.DESCRIPTOR.services_by_name["GRPCInferenceService"]
        compared = set()
        for method in service.methods:
            theirs = published.methods_by_name[method.name]
            streams = ("client_streaming", "server_streaming")
            assert [getattr(method, s) for s in streams] == [getattr(theirs, s) for s in streams]
            compare(method.input_type, theirs.input_type, compared)
            compare(method.output_type, theirs.output_type, compared)
    assert "inference.ModelConfig" in compared and len(compared) > 30


def compare(ours, theirs, compared):
    assert ours.full_name == theirs.full_name
    if ours.full_name in compared:
        return
    compared.add(ours.full_name)
    for field in ours.fields:
        other = theirs.fields_by_name[field.name]
        for what in ("number", "type", "is_repeated"):
            assert getattr(field, what) == getattr(other, what), field.full_name
        oneofs = [f.containing_oneof and f.containing_oneof.name for f in (field, other)]
        assert oneofs[0] == oneofs[1], field.full_name
        if field.message_type:
            compare(field.message_type, other.message_type, compared)
        if field.enum_type:
            numbers = other.enum_type.values_by_name
            for value in field.enum_type.values:
                assert numbers[value.name].number == value.number, value.name


def test_the_pages_examples_run(capsys):
    with running_server() as server:
        run_examples("triton.md", server.grpc, server.http)
    by_grpc, by_http = capsys.readouterr().out.split()
    assert float(by_grpc) == float(by_http) == 500
