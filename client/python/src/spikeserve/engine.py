"""The engine of spikeserve in this process, without a server: the package `spikeserve-engine`.

    session = spikeserve.engine.Engine("policy.safetensors").session()
    decision = session.act(observation, reward)

The decisions equal those of the server, bit for bit. The package needs neither gRPC nor this
client: a robot without them imports `spikeserve_engine`, which has the same names.
"""

from typing import TYPE_CHECKING, Any

try:
    import spikeserve_engine
    from spikeserve_engine import *  # noqa: F403
except ModuleNotFoundError as error:
    if error.name != "spikeserve_engine":
        raise
    raise ModuleNotFoundError(
        "spikeserve.engine: expected the package spikeserve-engine, received none; no index "
        "has it: install the wheel for this Python that `make dist` makes, "
        "dist/spikeserve_engine-*.whl"
    ) from error

__all__ = spikeserve_engine.__all__

if TYPE_CHECKING:

    def __getattr__(name: str) -> Any: ...
