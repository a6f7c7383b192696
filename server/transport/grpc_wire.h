// The text and byte formats of gRPC over HTTP/2.
//
// Source: gRPC's public specification, "gRPC over HTTP2" (PROTOCOL-HTTP2.md). Pure functions; safe
// to call from many threads.
#pragma once

#include <google/protobuf/message_lite.h>

#include <cstddef>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"

namespace spikeserve {

// Every message starts with one byte that is 1 if the message is compressed, and its length in four
// bytes, most significant first.
inline constexpr size_t kMessagePrefixBytes = 5;

struct MessagePrefix {
  bool compressed = false;
  size_t length = 0;
};

// REQUIRES: `bytes` has at least kMessagePrefixBytes.
MessagePrefix ParseMessagePrefix(absl::string_view bytes);

// The encodings of messages that are understood, as a `grpc-accept-encoding` header.
inline constexpr char kAcceptedEncodings[] = "identity,gzip";

// Decompresses a message that was sent with a `grpc-encoding`. It may have at most `limit` bytes
// and at most kMostInflated: the loop decompresses, and others wait for it. Returns INTERNAL if
// `encoding` is not gzip or `message` is not in it, RESOURCE_EXHAUSTED if it is too long.
inline constexpr size_t kMostInflated = 64 << 10;
absl::StatusOr<std::string> Decompress(absl::string_view encoding, absl::string_view message,
                                       size_t limit);

// Appends `message` with its prefix to `out`.
void AppendMessage(const google::protobuf::MessageLite& message, std::string* out);

// The headers that carry the status of a call, by name.
struct StatusHeaders {
  std::string code;     // grpc-status
  std::string message;  // grpc-message; empty: no header
  std::string details;  // grpc-status-details-bin; empty: no header
};

StatusHeaders StatusHeadersOf(const absl::Status& status);

// Returns the value of a `grpc-message` header: bytes other than printable ASCII, and '%', are
// written as %XX.
std::string PercentEncode(absl::string_view text);

// Parses a `grpc-timeout` header: one to eight digits and a unit, H, M, S, m, u or n. Returns
// INVALID_ARGUMENT for any other text.
absl::StatusOr<absl::Duration> ParseTimeout(absl::string_view text);

// Returns true if `content_type` is gRPC with protobuf messages: "application/grpc",
// "application/grpc+proto", or one of these followed by parameters.
bool IsGrpcContentType(absl::string_view content_type);

}  // namespace spikeserve
