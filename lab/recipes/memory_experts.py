"""Experts for tasks that one observation does not solve: POPGym's RepeatFirst, RepeatPrevious,
CountRecall, Autoencode and Concentration, MiniGrid's Memory.

    python -m spikeserve imitate popgym:popgym-RepeatFirstEasy-v0 --expert memory_experts:repeat_first
"""

import numpy as np

RIGHT, LEFT = 0, 2  # directions of MiniGrid; a turn to the right adds 1
OBJECT_X = 1  # the object to remember is above the hallway's row, in the first column
KEY, BALL = 5, 6  # MiniGrid's indices of the two objects


def repeat_first(environment, observation):
    """The expert of RepeatFirst: the suit of the first card."""
    return int(environment.card)


def repeat_previous(environment, observation):
    """The expert of RepeatPrevious: the suit of the card that was dealt k - 1 cards ago, or of the first card."""
    deck = environment.deck
    cards = deck["player"]
    return int(deck.suits_idx[cards[-min(environment.k, len(cards))]])


def count_recall(environment, observation):
    """The expert of CountRecall: how often the card that is asked for was dealt, the newest card included."""
    return int(environment.counts[environment.query])


def autoencode(environment, observation):
    """The expert of Autoencode: the suit of the card on top of the pile, which is the newest one while cards are dealt."""
    deck = environment.deck
    return int(deck.suits_idx[deck["system"][-1]])


def concentration(environment, observation):
    """The expert of Concentration: turns cards over from the first place on, and pairs those it has seen as soon as it can."""
    if environment.curr_step == 0:
        environment.seen_places = set()
    environment.seen_places |= set(environment.last_in_play_idx)
    deck = environment.deck
    hidden = set(range(len(deck))) - set(deck["face_up_idx"]) - set(deck["in_play_idx"])
    known = sorted(hidden & environment.seen_places)
    unknown = sorted(hidden - environment.seen_places)
    values = environment.deck_idx_type[deck.idx]
    if deck["in_play_idx"]:
        open_value = values[deck["in_play_idx"][0]]
        choices = [place for place in known if values[place] == open_value]
    else:
        choices = [place for i, place in enumerate(known) if values[place] in values[known[i + 1 :]]]
    return int([*choices, *unknown, *known][0])


def find_match(environment, observation):
    """The expert of MiniGrid's Memory: looks at the object in the start room, then goes to its equal.

    When it sees the object it executes an action without effect, `drop` for a key and `done` for a
    ball. A policy that imitates it thereby writes what it has to remember into its context.
    """
    if environment.step_count == 0:
        environment.expert_notes = _Notes()
    notes = environment.expert_notes
    place = (OBJECT_X, environment.height // 2 - 1)
    if notes.seen is None:
        notes.seen = _object_in_view(environment, place)
    if notes.seen is None:
        return _walk(environment, LEFT)
    if notes.must_write((*environment.agent_pos, environment.agent_dir)):
        return int(environment.actions.drop if notes.seen == KEY else environment.actions.done)
    x, y = environment.agent_pos
    target_x, target_y = environment.success_pos
    if x < target_x:
        return _walk(environment, RIGHT)
    return _walk(environment, 1 if target_y > y else 3)


class _Notes:
    """What the expert remembers of an episode."""

    def __init__(self):
        self.seen = None  # KEY or BALL
        self._pose = None  # where the note was asked for, until it was executed
        self._written = False

    def must_write(self, pose):
        """Returns whether the note is to be written. Another action moves the agent, and a note does not."""
        self._written = self._written or pose == self._pose
        self._pose = pose
        return not self._written


def _object_in_view(environment, place):
    """Returns KEY or BALL if the agent sees the object at `place`, or None."""
    if not environment.in_view(*place):
        return None
    column, row = environment.get_view_coords(*place)
    index = environment.gen_obs()["image"][column, row, 0]
    return int(index) if index in (KEY, BALL) else None


def _walk(environment, direction):
    """Returns the action of a step into a direction: forward, or the shorter turn."""
    turn = (direction - environment.agent_dir) % 4
    forward, left, right = (environment.actions[name] for name in ("forward", "left", "right"))
    return int(np.select([turn == 0, turn == 3], [forward, left], right))
