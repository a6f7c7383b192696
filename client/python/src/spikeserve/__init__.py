"""Client of spikeserve, the inference service for Spiking Decision Transformers.

Start with `Client` and `Session`, on a robot with `Pilot`. `VectorSession` acts in Gymnasium
vector environments. `AsyncClient` is the client for asyncio. `evaluate` plays whole episodes.
`AdminClient` has the calls of operators, and `Operator` holds robots and acts for them. The module
`spikeserve.export` writes policy files.
`spikeserve.engine` plays them without a server. The package spikeserve-train adds `imitate`, which
trains them for any Gymnasium environment.
"""

import importlib.metadata
import pkgutil
from typing import Any

from spikeserve.admin import AdminClient, AsyncAdminClient
from spikeserve.async_client import AsyncClient
from spikeserve.async_session import AsyncSession
from spikeserve.async_stream import AsyncActStream
from spikeserve.async_vector_session import AsyncVectorSession
from spikeserve.channels import ClientOptions
from spikeserve.client import Client
from spikeserve.errors import (
    DeadlineExceededError,
    DivergedError,
    FailedPreconditionError,
    InvalidArgumentError,
    NotFoundError,
    PermissionDeniedError,
    ResourceExhaustedError,
    SessionLostError,
    SpikeserveError,
    UnauthenticatedError,
    UnavailableError,
    UnimplementedError,
)
from spikeserve.evaluation import Evaluation, EvaluationStoppedError, evaluate
from spikeserve.executed import Executed
from spikeserve.explanation import Attention, Explanation, RoutingGates, SpikeRaster, Token
from spikeserve.operators import Control, HeldRobot, HoldVerdict, Operator
from spikeserve.piloting.pilot import Pilot
from spikeserve.piloting.pilot_options import PilotAction, PilotOptions
from spikeserve.piloting.pilot_stats import PilotStats
from spikeserve.retry import RetryOptions
from spikeserve.session import Session
from spikeserve.spaces import ActionSpace, Box, Discrete
from spikeserve.stream import ActStream
from spikeserve.values import (
    Action,
    AmendedEpisode,
    Corrections,
    Decision,
    EpisodeSummary,
    Feature,
    Hold,
    Learning,
    LearningSummary,
    Opening,
    Policy,
    SessionOptions,
    SessionState,
    Stats,
    WiringVerdict,
)
from spikeserve.vector_session import VectorSession

TRAIN = "spikeserve-train (pip install ./train/python in a checkout, or its wheel)"
__version__ = importlib.metadata.version("spikeserve")

# Code that protoc generates from the wire contract is in folders spikeserve/v1 elsewhere on the
# path. So it is importable beside this package, as spikeserve.v1.policy_service_pb2. So are the
# modules of the package spikeserve-train (train/python).
__path__ = pkgutil.extend_path(__path__, __name__)

__all__ = [
    "ActStream",
    "Action",
    "ActionSpace",
    "AdminClient",
    "AmendedEpisode",
    "AsyncActStream",
    "AsyncAdminClient",
    "AsyncClient",
    "AsyncSession",
    "AsyncVectorSession",
    "Attention",
    "Box",
    "Client",
    "ClientOptions",
    "Control",
    "Corrections",
    "DeadlineExceededError",
    "Decision",
    "Discrete",
    "DivergedError",
    "EpisodeSummary",
    "Evaluation",
    "EvaluationStoppedError",
    "Executed",
    "Explanation",
    "FailedPreconditionError",
    "Feature",
    "HeldRobot",
    "Hold",
    "HoldVerdict",
    "InvalidArgumentError",
    "Learning",
    "LearningSummary",
    "NotFoundError",
    "Opening",
    "Operator",
    "PermissionDeniedError",
    "Pilot",
    "PilotAction",
    "PilotOptions",
    "PilotStats",
    "Policy",
    "ResourceExhaustedError",
    "RetryOptions",
    "RoutingGates",
    "Session",
    "SessionLostError",
    "SessionOptions",
    "SessionState",
    "SpikeRaster",
    "SpikeserveError",
    "Stats",
    "Token",
    "UnauthenticatedError",
    "UnavailableError",
    "UnimplementedError",
    "VectorSession",
    "WiringVerdict",
    "__version__",
    "evaluate",
]


def __getattr__(name: str) -> Any:
    """Returns `imitate` of the package spikeserve-train."""
    if name != "imitate":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from spikeserve.imitating import imitate
    except ModuleNotFoundError as error:
        raise AttributeError(f"imitate: expected the package {TRAIN}, received none") from error
    return imitate
