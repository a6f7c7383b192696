"""What the replicas of the chaos suite keep their sessions in: one Redis, or a Cluster of three."""

import contextlib

from redis_servers import DURABLE, Redis, move_slot, start_cluster, stopping

from tests.chaos.network import STORE_ADDRESS

SLOTS = 8  # that move at once


class Store:
    """`nodes` are its Redis servers."""

    def __init__(self, nodes):
        self.nodes = nodes

    @property
    def url(self):
        """Returns the value of --session_store."""
        return "redis://" + ",".join(f"{STORE_ADDRESS}:{node.port}" for node in self.nodes)

    def command(self, words):
        """Runs a command on all nodes, and returns the replies."""
        return [node.command(words) for node in self.nodes]

    def entries(self):
        """Returns how many entries the log of the shared head has had: the number of the last one."""
        [(node, log)] = [(node, log) for node in self.nodes for log in node.command("KEYS fl:*")]
        [[identifier, [name, number, *_]]] = node.command(f"XREVRANGE {log.decode()} + - COUNT 1")
        assert name == b"n", f"log {log}, entry {identifier}: expected n first, received {name}"
        return int(number)

    def move_slots(self, random):
        """Moves slots that hold keys to other nodes of the Cluster."""
        for _ in range(SLOTS):
            source = random.choice([node for node in self.nodes if node.command("DBSIZE") > 0])
            target = random.choice([node for node in self.nodes if node is not source])
            key = source.command("RANDOMKEY")
            if key is not None:  # none has expired since
                slot = source.command(f"CLUSTER KEYSLOT {key.decode()}")
                move_slot(slot, source, target, self.nodes)


@contextlib.contextmanager
def running_store(cluster):
    """Starts the servers and yields the Store."""
    with stopping([]) as nodes:
        options = {"password": "", "host": "0.0.0.0"}
        if cluster:
            start_cluster(nodes, flags=(*DURABLE, "--cluster-announce-ip", STORE_ADDRESS), **options)
        else:
            nodes.append(Redis(*DURABLE, **options))
        yield Store(nodes)
