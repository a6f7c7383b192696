"""The active OpenTelemetry span of the caller, which requests pass on to the server."""

from __future__ import annotations

import sys

TRACEPARENT = "traceparent"  # the metadata, as W3C Trace Context names it


def active_traceparent() -> str:
    """Returns the value of `traceparent` for the active span; "" if there is none.

    A program without OpenTelemetry has no spans, so this module imports nothing of it.
    """
    api = sys.modules.get("opentelemetry.trace")
    current = getattr(api, "get_current_span", None)  # None while it is being imported
    if current is None:
        return ""
    span = current().get_span_context()
    if not span.is_valid:
        return ""
    return f"00-{span.trace_id:032x}-{span.span_id:016x}-{int(span.trace_flags) & 0xFF:02x}"
