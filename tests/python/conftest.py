"""What several test files ask for."""

import pytest
from serving import running_server


@pytest.fixture(scope="module")
def address():
    """The gRPC address of a server with the shipped policies."""
    with running_server() as addresses:
        yield addresses.grpc
