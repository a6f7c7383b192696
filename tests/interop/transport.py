"""Which transport the server under test uses, for the cases in which the transports differ."""

import os

NGHTTP2 = "--transport=nghttp2" in os.environ.get("SPIKESERVE_SERVER_FLAGS", "")
