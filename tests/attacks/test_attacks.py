"""What a stranger without a token sends leaves the server's memory and its neighbours as they were."""

import json

import pytest
from security import TOKENS, make_authority, make_certificate

from tests.attacks.catalogue import ATTACKS
from tests.attacks.observation import SERVED_SECONDS, observe
from tests.attacks.process import MEGABYTE

ATTACK_SECONDS = 0.8
IDLE_SECONDS = 0.2
PEAK_LIMIT = 150 * MEGABYTE
RETURN_LIMIT = 20 * MEGABYTE


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    path = tmp_path_factory.mktemp("certificates")
    make_authority(path, "ca")
    make_certificate(path, "server", "ca")
    return path


@pytest.fixture(scope="module")
def tokens(tmp_path_factory):
    path = tmp_path_factory.mktemp("tokens") / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    return path


@pytest.mark.parametrize("name", ATTACKS)
def test_the_server_outlives(name, tokens, certificates):
    seen = observe(ATTACKS[name], tokens, certificates, ATTACK_SECONDS, IDLE_SECONDS, RETURN_LIMIT)
    print(seen)
    assert seen.alive, "the server has ended, or was killed for its memory"
    assert seen.sent["connections"] > 0
    assert seen.peak < PEAK_LIMIT
    assert seen.after < RETURN_LIMIT
    assert seen.served_after is not None, f"no new client was served within {SERVED_SECONDS} s"
