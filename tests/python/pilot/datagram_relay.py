"""A route of datagrams to a server, in the process of the test: a NAT that loses, doubles, reorders, or drops them all."""

import contextlib
import random
import select
import socket
import threading


class DatagramRelay:
    """Forwards datagrams of robots to `target`, HOST:PORT, which may change, and takes them at `address`.

    Of them, `loss` are lost, `doubled` come twice and `reordered` come behind the next one, in each direction. `drops` is what a
    firewall does. After `rebind`, the server sees other addresses of the robots.
    """

    def __init__(self, seed=0, loss=0.0, doubled=0.0, reordered=0.0):
        self.target = ""
        self.loss, self.doubled, self.reordered = loss, doubled, reordered
        self.drops = False
        self.forwarded = 0
        self._random = random.Random(seed)
        self._inside = self._socket()
        self.address = "127.0.0.1:{}".format(self._inside.getsockname()[1])
        self._outside = {}  # by a robot's address: the socket that the server sees
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
        for each in (self._inside, self._ends, *self._outside.values()):
            each.close()

    def rebind(self):
        """Forwards from other ports; what comes to the old ones is lost."""
        with self._lock:
            for each in self._outside.values():
                each.close()
            self._outside = {}

    def _run(self):
        while True:
            with self._lock:
                robots = {outside: robot for robot, outside in self._outside.items()}
            # Soon looks at the sockets of rebind, which closes the others.
            with contextlib.suppress(OSError, ValueError):
                ready = self._ready([self._inside, self._ends, *robots])
                if self._ends in ready:
                    return
                if self._inside in ready:
                    data, robot = self._inside.recvfrom(2048)
                    host, _, port = self.target.rpartition(":")
                    self._forward("up", data, self._outside_of(robot), (host, int(port)))
                for outside in robots.keys() & set(ready):
                    self._forward("down", outside.recv(2048), self._inside, robots[outside])

    @staticmethod
    def _ready(sockets):
        """Waits for a moment, and returns those that have a datagram; also of processes with more files than select takes."""
        by_number = {each.fileno(): each for each in sockets}
        poller = select.poll()
        for number in by_number:
            poller.register(number, select.POLLIN)
        return [by_number[number] for number, _ in poller.poll(10)]

    def _outside_of(self, robot):
        with self._lock:
            if robot not in self._outside:
                self._outside[robot] = self._socket()
            return self._outside[robot]

    def _forward(self, way, *datagram):
        if self.drops or self._random.random() < self.loss:
            return
        if way not in self._kept and self._random.random() < self.reordered:
            self._kept[way] = datagram
            return
        copies = 2 if self._random.random() < self.doubled else 1
        for each in [datagram] * copies + [self._kept.pop(way, None)]:
            if each is not None:
                data, sender, to = each
                sender.sendto(data, to)
                self.forwarded += 1
