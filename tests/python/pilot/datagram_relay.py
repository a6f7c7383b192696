"""A route of datagrams to a server, in the process of the test: a NAT that loses, doubles, reorders, or drops them all."""

import contextlib
import random
import select
import socket
import threading


class DatagramRelay:
    """Forwards datagrams to `target`, HOST:PORT, which may change, and takes them at `address`.

    Of them, `loss` are lost, `doubled` come twice and `reordered` come behind the next one, in each direction. `drops` is what a
    firewall does. After `rebind`, the server sees another address of the robot.
    """

    def __init__(self, target="", seed=0):
        self.target = target
        self.loss = self.doubled = self.reordered = 0.0
        self.drops = False
        self.forwarded = 0
        self._random = random.Random(seed)
        self._inside, self._outside = self._socket(), self._socket()
        self.address = "127.0.0.1:{}".format(self._inside.getsockname()[1])
        self._robot = None  # its address
        self._kept = {}  # by direction, a datagram that comes behind the next one
        self._ends, self._end = socket.socketpair()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @staticmethod
    def _socket():
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        bound.bind(("127.0.0.1", 0))
        return bound

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._end.close()
        self._thread.join()
        for each in (self._inside, self._outside, self._ends):
            each.close()

    def rebind(self):
        """Forwards from another port; what comes to the old one is lost."""
        with self._lock:
            self._outside.close()
            self._outside = self._socket()

    def _run(self):
        while True:
            with self._lock:
                inside, outside = self._inside, self._outside
            # Soon looks at the socket of rebind.
            with contextlib.suppress(OSError, ValueError):
                ready, _, _ = select.select([inside, outside, self._ends], [], [], 0.01)
                if self._ends in ready:
                    return
                if inside in ready:
                    data, self._robot = inside.recvfrom(2048)
                    host, _, port = self.target.rpartition(":")
                    self._forward("up", data, outside, (host, int(port)))
                if outside in ready:
                    self._forward("down", outside.recv(2048), inside, self._robot)

    def _forward(self, way, data, sender, to):
        if self.drops or self._random.random() < self.loss:
            return
        if way not in self._kept and self._random.random() < self.reordered:
            self._kept[way] = data
            return
        copies = 2 if self._random.random() < self.doubled else 1
        for each in [data] * copies + [self._kept.pop(way, None)]:
            if each is not None:
                sender.sendto(each, to)
                self.forwarded += 1
