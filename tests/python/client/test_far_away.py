"""spikectl plays as if the server were far away, and over a connection that a NAT has forgotten."""

import json
import os
import subprocess

import pytest
import spikeserve
from links import Link
from serving import run
from spikeserve.distance import Arrivals, Distance, neutral_action

SEED = 5000


def spikectl(*arguments):
    """Runs spikectl. Returns the finished process."""
    return run("spikectl", *arguments, status=None)


def returns_of(address, *arguments):
    """Returns the returns of two episodes of Pendulum."""
    played = spikectl(
        "run", f"--server={address}", "--env=Pendulum-v1", f"--seed={SEED}", "--episodes=2", "--json", *arguments
    )
    assert played.returncode == 0, played.stderr
    return [episode["return"] for episode in json.loads(played.stdout)["episodes"]]


@pytest.mark.parametrize("delay", [0, 3])
def test_a_delay_costs_what_it_costs_in_python(address, delay):
    evaluation = spikeserve.evaluate("Pendulum-v1", server=address, episodes=2, seed=SEED, delay=delay)
    assert returns_of(address, f"--delay={delay}") == pytest.approx(evaluation.returns, rel=1e-9)


def test_jitter_and_loss_change_the_returns_and_the_seed_repeats_them(address):
    far = returns_of(address, "--delay=1", "--jitter=3", "--loss=0.2")
    assert far == returns_of(address, "--delay=1", "--jitter=3", "--loss=0.2")
    assert far != returns_of(address, "--delay=1")


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--delay=-1", "--delay: expected at least 0 steps, received -1"),
        ("--jitter=-1", "--jitter: expected at least 0 steps, received -1"),
        ("--loss=1", "--loss: expected 0 to less than 1, received 1"),
    ],
)
def test_the_flags_are_checked(address, flag, message):
    refused = spikectl("run", f"--server={address}", "--env=CartPole-v1", flag)
    assert refused.returncode != 0
    assert message in refused.stderr


def episodes_of(lines):
    """Returns the seed, return and decisions of each line of an episode."""
    words = [line.split() for line in lines]
    return [word[:3] for word in words if word and word[0].isdigit()]


def test_it_plays_on_when_a_nat_has_forgotten_the_connection(address):
    arguments = ["run", "--env=CartPole-v1", "--episodes=6"]
    undisturbed = spikectl(*arguments, f"--server={address}")
    with Link(address) as link:
        command = [os.environ["SPIKECTL_PROGRAM"], *arguments, f"--server={link.address}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as playing:
            lines = []
            while not episodes_of(lines):
                lines.append(playing.stdout.readline())
                assert lines[-1]
            link.forget()
            lines += playing.stdout.readlines()
            assert playing.wait() == 0
        assert link.accepted >= 2
    assert len(episodes_of(lines)) == 6
    assert episodes_of(lines) == episodes_of(undisturbed.stdout.splitlines())


def test_decisions_of_a_far_server_arrive_later():
    arrivals = Arrivals(Distance(delay=2), spikeserve.Discrete(9), seed=0)
    assert [arrivals.executed(beat, beat + 1) for beat in range(6)] == [0, 0, 1, 2, 3, 4]
    late = Arrivals(Distance(delay=1, jitter=3, loss=0.3), spikeserve.Discrete(99), seed=0)
    executed = [late.executed(beat, beat + 1) for beat in range(60)]
    assert executed == sorted(executed)  # an older decision never follows a newer one
    assert all(action <= beat for beat, action in enumerate(executed))
    assert executed[-1] > 50
    assert neutral_action(spikeserve.Box((-1.0, 2.0), (1.0, 4.0))).tolist() == [0.0, 3.0]


@pytest.mark.parametrize("options", [{"delay": -1}, {"jitter": -1}, {"loss": 1.0}])
def test_a_distance_is_checked(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}: expected "):
        Distance(**options)
