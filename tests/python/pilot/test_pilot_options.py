"""The options of a pilot: which are refused, and times without an end."""

import math

import pytest
import spikeserve
from test_pilot import PERIOD, client, fly  # noqa: F401

# Options that every pilot refuses, and what it says.
REFUSED = [
    ({"max_age": 0}, "max_age: expected more than 0, received 0"),
    ({"hold_beats": -1}, "hold_beats: expected at least 0, received -1"),
    ({"ramp_beats": -1}, "ramp_beats: expected at least 0, received -1"),
    ({"in_flight": 65}, "in_flight: expected 1 to 64, received 65"),
    ({"kept_beats": 1}, "kept_beats: expected at least 2, received 1"),
    ({"redundancy": 3}, "redundancy: expected 1 or 2, received 3"),
    ({"close_timeout": -1}, "close_timeout: expected at least 0, received -1"),
]


def test_times_without_an_end_have_none(client, link, fly):
    forever = 1e300  # seconds: JSON, for the pilot in C++, has no infinity
    with fly(client, local=False, max_age=forever, close_timeout=forever) as flight:
        flight.until("fresh")
        link.delay = 0.1
        flight.end()
    flight.check_summaries()


@pytest.mark.parametrize("neutral", [[1.0, 2.0], "far", 3, [float("nan")]])
def test_a_neutral_action_belongs_to_the_action_space(client, neutral):
    with pytest.raises(ValueError, match="neutral: expected an action of the policy's action space, received ") as error:
        spikeserve.Pilot(client, "pendulum", PERIOD, neutral=neutral, local=False)
    assert str(neutral) in str(error.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": 0}, "period: expected 0.001 to 3600 s, received 0"),
        ({"budget": 1}, r"budget: expected 0 to period \(0.01\), received 1"),
        *REFUSED,
        ({"transport": "tcp"}, "transport: expected one of"),
        ({"local": False, "local_policy": "x"}, "local_policy: expected none with local=False"),
    ],
)
def test_the_options_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        spikeserve.PilotOptions(**{"period": PERIOD} | options)


def test_an_infinite_age_allows_the_most_requests():
    assert spikeserve.PilotOptions(period=PERIOD, max_age=math.inf).most_in_flight == 64
