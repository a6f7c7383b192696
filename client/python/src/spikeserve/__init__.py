"""Client of spikeserve, the inference service for Spiking Decision Transformers.

Start with `Client` and `Session`. `VectorSession` acts in Gymnasium vector environments.
`AsyncClient` is the client for asyncio. `evaluate` plays whole episodes. `AdminClient` has the
calls of operators. The module `spikeserve.export` writes policy files. `spikeserve.engine` plays
them without a server, and `imitate` trains them for any Gymnasium environment.
"""

import importlib.metadata
import pkgutil

from spikeserve.admin import AdminClient, AsyncAdminClient
from spikeserve.async_client import AsyncClient
from spikeserve.async_session import AsyncSession
from spikeserve.async_stream import AsyncActStream
from spikeserve.async_vector_session import AsyncVectorSession
from spikeserve.client import Client
from spikeserve.connection import ClientOptions
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
from spikeserve.explanation import Attention, Explanation, RoutingGates, SpikeRaster, Token
from spikeserve.imitating import imitate
from spikeserve.retry import RetryOptions
from spikeserve.session import Session
from spikeserve.spaces import ActionSpace, Box, Discrete
from spikeserve.stream import ActStream
from spikeserve.values import (
    Action,
    Decision,
    EpisodeSummary,
    Learning,
    LearningSummary,
    Opening,
    Policy,
    SessionOptions,
    SessionState,
    Stats,
)
from spikeserve.vector_session import VectorSession

__version__ = importlib.metadata.version("spikeserve")

# Code that protoc generates from the wire contract is in folders spikeserve/v1 elsewhere on the
# path. So it is importable beside this package, as spikeserve.v1.policy_service_pb2.
__path__ = pkgutil.extend_path(__path__, __name__)

__all__ = [
    "ActStream",
    "Action",
    "ActionSpace",
    "AdminClient",
    "AsyncActStream",
    "AsyncAdminClient",
    "AsyncClient",
    "AsyncSession",
    "AsyncVectorSession",
    "Attention",
    "Box",
    "Client",
    "ClientOptions",
    "DeadlineExceededError",
    "Decision",
    "Discrete",
    "DivergedError",
    "EpisodeSummary",
    "Evaluation",
    "EvaluationStoppedError",
    "Explanation",
    "FailedPreconditionError",
    "InvalidArgumentError",
    "Learning",
    "LearningSummary",
    "NotFoundError",
    "Opening",
    "PermissionDeniedError",
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
    "__version__",
    "evaluate",
    "imitate",
]
