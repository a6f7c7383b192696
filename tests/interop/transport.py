"""Which transport the server under test uses, for the cases in which the transports differ."""

import os
import re
import subprocess


def _transport():
    """Returns the value of --transport: of SPIKESERVE_SERVER_FLAGS, otherwise the default of the program."""
    pattern = r"--transport[= ](?:grpc\|nghttp2.*\[)?(\w+)"
    help_text = subprocess.run(
        [os.environ["SPIKESERVE_PROGRAM"], "--help"], check=False, capture_output=True, text=True
    ).stdout
    for text in (os.environ.get("SPIKESERVE_SERVER_FLAGS", ""), help_text):
        if found := re.search(pattern, text):
            return found[1]
    return "grpc"


NGHTTP2 = _transport() == "nghttp2"
