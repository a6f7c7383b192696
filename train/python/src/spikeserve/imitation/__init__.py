"""From any Gymnasium environment and any expert to a policy that the server serves.

`spikeserve.imitate` and `python -m spikeserve imitate` start here;
docs/guides/imitation.md explains them.
"""

from spikeserve.imitation.options import ImitationOptions

__all__ = ["ImitationOptions"]
