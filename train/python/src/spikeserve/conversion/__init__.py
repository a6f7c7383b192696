"""Converts robots' data: LeRobotDataset v3, MCAP logs, Minari and recordings of a server.

    from spikeserve.conversion import Selection, convert

    convert("robot/logs", "datasets/robot-v0", to="minari", selection=Selection(action="/command"))

The packages that the formats need are those of the extra `[robots]` of spikeserve-train.
"""

from spikeserve.conversion.converting import FORMATS, convert, format_of
from spikeserve.conversion.data import Episode, RobotData, Selection

__all__ = ["FORMATS", "Episode", "RobotData", "Selection", "convert", "format_of"]
