"""The pilot: every beat of a robot has an action, whatever the link does.

`pilot` has the class that robots use, `link` its background thread, `beat_log` what the server does
not know yet, `fallback_order` the choice of an action, `local_copy` the session on the robot's own
engine.
"""
