"""A ROS 2 node that lets a spikeserve policy act on a robot.

Only `spikeserve_ros.node` imports rclpy. The other modules have the node's logic, as plain Python.
"""
