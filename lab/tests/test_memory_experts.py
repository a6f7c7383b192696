"""The expert of POPGym's Concentration remembers every card it has seen, and needs no luck with those."""

import gymnasium
import popgym  # noqa: F401  registers the environments
import pytest
from memory_experts import concentration


@pytest.fixture
def environment():
    made = gymnasium.make("popgym-ConcentrationEasy-v0")
    yield made.unwrapped
    made.close()


@pytest.mark.parametrize("seed", range(5))
def test_a_pair_of_known_cards_is_taken(environment, seed):
    observation, _ = environment.reset(seed=seed)
    turned, values = set(), environment.deck_idx_type[environment.deck.idx]
    done = False
    while not done:
        action = concentration(environment, observation)
        hidden = set(range(len(values))) - set(environment.deck["face_up_idx"])
        opened = environment.deck["in_play_idx"]
        assert action in hidden - set(opened)
        place = opened[0] if opened else action
        equal = {known for known in turned & hidden - {place} if values[known] == values[place]}
        # A known card is turned over for its equal alone, and an unknown one if there is no such pair.
        assert (action in turned) == bool(equal) or not opened
        assert action not in turned or equal
        turned.add(action)
        observation, _, done, truncated, _ = environment.step(action)
        assert not truncated
    assert set(environment.deck["face_up_idx"]) == set(range(len(values)))


def test_a_card_that_something_else_turned_is_known(environment):
    """Bursts of random actions replace those of the expert while data are recorded."""
    observation, _ = environment.reset(seed=7)
    values = environment.deck_idx_type[environment.deck.idx]
    first = next(place for place in range(10, 52) if values[place] == values[0])
    other = next(place for place in range(10, 52) if values[place] != values[0])
    for action in (first, other):
        concentration(environment, observation)
        observation, *_ = environment.step(action)
    assert concentration(environment, observation) == 0  # nothing is known of it
    environment.step(0)
    assert concentration(environment, observation) == first
