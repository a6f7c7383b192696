"""The list of the attacks, which begins with their control."""

import dataclasses
import typing

from tests.attacks import (
    client_attacks,
    control,
    gateway_attacks,
    http2_attacks,
    http_attacks,
    mutations,
    slow_attacks,
    store_attacks,
    tenant_attacks,
    tls_attacks,
)


UNAUTHENTICATEDS = 128  # megabytes: --max_unauthenticated_bytes
TENANT = 128  # megabytes: --max_tenant_bytes


@dataclasses.dataclass(frozen=True)
class Attack:
    """One attack: run(address, seconds), an address being (host, port), and what the server is started with."""

    run: typing.Callable
    tls: bool = False
    descriptors: int | None = None  # the server's limit
    budget: int | None = None  # megabytes of the server above idle, as docs/reference/limits.md promises; None: the transport's
    http: bool = False  # the address is that of the HTTP port
    flags: tuple = ()  # of the server; {folder} is an empty folder
    versions: int = 0  # of one small policy, beside the shipped ones
    gateway: bool = False  # the address is that of a gateway in front of the server, as is the neighbour's

    @property
    def name(self):
        """The name of the attack."""
        return self.run.__name__


ATTACKS = {
    attack.name: attack
    for attack in (
        Attack(control.traffic_elsewhere),
        Attack(http2_attacks.open_streams),
        Attack(http2_attacks.rapid_reset),
        Attack(http2_attacks.continuation),
        Attack(http2_attacks.long_header_value),
        Attack(http2_attacks.empty_continuation),
        Attack(http2_attacks.hpack_bomb),
        Attack(http2_attacks.table_sizes),
        Attack(http2_attacks.settings_flood),
        Attack(http2_attacks.settings_changes),
        Attack(http2_attacks.ping_flood),
        Attack(http2_attacks.priority_flood),
        Attack(http2_attacks.window_update_flood),
        Attack(http2_attacks.empty_data_flood),
        Attack(http2_attacks.unknown_frames),
        Attack(http2_attacks.refused_calls),
        Attack(mutations.mutated_frames),
        Attack(slow_attacks.slow_headers),
        Attack(slow_attacks.slow_body),
        Attack(slow_attacks.unfinished_messages),
        Attack(slow_attacks.zero_window),
        Attack(slow_attacks.no_reader),
        Attack(slow_attacks.no_reader_of_a_tenant),
        Attack(slow_attacks.silent_connections, descriptors=1024),
        Attack(slow_attacks.idle_connections, descriptors=1024),
        Attack(slow_attacks.connections_that_come_and_go),
        Attack(tenant_attacks.connections_of_many_addresses, budget=UNAUTHENTICATEDS),
        Attack(tenant_attacks.batches_of_empty_items, budget=TENANT),
        Attack(tenant_attacks.batches_of_short_items, budget=TENANT),
        Attack(tenant_attacks.batches_that_nobody_reads, budget=TENANT),
        Attack(tenant_attacks.policy_lists, budget=TENANT),
        Attack(tenant_attacks.rollout_decided_by_one_agent, budget=TENANT),
        Attack(
            tenant_attacks.exports_of_long_ids,
            budget=TENANT,
            flags=("--audit_log={folder}/audit.jsonl",),
        ),
        Attack(
            tenant_attacks.recordings_of_one_tenant,
            budget=TENANT,
            flags=("--record_dir={folder}/recordings",),
        ),
        Attack(tenant_attacks.reports_that_no_robot_makes, budget=TENANT),
        Attack(tenant_attacks.histories_of_many_sessions, budget=TENANT),
        Attack(http_attacks.bodies_beyond_the_rate, budget=TENANT, http=True),
        Attack(http_attacks.bodies_of_a_tenant_without_limits, budget=TENANT, http=True),
        Attack(http_attacks.guesses_of_a_token, budget=TENANT, http=True),
        Attack(http_attacks.viewers_of_many_versions, budget=TENANT, http=True, versions=1000),
        Attack(store_attacks.replies_of_a_lying_store, budget=TENANT),
        Attack(client_attacks.answers_of_a_lying_server, budget=TENANT),
        Attack(client_attacks.names_that_a_terminal_obeys, budget=TENANT),
        Attack(gateway_attacks.strangers_at_the_gateway, budget=TENANT, gateway=True),
        Attack(gateway_attacks.messages_of_many_values, budget=TENANT, gateway=True),
        Attack(gateway_attacks.errors_of_long_texts, budget=TENANT, gateway=True),
        Attack(gateway_attacks.frames_of_nothing, budget=TENANT, gateway=True),
        Attack(tls_attacks.half_handshakes, tls=True),
        Attack(tls_attacks.handshakes, tls=True),
        Attack(tls_attacks.slow_handshakes, tls=True),
        Attack(tls_attacks.broken_records, tls=True),
        Attack(tls_attacks.plain_text, tls=True),
        Attack(tls_attacks.renegotiation, tls=True),
        Attack(tls_attacks.frames_over_tls, tls=True),
        Attack(tls_attacks.tls_to_plain_text),
        Attack(tls_attacks.http1),
    )
}
