"""Plays one episode of CartPole with the decisions of a server.

usage: python examples/call.py [HOST:PORT]

Needs the Python client: pip install "./client/python[gymnasium]"
"""

import sys

import gymnasium
import spikeserve


def play(client, seed):
    """Plays an episode from the start that Gymnasium gives to `seed`. Returns its summary and its last decision."""
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=seed)
    reward, terminated, truncated = 0.0, False, False
    with client.open_session("cartpole") as session:
        while not (terminated or truncated):
            decision = session.act(observation, reward)  # the reward of the action before
            observation, reward, terminated, truncated, _ = environment.step(decision.action)
        return session.end_episode(reward, terminated, truncated), decision


def main():
    with spikeserve.Client(sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:50051") as client:
        summary, decision = play(client, seed=1_000_000)
    print(f"return {summary.episode_return:.0f} in {summary.steps} steps")
    print(f"{summary.spikes / summary.steps:.1f} spikes a decision; the last one, by population:")
    print(decision.stats.spikes_by_stage)


if __name__ == "__main__":
    main()
