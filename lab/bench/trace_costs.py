#!/usr/bin/env python3
"""Measures what a decision costs the server if it exports traces, but samples none: processor time, beside a server that exports none.

The servers answer blocks of calls in turns. A ratio is the median of the ratios within a turn, with its interval of 95 %
by the bootstrap. Waiting and the client do not count.

    build/venv/bin/python lab/bench/trace_costs.py --server=build/release/bin/spikeserve
"""

import argparse
import contextlib
import os
import pathlib
import random
import statistics
import sys

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

import grpc  # noqa: E402
import programs  # noqa: E402
from security import OBSERVATION, POLICY  # noqa: E402
from serving import Service, running_server  # noqa: E402

UNSAMPLED = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-00"
EXPORT = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:9", "OTEL_TRACES_SAMPLER": "parentbased_traceidratio"}
EXPORT |= {"OTEL_TRACES_SAMPLER_ARG": "0"}
PLAIN, NO_PARENT, PARENT = "no traces", "traces, call without traceparent", "traces, unsampled traceparent"


class Traceparent(grpc.UnaryUnaryClientInterceptor):
    """Adds an unsampled traceparent to each call."""

    def intercept_unary_unary(self, continuation, details, request):
        metadata = [("traceparent", UNSAMPLED)]
        return continuation(details._replace(metadata=metadata), request)


class Contestant:
    """A server, and a robot that plays there."""

    def __init__(self, stack, variables, interceptor=None):
        os.environ.update(variables)
        addresses = stack.enter_context(running_server(flags=["--loops=1"]))
        for name in variables:
            del os.environ[name]
        self._pid = addresses.process.pid
        channel = stack.enter_context(grpc.insecure_channel(addresses.grpc))
        self._service = Service(channel, POLICY, interceptor and grpc.intercept_channel(channel, interceptor))
        self._session = self._service.OpenSession(policy="cartpole").session_id
        self._step = 0

    def measure(self, calls):
        """Returns the processor time of one decision of `calls`."""
        before = programs.processor_seconds(self._pid)
        for _ in range(calls):
            self._service.Act(session_id=self._session, step=self._step, observation=OBSERVATION)
            self._step += 1
        return (programs.processor_seconds(self._pid) - before) / calls


def interval(values, draws=2000):
    """Returns the interval of 95 % of the median by the bootstrap."""
    generator = random.Random(1)
    medians = sorted(statistics.median(generator.choices(values, k=len(values))) for _ in range(draws))
    return medians[draws // 40], medians[-1 - draws // 40]


def main():
    """Starts the servers, calls them in turns, prints the table."""
    parser = argparse.ArgumentParser(prog="trace_costs.py", description=__doc__.splitlines()[0])
    parser.add_argument("--server", required=True, help="the program")
    parser.add_argument("--turns", type=int, default=100, help="blocks of calls of each server [100]")
    parser.add_argument("--calls", type=int, default=500, help="of a block [500]")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.server
    with contextlib.ExitStack() as stack:
        contestants = {
            PLAIN: Contestant(stack, {}),
            NO_PARENT: Contestant(stack, EXPORT),
            PARENT: Contestant(stack, EXPORT, Traceparent()),
        }
        names = list(contestants)
        for contestant in contestants.values():
            contestant.measure(arguments.calls)  # warms up
        turns = []
        for turn in range(arguments.turns):
            order = names[turn % 3 :] + names[: turn % 3]
            turns.append({name: contestants[name].measure(arguments.calls) for name in order})
    print("| server | processor time of a decision, us | ratio | interval of 95 % |")
    print("| --- | ---: | ---: | --- |")
    for name in names:
        ratios = [turn[name] / turn[PLAIN] for turn in turns]
        low, high = interval(ratios)
        cost = 1e6 * statistics.median(turn[name] for turn in turns)
        print(f"| {name} | {cost:.1f} | {statistics.median(ratios):.3f} | {low:.3f} to {high:.3f} |")


if __name__ == "__main__":
    main()
