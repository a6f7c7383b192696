"""The control of the attacks: as much work for the machine, and none for the server.

The attacker, the server and the neighbour share the machine's cores. The latencies of the neighbour during an attack
therefore include what the attacker alone would do to them, which this measures.
"""

import contextlib
import multiprocessing
import selectors
import socket

from tests.attacks.flood import flood
from tests.attacks.http2_attacks import OPENING

CONNECTIONS = 4
RECEIVE_BYTES = 65536


def _discard(listener):
    """Accepts connections and reads what arrives on them, until the process is ended."""
    with selectors.DefaultSelector() as selector:
        selector.register(listener, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is listener:
                    selector.register(listener.accept()[0], selectors.EVENT_READ)
                    continue
                with contextlib.suppress(ConnectionError):
                    if key.fileobj.recv(RECEIVE_BYTES):
                        continue
                selector.unregister(key.fileobj)
                key.fileobj.close()


def traffic_elsewhere(_, seconds):
    """Sends frames to another process of the attacker, which only reads them."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        sink = multiprocessing.Process(target=_discard, args=(listener,), daemon=True)
        sink.start()
        try:
            return flood(
                listener.getsockname(), seconds, lambda: iter(lambda: OPENING * 100, None), CONNECTIONS
            )
        finally:
            sink.kill()
            sink.join()
