"""A name that does not exist is NOT_FOUND, however many names there are, and the answer names the nearest ones."""

import shutil

import grpc
import gymnasium
import pytest
import spikeserve
from random_policy import export_random
from serving import running_server
from spikeserve.wire import METHODS

POLICIES, VERSIONS = 300, 1800


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    with gymnasium.make("CartPole-v1") as environment:
        export_random(folder, "fleet", environment, mode="baseline", hidden_size=4, ffn_size=4, layers=1)
    one = folder / "fleet/1"
    for index in range(POLICIES):
        shutil.copytree(one, folder / f"warehouse-arm-line-{index:04d}-pick-and-place/1")
    for version in range(2, VERSIONS + 1):
        shutil.copytree(one, folder / f"fleet/{version}")
    with running_server(folder) as server:
        yield server.grpc


WRONG = {
    "policy": ({"policy": "warehouse-arm-line-0042-pick-and-lace"}, "did you mean warehouse-arm-line-0042-pick-and-place?"),
    "many": ({"policy": "warehouse-arm-line-7"}, " more], received"),
    "version": ({"policy": "fleet", "version": 99999}, " more] of policy fleet, received 99999"),
    "long": ({"policy": "\u00fc" * 5000}, "received"),
}


@pytest.mark.parametrize(("request_fields", "reason"), WRONG.values(), ids=WRONG)
def test_a_wrong_name_is_not_found(request_fields, reason, address):
    with grpc.insecure_channel(address) as channel:
        call = METHODS["OpenSession"].bind(channel)
        for _ in range(5):  # some clients refuse large headers at random
            with pytest.raises(grpc.RpcError) as refused:
                call(METHODS["OpenSession"].request(**request_fields), timeout=30)
            assert refused.value.code() == grpc.StatusCode.NOT_FOUND, refused.value.details()
            assert reason in refused.value.details()
            assert len(refused.value.details()) < 1300


def test_the_python_client_raises_at_once(address):
    with spikeserve.Client(address) as client, pytest.raises(spikeserve.NotFoundError, match="did you mean fleet"):
        client.open_session("Fleet").__enter__()
