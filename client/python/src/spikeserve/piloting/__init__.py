"""The pilot: every beat of a robot has an action, whatever the link does.

`pilot` has the class that robots use, `link` its background thread and calls, `local_engine` the
session on the robot's own engine. What is done is decided by the state machine of `core/robot`,
which `robot_messages` imports: the C++ client's pilot has the same one.
"""
