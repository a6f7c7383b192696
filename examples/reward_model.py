"""A reward model: judges the episodes of CartPole-v1 that a server has recorded, after their ends.

Start a server that records, a session that waits for verdicts, and this program beside them:

    spikeserve --policies=deploy/policies --record_dir=/tmp/recordings
    python -m spikeserve reward_model /tmp/recordings --model=reward_model:judge   # in examples
    python examples/reward_model.py                                                # plays

The session learns from an episode when its verdict has come, or after a minute. The recording keeps
the rewards that were received; its file of amendments has those of the verdict.
"""

import sys

import gymnasium
import numpy as np
import spikeserve

POLE_ANGLE = 2  # element of the observation, in radians


def judge(episode):
    """Returns the verdict about one recorded episode: a reward for each step, and a label.

    A learned model would be called here. This one prefers a pole that stands still.
    """
    angles = np.abs(episode.observations[1:, POLE_ANGLE])
    angles = np.nan_to_num(angles, nan=0.21)  # the robot may not have sent the last observation
    return {
        "rewards": (1.0 - angles / 0.21).tolist(),
        "success": bool(len(angles) >= 400),
        "label": "steady" if angles.mean() < 0.05 else "shaky",
    }


def play(server, episodes=5):
    """Plays without rewards, because nobody knows them yet."""
    environment = gymnasium.make("CartPole-v1")
    options = spikeserve.SessionOptions(
        sample=True,
        record=True,
        learning=spikeserve.Learning(verdict_seconds=60.0),
    )
    with spikeserve.Client(server) as client, client.open_session("cartpole", options) as session:
        for seed in range(episodes):
            observation, _ = environment.reset(seed=1_000_000 + seed)
            reward, terminated, truncated = 0.0, False, False
            while not (terminated or truncated):
                action = session.act(observation, reward).action
                observation, _, terminated, truncated, _ = environment.step(action)
            ended = session.end_episode(0.0, terminated, truncated, observation=observation)
            print(f"{ended.steps} steps, awaits its verdict: {ended.awaits_verdict}")
        print(f"drift of the head: {session.state().head_drift:.4f}")


if __name__ == "__main__":
    play(*sys.argv[1:] or [None])
