"""A contestant of the benchmark: a dense decision transformer of the paper's size in ONNX Runtime.

usage: dense_onnx.py POLICY_FILE LOGITS [--int8]   (the file that torch_bench --export wrote, and the JSON that it printed)

One decision computes its three new tokens a_{t-1}, G_t, s_t with a key/value cache, in one thread. The window is full.
The program exits with an error unless its logits equal those of the engine in dense mode. --int8 rounds the weights with
ONNX Runtime's dynamic quantisation; then the logits may differ by INT8_TOLERANCE.
"""

import json
import logging
import pathlib
import sys
import tempfile

import contestant
import numpy as np
import onnx
import onnxruntime
import policy_tensors
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import QuantType, quantize_dynamic

HIDDEN, HEADS, LAYERS, CONTEXT = 128, 4, 2, 20
ACTIONS = 2
INPUTS = {"action": ACTIONS, "return": 1, "state": 4}
NEW = 3  # tokens a decision
PAST = 3 * CONTEXT - 1  # G_{t-N} ... s_{t-1}
KEYS = PAST + NEW
HEAD_SIZE = HIDDEN // HEADS
UNSEEN = -1e9
TOLERANCE = 1e-3
INT8_TOLERANCE = 0.1


class Graph:
    """Collects nodes and weights. Every method returns the name of its output."""

    def __init__(self, tensors):
        self.tensors = tensors
        self.nodes = []
        self.weights = []

    def constant(self, values, dtype=np.float32):
        name = f"w{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.asarray(values, dtype), name))
        return name

    def op(self, kind, *inputs, output=None, **attributes):
        output = output or f"x{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def linear(self, x, name):
        weight, bias = (self.constant(self.tensors[f"{name}.{part}"]) for part in ("weight", "bias"))
        return self.op("Gemm", x, weight, bias, transB=1)

    def norm(self, x, name):
        weight, bias = (self.constant(self.tensors[f"{name}.{part}"]) for part in ("weight", "bias"))
        return self.op("LayerNormalization", x, weight, bias, epsilon=1e-5)

    def reshape(self, x, shape):
        return self.op("Reshape", x, self.constant(shape, np.int64))

    def heads(self, x, tokens):
        return self.op("Transpose", self.reshape(x, [tokens, HEADS, HEAD_SIZE]), perm=[1, 0, 2])

    def last_token(self, x):
        return self.op("Slice", x, *(self.constant([n], np.int64) for n in (NEW - 1, NEW, 0)))


def band():
    """Returns the attention mask: each new token attends to the last N timesteps up to itself."""
    mask = np.zeros((NEW, KEYS))
    for token in range(NEW):
        mask[token, PAST + token + 1 :] = UNSEEN
    mask[1:, :3] = UNSEEN  # timestep t - N, which is in the window of a_{t-1} only
    return mask


def remember(graph, new, kind, layer):
    """Returns the keys or values of the window. Those that the next decision needs become an output."""
    window = graph.op("Concat", f"past_{kind}{layer}", new, axis=1)
    first, last, axis = (graph.constant([n], np.int64) for n in (NEW, KEYS, 1))
    graph.op("Slice", window, first, last, axis, output=f"next_{kind}{layer}")
    return window


def attention(graph, x, layer, is_last):
    name = f"layers.{layer}.attention"
    key, value = (
        remember(graph, graph.heads(graph.linear(x, f"{name}.{kind}"), NEW), kind, layer) for kind in ("key", "value")
    )
    asking = graph.last_token(x) if is_last else x
    tokens = 1 if is_last else NEW
    query = graph.heads(graph.linear(asking, f"{name}.query"), tokens)
    scores = graph.op("MatMul", query, graph.op("Transpose", key, perm=[0, 2, 1]))
    scaled = graph.op("Mul", scores, graph.constant(1.0 / np.sqrt(HEAD_SIZE)))
    mask = graph.constant(band()[-tokens:])
    weights = graph.op("Softmax", graph.op("Add", scaled, mask), axis=-1)
    merged = graph.op("Transpose", graph.op("MatMul", weights, value), perm=[1, 0, 2])
    update = graph.linear(graph.reshape(merged, [tokens, HIDDEN]), f"{name}.output")
    return graph.norm(graph.op("Add", asking, update), f"{name}.norm")


def build_model(tensors):
    graph = Graph(tensors)
    embedded = [
        graph.norm(graph.op("Add", graph.linear(name, f"embed.{name}"), f"timestep_{name}"), f"embed.{name}.norm")
        for name in INPUTS
    ]
    x = graph.op("Concat", *embedded, axis=0)
    for layer in range(LAYERS):
        x = attention(graph, x, layer, is_last=layer + 1 == LAYERS)
        name = f"layers.{layer}.ffn"
        hidden = graph.op("Gelu", graph.linear(x, f"{name}.hidden"), approximate="tanh")
        x = graph.norm(graph.op("Add", x, graph.linear(hidden, f"{name}.output")), f"{name}.norm")
    logits = graph.op("Identity", graph.linear(x, "head"), output="logits")

    def value(name, *shape):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    cache = [f"{kind}{layer}" for layer in range(LAYERS) for kind in ("key", "value")]
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "dense",
            [value(name, 1, size) for name, size in INPUTS.items()]
            + [value(f"timestep_{name}", 1, HIDDEN) for name in INPUTS]
            + [value(f"past_{name}", HEADS, PAST, HEAD_SIZE) for name in cache],
            [value(logits, 1, ACTIONS)] + [value(f"next_{name}", HEADS, PAST, HEAD_SIZE) for name in cache],
            graph.weights,
        ),
        opset_imports=[helper.make_opsetid("", 20)],
    )
    model.ir_version = 10
    onnx.checker.check_model(model, full_check=True)
    return model, cache


def quantized(model):
    """Returns the model with 8-bit weights, whose linear layers also round their inputs to 8 bits."""
    logging.getLogger().setLevel(logging.ERROR)  # otherwise each run is advised to prepare the model in another way
    with tempfile.TemporaryDirectory() as name:
        before, after = (pathlib.Path(name) / file for file in ("float.onnx", "int8.onnx"))
        onnx.save(model, before)
        quantize_dynamic(before, after, weight_type=QuantType.QInt8)
        return onnx.load(after)


def logits_at_last(session, tensors, metadata, decisions):
    """Returns the logits of the last of `decisions`. The inputs are those of torch_bench.cc."""
    cache = {name.name: np.zeros(name.shape, np.float32) for name in session.get_inputs() if "past" in name.name}
    for t in range(decisions):
        observation = np.sin(0.3 * (t + np.arange(INPUTS["state"])))
        rows = {"action": max(t - 1, 0), "return": t, "state": t}
        inputs = {
            "action": [[1, 0]],
            "return": [[(1 - float(metadata["return_offset"])) / float(metadata["return_scale"])]],
            "state": [(observation - tensors["observation.mean"]) / tensors["observation.std"]],
        }
        for name, row in rows.items():
            inputs[f"timestep_{name}"] = tensors["embed.timestep.weight"][row : row + 1]
        inputs = {name: np.asarray(values, np.float32) for name, values in inputs.items()}
        logits, *following = session.run(None, {**inputs, **cache})
        cache = dict(zip(cache, following, strict=True))
    return logits[0]


class Player:
    """Makes decisions one after the other. Two buffers swap roles as the old and the new cache, without copies."""

    def __init__(self, session, cache):
        self.session = session
        random = np.random.default_rng(2)

        def tensor(*shape):
            return onnxruntime.OrtValue.ortvalue_from_numpy(random.normal(size=shape).astype(np.float32))

        self.bindings = [self.session.io_binding(), self.session.io_binding()]
        buffers = [{name: tensor(HEADS, PAST, HEAD_SIZE) for name in cache} for _ in range(2)]
        for i, binding in enumerate(self.bindings):
            for name, size in INPUTS.items():
                binding.bind_ortvalue_input(name, tensor(1, size))
                binding.bind_ortvalue_input(f"timestep_{name}", tensor(1, HIDDEN))
            for name in cache:
                binding.bind_ortvalue_input(f"past_{name}", buffers[i][name])
                binding.bind_ortvalue_output(f"next_{name}", buffers[1 - i][name])
            binding.bind_ortvalue_output("logits", tensor(1, ACTIONS))
        self.decisions = 0

    def decide(self):
        self.session.run_with_iobinding(self.bindings[self.decisions % 2])
        self.decisions += 1


def main():
    policy_file, expected, *flags = sys.argv[1:]
    is_int8 = flags == ["--int8"]
    tensors, metadata = policy_tensors.read_policy_file(policy_file)
    model, cache = build_model(tensors)
    model = quantized(model) if is_int8 else model
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    logits = logits_at_last(session, tensors, metadata, decisions=3 * CONTEXT)
    if not np.allclose(logits, json.loads(expected), rtol=0, atol=INT8_TOLERANCE if is_int8 else TOLERANCE):
        sys.exit(f"dense_onnx: logits: expected {expected}, received {logits}")
    contestant.run(Player(session, cache).decide)


if __name__ == "__main__":
    main()
