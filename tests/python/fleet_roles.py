"""Chooses ids of sessions by their role in a fleet (core/learning/held_out.h)."""

import secrets


def is_held_out(session_id):
    value = 2166136261
    for byte in session_id.encode():
        value = (value ^ byte) * 16777619 % 2**32
    return value * 5 >> 32 == 0


def new_session_id(held_out=False):
    """Returns an id of a session that is held out, or that contributes."""
    while is_held_out(session_id := secrets.token_hex(16)) != held_out:
        pass
    return session_id
