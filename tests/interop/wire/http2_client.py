"""A client of HTTP/2 frames: sends what it is told, also what no client of gRPC would send."""

import dataclasses
import socket
import struct

import h2.config
import h2.connection
import h2.events
import h2.settings
from serving import DEADLINE_SECONDS

GOAWAY = 7  # frame type


def headers(path, **changes):
    """Returns the headers of a call. `changes` replaces values; None leaves a header out."""
    fields = {
        ":method": "POST",
        ":scheme": "http",
        ":path": path,
        ":authority": "localhost",
        "te": "trailers",
        "content-type": "application/grpc",
    }
    for name, value in changes.items():
        name = name.replace("_", "-")
        fields[f":{name}" if f":{name}" in fields else name] = value
    return [(name, value) for name, value in fields.items() if value is not None]


def framed(message, compressed=0):
    """Returns the bytes of a message as gRPC sends them: one flag byte, the length, the message."""
    body = message if isinstance(message, bytes) else message.SerializeToString()
    return struct.pack(">BI", compressed, len(body)) + body


@dataclasses.dataclass
class Answer:
    """What a server sent on one stream."""

    headers: dict = dataclasses.field(default_factory=dict)
    trailers: dict = dataclasses.field(default_factory=dict)
    data: bytes = b""
    ended: bool = False
    reset: int | None = None  # error code of RST_STREAM

    @property
    def grpc_status(self):
        """The status of the call as an integer, or None if the server sent none."""
        status = self.trailers.get("grpc-status", self.headers.get("grpc-status"))
        return None if status is None else int(status)

    @property
    def grpc_message(self):
        """The percent-encoded status message."""
        return self.trailers.get("grpc-message", self.headers.get("grpc-message", ""))

    def messages(self):
        """Returns the messages in the data received so far, without their prefixes."""
        rest, found = self.data, []
        while len(rest) >= 5 and len(rest) >= 5 + (length := struct.unpack(">I", rest[1:5])[0]):
            found.append(rest[5 : 5 + length])
            rest = rest[5 + length :]
        return found


class Http2Client:
    """One connection in plain text. Every wait ends after DEADLINE_SECONDS with an error."""

    def __init__(self, address, initial_window=65535, grant_windows=True):
        host, _, port = address.rpartition(":")
        self.socket = socket.create_connection((host, int(port)), timeout=DEADLINE_SECONDS)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        config = h2.config.H2Configuration(
            header_encoding="utf-8",
            validate_outbound_headers=False,
            normalize_outbound_headers=False,
        )
        self.h2 = h2.connection.H2Connection(config)
        self._grant_windows = grant_windows
        self.h2.initiate_connection()
        self.answers = {}
        self._received = b""
        self.goaway = None  # error code of the last GOAWAY
        self.pings = 0
        self.closed = False
        self.h2.update_settings({h2.settings.SettingCodes.INITIAL_WINDOW_SIZE: initial_window})
        self.flush()
        while (
            self.h2.local_settings.initial_window_size != initial_window
        ):  # until the server acknowledges
            self.receive()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def flush(self):
        try:
            self.socket.sendall(self.h2.data_to_send())
        except ConnectionError:
            self.closed = True

    def begin(self, request_headers, end=False):
        """Sends the headers of a call. Returns the stream's id."""
        stream = self.h2.get_next_available_stream_id()
        self.answers[stream] = Answer()
        self.h2.send_headers(stream, request_headers, end_stream=end)
        self.flush()
        return stream

    def send(self, stream, data, end=False, **options):
        """Sends data on a stream, as the server's flow control allows, until the server has answered the call."""
        while len(data) > (room := self._room(stream)):
            if self.answers[stream].ended:
                return
            if room > 0:
                self.h2.send_data(stream, data[:room])
                data = data[room:]
                self.flush()
            else:
                self.receive()
        self.h2.send_data(stream, data, end_stream=end, **options)
        self.flush()

    def _room(self, stream):
        return min(self.h2.local_flow_control_window(stream), self.h2.max_outbound_frame_size)

    def call(self, path, *messages, **changes):
        """Makes a call and returns its Answer."""
        stream = self.begin(headers(path, **changes))
        self.send(stream, b"".join(framed(message) for message in messages), end=True)
        return self.wait(stream)

    def wait(self, stream, until=lambda answer: answer.ended or answer.reset is not None):
        """Reads until `until(answer)` of a stream is true. Returns the Answer."""
        answer = self.answers[stream]
        while not until(answer):
            assert not self.closed, (
                f"the server closed the connection: {answer}, GOAWAY: {self.goaway}"
            )
            self.receive()
        return answer

    def wait_for_ping(self):
        """Waits until the server has read all that was sent before."""
        answered = self.pings
        self.h2.ping(b"\x00\x01\x02\x03\x04\x05\x06\x07")
        self.flush()
        while self.pings == answered:
            self.receive()

    def wait_closed(self):
        """Reads until the server closes the connection."""
        while not self.closed:
            self.receive()

    def receive(self):
        """Reads once from the socket and handles what came."""
        try:
            data = self.socket.recv(1 << 16)
        except ConnectionError:
            data = b""
        if not data:
            self.closed = True
            return
        for event in self.h2.receive_data(self._without_goaway(data)):
            self._handle(event)
        self.flush()

    def _without_goaway(self, data):
        """Returns the complete frames received so far, except GOAWAY, after which the h2 package takes no frame."""
        self._received += data
        frames = b""
        while len(self._received) >= 9:
            length = 9 + int.from_bytes(self._received[:3])
            if len(self._received) < length:
                break
            frame, self._received = self._received[:length], self._received[length:]
            if frame[3] == GOAWAY:
                self.goaway = int.from_bytes(frame[13:17])
            else:
                frames += frame
        return frames

    def _handle(self, event):
        answer = self.answers.get(getattr(event, "stream_id", None))
        match event:
            case h2.events.ResponseReceived():
                answer.headers = dict(event.headers)
            case h2.events.TrailersReceived():
                answer.trailers = dict(event.headers)
            case h2.events.DataReceived():
                answer.data += event.data
                if self._grant_windows and event.flow_controlled_length:
                    self.h2.acknowledge_received_data(event.flow_controlled_length, event.stream_id)
            case h2.events.StreamEnded():
                answer.ended = True
            case h2.events.StreamReset():
                answer.reset = event.error_code
            case h2.events.PingAckReceived():
                self.pings += 1
