"""The command `python -m spikeserve.gateway`."""

from __future__ import annotations

import argparse
import asyncio
import pathlib
import signal
import sys

import grpc

from spikeserve.channels import ClientOptions
from spikeserve.check import check
from spikeserve.errors import SpikeserveError
from spikeserve.gateway.mapping import ObservationMapping, load_mapping
from spikeserve.printing import say
from spikeserve.values import SessionOptions


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m spikeserve.gateway",
        description="Answers clients of other robot stacks from a spikeserve server",
    )
    parser.add_argument(
        "--openpi", action="store_true", required=True, help="the protocol of openpi-client"
    )
    parser.add_argument("--policy", required=True, help="name of the policy")
    parser.add_argument("--version", type=int, default=0, help="0: the default version")
    parser.add_argument("--mapping", type=pathlib.Path, help="JSON file: which entries to observe")
    parser.add_argument("--listen", default="127.0.0.1:8000", help="HOST:PORT; port 0 picks one")
    parser.add_argument("--server", help="of spikeserve; default: $SPIKESERVE_SERVER")
    parser.add_argument("--ca", type=pathlib.Path, help="certificates for TLS to the server")
    parser.add_argument("--target-return", type=float, help="default: the policy's own")
    parser.add_argument("--record", action="store_true", help="the server records the sessions")
    parser.add_argument("--max-connections", type=int, default=512)
    parser.add_argument("--max-message-bytes", type=int, default=1 << 20)
    return parser


def _address(listen: str) -> tuple[str, int]:
    host, separator, port = listen.rpartition(":")
    valid = bool(separator) and port.isdigit() and int(port) < 1 << 16
    check(valid, "--listen", "HOST:PORT", listen)
    return host.strip("[]"), int(port)


async def _serve(arguments: argparse.Namespace) -> None:
    try:
        from spikeserve.gateway.openpi import GatewaySettings, OpenpiGateway, run
    except ModuleNotFoundError as error:
        extra = "the package, which the extra [gateway] of the client installs"
        check(error.name not in ("msgpack", "websockets"), str(error.name), extra, "none")
        raise
    host, port = _address(arguments.listen)
    for name in ("max_connections", "max_message_bytes"):
        value = getattr(arguments, name)
        check(value > 0, f"--{name.replace('_', '-')}", "a positive number", value)
    credentials = None
    if arguments.ca is not None:
        credentials = grpc.ssl_channel_credentials(arguments.ca.read_bytes())
    gateway = OpenpiGateway(
        GatewaySettings(
            policy=arguments.policy,
            session=SessionOptions(
                version=arguments.version,
                target_return=arguments.target_return,
                record=arguments.record,
                labels={"client": "openpi"},
            ),
            mapping=load_mapping(arguments.mapping) if arguments.mapping else ObservationMapping(),
            server=arguments.server,
            credentials=credentials,
            max_connections=arguments.max_connections,
            max_message_bytes=arguments.max_message_bytes,
            token=ClientOptions().token,
        )
    )
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    await run(gateway, host, port, stop)


def main() -> int:
    """Runs the command of sys.argv and returns the exit status."""
    arguments = _parser().parse_args()
    try:
        asyncio.run(_serve(arguments))
    except (ValueError, OSError, SpikeserveError) as error:
        say(f"spikeserve gateway: {error}", error=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
