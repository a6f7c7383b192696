"""The engine of spikeserve in this process, without a server: the package `spikeserve-engine`.

    session = spikeserve.engine.Engine("policy.safetensors").session()
    decision = session.act(observation, reward)

The decisions equal those of the server, bit for bit. The package needs neither gRPC nor this
client: a robot without them imports `spikeserve_engine`, which has the same names.
"""

try:
    from spikeserve_engine import (
        Attention,
        Batch,
        Box,
        Decision,
        Discrete,
        Engine,
        EpisodeSummary,
        Explanation,
        Learning,
        LearningSummary,
        RoutingGates,
        Session,
        SessionState,
        SpikeRaster,
        Stats,
        Token,
    )
except ModuleNotFoundError as error:
    if error.name != "spikeserve_engine":
        raise
    raise ModuleNotFoundError(
        "spikeserve.engine: expected the package spikeserve-engine, received none; no index "
        "has it: install the wheel for this Python that `make dist` makes, "
        "dist/spikeserve_engine-*.whl"
    ) from error

__all__ = [
    "Attention",
    "Batch",
    "Box",
    "Decision",
    "Discrete",
    "Engine",
    "EpisodeSummary",
    "Explanation",
    "Learning",
    "LearningSummary",
    "RoutingGates",
    "Session",
    "SessionState",
    "SpikeRaster",
    "Stats",
    "Token",
]
