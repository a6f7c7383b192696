"""The streaming engine of spikeserve, for programs that play a policy without a server.

    engine = Engine("policy.safetensors")
    session = engine.session()
    decision = session.act(observation)
    decision = session.act(observation, reward)
    summary = session.end_episode(reward, terminated=True)

`Engine.act_batch` decides for many sessions at once. The decisions equal those of the server, bit
for bit. All methods release the global interpreter lock while they compute.
"""

from spikeserve_engine._engine import (
    Attention,
    Batch,
    Box,
    Decision,
    Discrete,
    Engine,
    EpisodeSummary,
    Explanation,
    LearningSummary,
    RoutingGates,
    Session,
    SessionState,
    SpikeRaster,
    Stats,
    Token,
)
from spikeserve_engine.learning import Learning

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
