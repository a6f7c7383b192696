"""Answers clients of other robot stacks from policies of a spikeserve server.

    python -m spikeserve.gateway --openpi --policy=cartpole --mapping=mapping.json

docs/guides/openpi.md describes the protocol and the mapping file. Needs the extra `[gateway]`.
"""
