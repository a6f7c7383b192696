"""What strangers send to the status page: many ranges, and names of other sites."""

import http.client

import pytest
from serving import running_server

from tests.attacks.process import MEGABYTE, Process

RANGES = 2600


@pytest.fixture(scope="module")
def addresses():
    with running_server() as started:
        yield started


def get(addresses, path, **headers):
    connection = http.client.HTTPConnection(addresses.http, timeout=30)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response.status, body


def test_ranges_are_ignored(addresses):
    status, whole = get(addresses, "/vendor/uplot/uPlot.iife.min.js")
    assert status == 200
    process = Process(addresses.process.pid)
    idle = process.memory()
    process.reset_peak()
    ranges = "bytes=" + ",".join(["0-"] * RANGES)
    assert get(addresses, "/vendor/uplot/uPlot.iife.min.js", Range=ranges) == (200, whole)
    assert get(addresses, "/vendor/uplot/uPlot.iife.min.js", Range="bytes=0-9") == (200, whole)
    assert process.peak() - idle < 5 * MEGABYTE


OWN_NAMES = ["localhost", "localhost:1", "127.0.0.1", "127.0.0.1:9", "[::1]:80"]
OTHER_NAMES = ["evil.example", "evil.example:9464", "localhost.evil.example", "10.0.0.1"]


@pytest.mark.parametrize("host", OWN_NAMES)
def test_names_of_this_machine_are_served(addresses, host):
    assert get(addresses, "/healthz", Host=host)[0] == 200


@pytest.mark.parametrize("host", OTHER_NAMES)
def test_names_of_other_sites_are_refused(addresses, host):
    for path in ("/", "/healthz", "/status.json"):
        status, body = get(addresses, path, Host=host)
        assert status == 403
        assert body == b"Host: expected localhost or a loopback address\n"
