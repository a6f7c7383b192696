"""Writes the result of the benchmark as a Markdown page."""

import statistics

from server_bench import OWN_SHARES

ENGINE_NAMES = {
    "spikeserve_silent": "spikeserve, shipped CartPole policy",
    "spikeserve_loud": "spikeserve, unregularised (random weights)",
    "spikeserve_silent_integer": "spikeserve, shipped CartPole policy, integers",
    "spikeserve_loud_integer": "spikeserve, unregularised, integers",
    "spikeserve_silent_together": "spikeserve, shipped policy, 64 sessions together",
    "spikeserve_loud_together": "spikeserve, unregularised, 64 sessions together",
    "reference": "reference engine, shipped policy, episodes of one window",
    "torch_snn_window": "the same model, libtorch eager, full window",
    "torch_dense_window": "dense decision transformer, libtorch, full window",
    "torch_dense_cached": "dense, libtorch, key/value cache",
    "torch_dense_cached_int8": "dense, libtorch, key/value cache, 8-bit weights",
    "onnx_dense_cached": "dense, ONNX Runtime, key/value cache",
    "onnx_dense_cached_int8": "dense, ONNX Runtime, key/value cache, 8-bit weights",
}


def number(value):
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def table(header, rows):
    lines = ["| " + " | ".join(header) + " |", "| --- |" + " ---: |" * (len(header) - 1)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def ratio(engine, contestant, other):
    """Returns the median over rounds of the ratio of two rates."""
    return statistics.median(
        a / b for a, b in zip(engine[contestant]["rates"], engine[other]["rates"], strict=True)
    )


def verdict(measured, target, at_least=True):
    met = measured >= target if at_least else measured <= target
    return [number(measured), ("at least " if at_least else "at most ") + number(target), "yes" if met else "no"]


def engine_targets(engine):
    silent = "spikeserve_silent"
    rate = {name: results["decisions_per_second"] for name, results in engine.items()}
    return [
        ["decisions a second, silent policy", *verdict(rate[silent], 60_000)],
        ["decisions a second, unregularised", *verdict(rate["spikeserve_loud"], 25_000)],
        ["integers, times float32, silent policy", *verdict(ratio(engine, f"{silent}_integer", silent), 1.8)],
        ["integers, times float32, unregularised", *verdict(ratio(engine, "spikeserve_loud_integer", "spikeserve_loud"), 2.5)],
        ["times libtorch eager, full window", *verdict(ratio(engine, silent, "torch_snn_window"), 300)],
        ["times the dense model in libtorch, full window", *verdict(ratio(engine, silent, "torch_dense_window"), 30)],
        ["times the cached dense model in ONNX Runtime", *verdict(ratio(engine, silent, "onnx_dense_cached"), 1)],
    ]


def server_targets(server):
    rows = []
    cases = {(case["mode"], case["sessions"]): case for case in server["closed_loop"]}
    for arithmetic, mode, target in [
        ("float32", "unary", 0.8),
        ("float32", "stream", 0.5),
        ("integer", "unary", 1),
        ("integer", "stream", 0.7),
    ]:
        share = cases[mode, 64]["share_of_echo"][arithmetic]
        rows.append([f"share of the echo's rate, {arithmetic}, {mode}, 64 sessions", *verdict(share, target)])
    for case in server["batch"]:
        target = 0.8 if case["server"] == "integer" else 0.9
        rows.append([f"`ActBatch` of 64, share of the engine's rate, {case['server']}", *verdict(case["share"], target)])
    for case in server["half_peak"]:
        of = f"at half the peak rate, {case['server']}, {case['mode']}, {case['sessions']} sessions"
        ours, echo = (1e3 * case[name]["p99_seconds"] for name in ("spikeserve", "echo"))
        rows.append([f"p99 {of}, ms", *verdict(ours, 1, at_least=False)])
        rows.append([f"p99 {of}, times the echo's", *verdict(ours / echo, 1, at_least=False)])
    for case in server["loops"]:
        rows.append([f"rate of two loops on two cores, times one's, {case['mode']}", *verdict(case["ratio"], 1.8)])
    return rows


def own_targets(own):
    rows = []
    for case in own:
        if case["policy"] in ("acrobot", "cartpole", "mountaincar", "pendulum"):
            of = f"share of the echo's rate, {case['policy']} on its own observations, {case['mode']}"
            rows.append([of, *verdict(case["share_of_echo"], OWN_SHARES[case["mode"]])])
    return rows


def learning_targets(learning):
    return [
        [
            f"share of the frozen rate, fleet learning, {case['mode']}, {case['sessions']} sessions",
            *verdict(case["share_of_decisions_per_second"], 0.9),
        ]
        for case in learning
        if case["scope"] == "fleet"
    ]


def fleet_targets(fleet):
    rows = []
    for case in fleet["durabilities"]:
        target = {"async redis": 0.9, "sync redis": 0.75}.get(case["server"])
        if target is not None:
            of = f"share of the processor rate without a store, {case['server']}, {case['mode']}, 64 sessions"
            rows.append([of, *verdict(case["share_of_processor"], target)])
    costs = [c["redis_processor_seconds_per_decision"] for c in fleet["durabilities"] if c["server"] == "async redis"]
    rows.append(["decisions a second that one Redis core takes, async", *verdict(1 / max(costs), 100_000)])
    for case in fleet["replicas"]:
        rows.append([f"rate of two replicas on two cores, times one's, {case['mode']}", *verdict(case["ratio"], 1.8)])
    return rows


def growth_targets(growth):
    rows = []
    for arithmetic in ("float32", "integer"):
        suffix = "" if arithmetic == "float32" else f", {arithmetic}"
        wide = ratio(growth, f"hidden_size=128{suffix}", f"hidden_size=512{suffix}") / (512 / 128) ** 2
        rows.append([f"cost at d = 512, times d² of d = 128, {arithmetic}", *verdict(wide, 1.3, at_least=False)])
        long = ratio(growth, f"context=100{suffix}", f"context=1000{suffix}")
        rows.append([f"cost at N = 1000, times N = 100, {arithmetic}", *verdict(long, 2, at_least=False)])
    return rows


def session_targets(sessions):
    bytes_of = {s["arithmetic"]: s["policy_bytes"] for s in sessions}
    active = max(s.get("active_bytes", 0) for s in sessions if s["sessions"] > 1)
    idle = max(s["idle_bytes"] for s in sessions if s["sessions"] > 1)
    return [
        ["MB a policy with its engine, integer", *verdict(bytes_of["integer"] / 1e6, 0.4, at_least=False)],
        ["KiB an active session", *verdict(active / 1024, 32, at_least=False)],
        ["KiB an idle session", *verdict(idle / 1024, 4, at_least=False)],
        ["idle sessions open at once", *verdict(max(s["sessions"] for s in sessions), 1_000_000)],
    ]


def targets_section(result):
    rows = []
    of = {
        "engine": engine_targets,
        "server": server_targets,
        "own": own_targets,
        "learning": learning_targets,
        "fleet": fleet_targets,
        "growth": growth_targets,
        "sessions": session_targets,
    }
    for key, targets in of.items():
        if key in result:
            rows += targets(result[key])
    return "## Targets\n\n" + table(["figure", "measured", "target", "met"], rows)


def engine_section(engine):
    rows = [
        [
            name,
            number(engine[key]["decisions_per_second"]),
            number(1e6 / engine[key]["decisions_per_second"]),
            number(engine[key]["spikes_per_decision"]) if engine[key]["spikes_per_decision"] else "-",
            number(ratio(engine, "spikeserve_silent", key)),
        ]
        for key, name in ENGINE_NAMES.items()
    ]
    header = ["contestant", "decisions/s", "µs a decision", "spikes a decision", "silent spikeserve is faster by"]
    text = "\nBoth cached dense models have the same weights. The benchmark stops unless their answers equal those of the "
    text += "engine in dense mode. [architecture.md](../../docs/design/architecture.md#what-bounds-a-decision) explains what limits "
    text += "this engine.\n"
    return "## Engine, one core\n\n" + table(header, rows) + text


def growth_section(growth):
    text = "## Growth\n\nEach table varies one parameter of random, unregularised policies of the paper's size. Episodes have "
    text += "500 steps; where the context N varies, 4 N steps. The table of episode lengths uses the shipped policy.\n\n"
    flags = dict.fromkeys(key.split("=")[0] for key in growth)
    for flag in flags:
        values = [key.split("=")[1] for key in growth if key.split("=")[0] == flag and "," not in key]
        rows = []
        for suffix, name in (("", ""), (", integer", ", integers")):
            cases = [growth[key] for value in values if (key := f"{flag}={value}{suffix}") in growth]
            if not cases:
                continue
            rows.append([f"µs a decision{name}", *(number(1e6 / r["decisions_per_second"]) for r in cases)])
            rows.append([f"spikes a decision{name}", *(number(r["spikes_per_decision"]) for r in cases)])
        text += table([flag, *values], rows) + "\n"
    return text.rstrip() + "\n"


def sessions_section(sessions):
    rows = [
        [
            f"{number(s['sessions'])}, {s['arithmetic']}",
            number(s["policy_bytes"]),
            number(s["opened_bytes"]),
            number(s["active_bytes"]) if "active_bytes" in s else "-",
            number(s["idle_bytes"]),
            number(s["resident_bytes"] / 2**20),
        ]
        for s in sessions
    ]
    header = ["sessions, policy", "bytes of the policy", "bytes opened", "bytes active", "bytes idle", "process, MiB resident"]
    text = "## Memory of a policy and of a session\n\nThe policy's figure is all memory of the policy and its engine, its training "
    text += "record included. With one session, the session's figure includes the empty shards of the store. An idle session is "
    return text + "compacted and has a full history.\n\n" + table(header, rows)


def closed_loop_section(server):
    rows = []
    for case in server["closed_loop"]:
        for name in ("float32", "integer", "echo"):
            ours = name != "echo"
            rows.append(
                [
                    f"{case['mode']}, {case['sessions']}, {name}",
                    number(case[name]["decisions_per_second"]),
                    f"{case['share_of_echo'][name]:.2f}" if ours else "",
                    number(case[name]["processor_seconds_per_decision"] * 1e6),
                    f"{case['processor_share_of_echo'][name]:.2f}" if ours else "",
                    number(case[name]["p50_seconds"] * 1e3),
                    number(case[name]["p99_seconds"] * 1e3),
                ]
            )
    header = ["mode, sessions, server", "calls/s", "share", "processor µs a call", "share", "p50, ms", "p99, ms"]
    text = "## Server on one core, load from the others, closed loop\n\nThe shares compare spikeserve with an empty echo on "
    text += "gRPC's own C++ server. Processor time is that of the server for each decision, including the opening and closing "
    text += "of sessions. It gives the rate of a server that is the bottleneck. spikeserve checks a token in each call.\n\n"
    return text + table(header, rows)


def half_peak_section(server):
    rows = [
        [
            f"{case['mode']}, {case['server']}",
            number(case["spikeserve"]["decisions_per_second"]),
            *(
                number(case[name][f"{quantile}_seconds"] * 1e3)
                for quantile in ("p50", "p99")
                for name in ("spikeserve", "echo")
            ),
        ]
        for case in server["half_peak"]
    ]
    text = f"{server['half_peak'][0]['sessions']} sessions send requests on a schedule at half of the peak rate of the "
    text += "server. Latency counts from the scheduled time of a request. The latency of the echo on the same schedule is the "
    text += "part of gRPC, the load generator and the machine.\n\n"
    return text + table(["mode, server", "decisions/s", "p50, ms", "echo p50, ms", "p99, ms", "echo p99, ms"], rows)


def batch_section(server):
    rows = [
        [case["server"], number(case["engine"]), number(case["server_rate"]), f"{case['share']:.2f}"]
        for case in server["batch"]
    ]
    text = "`ActBatch` of 64 sessions beside the engine alone, which decides for 64 sessions together. Decisions a second of "
    text += "processor time, in turns.\n\n"
    return text + table(["policy", "engine", "spikeserve", "share"], rows)


def loops_section(server):
    rows = [
        [
            case["mode"],
            *(number(case[f"loops_{count}"]) for count in (1, 2)),
            f"{case['ratio']:.2f}",
            *(number(case[f"cost_{count}"] * 1e6) for count in (1, 2)),
        ]
        for case in server["loops"]
    ]
    text = "One loop on one core and two loops on two, with the same 512 sessions of the policy in integers and the same load. "
    if not server["loops"][0]["own_cores"]:
        text += "The load generator shares the cores, so the rates are not those of a server that has them alone; the ratio is "
        text += "what the processor time of a call allows. "
    text = text.rstrip() + "\n\n"
    header = ["mode", "one loop, decisions/s", "two loops", "ratio", "one loop, processor µs a call", "two loops"]
    return text + table(header, rows)


def torch_section(server):
    rows = [
        [str(case["sessions"]), number(case["decisions_per_second"]), number(case["p99_seconds"] * 1e3)]
        for case in server["torch_server"]
    ]
    text = "A gRPC server in Python with the same policy in eager PyTorch, which recomputes the window. Unary calls.\n\n"
    return text + table(["sessions", "decisions/s", "p99, ms"], rows)


def server_section(server):
    sections = (closed_loop_section, half_peak_section, batch_section, loops_section, torch_section)
    return "\n".join(section(server) for section in sections)


def own_section(own):
    shares = {(case["policy"], case["mode"]): case for case in own}
    rows = []
    for policy in dict.fromkeys(case["policy"] for case in own):
        cases = [shares[policy, mode] for mode in OWN_SHARES]
        shares_of = ("share_of_echo", "processor_share_of_echo")
        cells = [[number(case["decisions_per_second"]), *(f"{case[share]:.2f}" for share in shares_of)] for case in cases]
        rows.append([policy, *cells[0], *cells[1]])
    header = ["policy"]
    for mode in OWN_SHARES:
        header += [f"{mode}, decisions/s", "share", "processor share"]
    text = "## Policies on observations of their own episodes\n\nThe default version of each policy whose environment the engine "
    text += "bench has, with 64 sessions that send an episode of this policy. The shares compare "
    text += "rates with the echo's, and the rates that the processor time of a decision allows.\n\n"
    return text + table(header, rows)


def learning_section(learning):
    rows = [
        [
            f"{case['mode']}, {case['scope']}",
            number(case["decisions_per_second"]),
            f"{case['share_of_decisions_per_second']:.3f}",
            number(case["processor_seconds_per_decision"] * 1e6),
            f"{case['share_of_processor_seconds_per_decision']:.3f}",
        ]
        for case in learning
    ]
    header = ["mode, scope", "decisions/s", "share of frozen", "processor µs", "share of frozen"]
    text = f"## Learning\n\n{learning[0]['sessions']} sessions learn with the default settings in episodes of 200 steps. The "
    return text + "shares compare them with as many frozen sessions in the same round.\n\n" + table(header, rows)


def durabilities_section(cases):
    rows = [
        [
            f"{case['mode']}, {case['server']}",
            number(case["decisions_per_second"]),
            f"{case['share_of_rate']:.2f}",
            number(case["processor_seconds_per_decision"] * 1e6),
            f"{case['share_of_processor']:.2f}",
            number(case["redis_processor_seconds_per_decision"] * 1e6) if "redis" in case["server"] else "",
            number(case["p99_seconds"] * 1e3),
        ]
        for case in cases
    ]
    header = ["mode, durability and store", "decisions/s", "share", "processor µs", "share", "Redis µs", "p99, ms"]
    text = "64 sessions of the policy in integers. The server has one core; Redis and the load generator share the others. The "
    text += "shares compare with `none`: the first that of the rates, the second that of the rates which the server's processor "
    text += "time allows. Redis has an append-only file that it synchronises each second; its time is that of the thread which "
    return text + "executes commands. A file store synchronises each group of records.\n\n" + table(header, rows)


def replicas_section(cases):
    rows = [
        [
            case["mode"],
            f"{case['ratio']:.2f}",
            *(number(case[f"replicas_{n}"]["processor_seconds_per_decision"] * 1e6) for n in (1, 2)),
            *(number(case[f"replicas_{n}"]["redis_processor_seconds_per_decision"] * 1e6) for n in (1, 2)),
        ]
        for case in cases
    ]
    header = ["mode", "ratio", "one replica, µs", "two", "one replica, Redis µs", "two"]
    text = "Two replicas, each with a core and 64 ASYNC sessions, and one replica with one core and 64 sessions, on one Redis "
    text += "server. The load generators and Redis share the cores. The ratio is two cores divided by the processor time of a "
    text += "decision with two replicas, over one core divided by that with one.\n\n"
    return text + table(header, rows)


def fleet_section(fleet):
    parts = [durabilities_section(fleet["durabilities"]), replicas_section(fleet["replicas"])]
    return "## Sessions in a store\n\n" + "\n".join(parts)


def to_markdown(result):
    machine = result["machine"]
    caches = ", ".join(" ".join(pair) for pair in zip(machine["caches"][::2], machine["caches"][1::2], strict=False))
    text = "# Performance\n\n`make lab-bench` writes this page. Do not edit it. "
    text += "[lab/bench](../bench/bench.py) makes the measurements.\n\n"
    text += f"Machine: {machine['processor']}, {machine['cores']} cores, {caches}; Linux {machine['kernel']}; load average "
    text += f"before the run {machine['load_before']:.2f}. Each of {result['rounds']} rounds measures every contestant for "
    text += f"{result['seconds']:g} s. The figures are medians over the rounds. The run took "
    text += f"{result['duration_seconds'] / 60:.1f} minutes. The figures of engines use processor time. "
    text += "No arm64 processor was timed.\n\n"
    sections = {
        "engine": engine_section,
        "server": server_section,
        "own": own_section,
        "learning": learning_section,
        "fleet": fleet_section,
        "growth": growth_section,
        "sessions": sessions_section,
    }
    parts = [write(result[key]) for key, write in sections.items() if key in result]
    return text + "\n".join([targets_section(result), *parts])
