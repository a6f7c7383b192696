"""A robot for the test of the ROS 2 node: CartPole, whose sensors and motors are topics.

Publishes its observation, moves by each action that it gets, publishes the reward, and ends its episodes. Prints one line of
JSON for each episode, and one for the diagnostics that it saw last. Exits after the given number of episodes.

usage: cartpole_robot.py array|joints EPISODES MOST_STEPS
"""

import json
import sys

import gymnasium
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Float32MultiArray
from std_srvs.srv import SetBool


class Robot(Node):
    """The robot. It moves only when an action comes that a policy has chosen for an observation."""

    def __init__(self, kind, episodes, most_steps):
        super().__init__("robot")
        self._kind, self._left, self._most_steps = kind, episodes, most_steps
        self._environment = gymnasium.make("CartPole-v1", max_episode_steps=most_steps)
        self._observation, _ = self._environment.reset(seed=7)
        self._return, self._sources, self._ending = 0.0, {}, None
        self.diagnostics = None
        topic = JointState if kind == "joints" else Float32MultiArray
        name = "joint_states" if kind == "joints" else "observation"
        self._observations = self.create_publisher(topic, f"/spikeserve/{name}", 1)
        self._rewards = self.create_publisher(Float32, "/spikeserve/reward", 100)
        self._end_episode = self.create_client(SetBool, "/spikeserve/end_episode")
        self.create_subscription(Float32MultiArray, "/spikeserve/action", self._on_action, 1)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 1)
        self.create_timer(0.02, self._publish)

    @property
    def is_done(self):
        return self._left == 0 and self.diagnostics is not None

    def _publish(self):
        if self._ending is not None:
            return
        values = [float(value) for value in self._observation]
        if self._kind == "array":
            self._observations.publish(Float32MultiArray(data=values))
        else:
            slider, slider_speed, hinge, hinge_speed = values
            # In another order than the observation, with a joint that the policy does not know.
            self._observations.publish(
                JointState(
                    name=["lamp", "hinge", "slider"],
                    position=[0.5, hinge, slider],
                    velocity=[0.0, hinge_speed, slider_speed],
                )
            )

    def _on_action(self, message):
        source = message.layout.dim[0].label
        self._sources[source] = self._sources.get(source, 0) + 1
        if source in ("lost", "safe") or self._ending is not None or self._left == 0:
            return
        force = message.data[0]
        assert self._kind == "array" or force in (-10.0, 10.0), force
        action = int(force) if self._kind == "array" else int(force > 0)
        self._observation, reward, terminated, truncated, _ = self._environment.step(action)
        self._return += reward
        self._rewards.publish(Float32(data=float(reward)))
        if terminated or truncated:
            self._ending = self._end_episode.call_async(SetBool.Request(data=terminated))
            self._ending.add_done_callback(self._begin_episode)
        else:
            self._publish()

    def _begin_episode(self, ending):
        assert ending.result().success
        print(json.dumps({"return": self._return, "sources": self._sources}), flush=True)
        self._left -= 1
        self._observation, _ = self._environment.reset()
        self._return, self._sources, self._ending = 0.0, {}, None

    def _on_diagnostics(self, message):
        [status] = message.status
        self.diagnostics = {
            "level": status.level[0],
            "message": status.message,
            "values": {value.key: value.value for value in status.values},
        }


def main():
    kind, episodes, most_steps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    rclpy.init()
    robot = Robot(kind, episodes, most_steps)
    while not robot.is_done:
        rclpy.spin_once(robot)
    print(json.dumps(robot.diagnostics), flush=True)


if __name__ == "__main__":
    main()
