#include "server/transport/grpc_wire.h"

#include <algorithm>
#include <cstdint>

#include "absl/algorithm/container.h"
#include "absl/strings/ascii.h"
#include "absl/strings/escaping.h"
#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"
#include "core/contract/dcheck.h"
#include "server/base/gzip.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

constexpr size_t kTimeoutDigits = 8;

// Returns zero for a character that is no unit.
absl::Duration TimeoutUnit(char unit) {
  switch (unit) {
    case 'H':
      return absl::Hours(1);
    case 'M':
      return absl::Minutes(1);
    case 'S':
      return absl::Seconds(1);
    case 'm':
      return absl::Milliseconds(1);
    case 'u':
      return absl::Microseconds(1);
    case 'n':
      return absl::Nanoseconds(1);
    default:
      return absl::ZeroDuration();
  }
}

// The longest message of a status. Clients refuse responses whose headers are larger than 8 KiB;
// each byte may become three, and the details contain the message again.
constexpr size_t kLongestMessage = 1200;
constexpr char kCut[] = "... (cut)";

// Returns a status with the beginning of the message, which ends with a whole character of UTF-8.
absl::Status Shortened(const absl::Status& status) {
  size_t length = kLongestMessage - sizeof(kCut);
  const absl::string_view message = status.message();
  while (length > 0 && (static_cast<uint8_t>(message[length]) & 0xC0) == 0x80) --length;
  absl::Status shortened(status.code(), absl::StrCat(message.substr(0, length), kCut));
  status.ForEachPayload([&](absl::string_view url, const absl::Cord& payload) {
    shortened.SetPayload(url, payload);
  });
  return shortened;
}

}  // namespace

MessagePrefix ParseMessagePrefix(absl::string_view bytes) {
  SPIKESERVE_DCHECK_GE(bytes.size(), kMessagePrefixBytes);
  const auto byte = [&](size_t i) { return static_cast<size_t>(static_cast<uint8_t>(bytes[i])); };
  return {.compressed = byte(0) != 0,
          .length = byte(1) << 24 | byte(2) << 16 | byte(3) << 8 | byte(4)};
}

absl::StatusOr<std::string> Decompress(absl::string_view encoding, absl::string_view message,
                                       size_t limit) {
  if (encoding != "gzip") {
    return absl::InternalError(
        "message: expected no compression, because the call announced none, received a compressed "
        "message");
  }
  const size_t longest = std::min(limit, kMostInflated);
  auto bytes = Gunzip(message, longest);
  if (absl::IsResourceExhausted(bytes.status())) {
    return absl::ResourceExhaustedError(
        absl::StrCat("message: expected at most ", longest,
                     " bytes of a compressed one, received more; send it without compression"));
  }
  if (!bytes.ok()) return absl::InternalError(absl::StrCat("message: ", bytes.status().message()));
  return bytes;
}

void AppendMessage(const google::protobuf::MessageLite& message, std::string* out) {
  const size_t length = message.ByteSizeLong();
  const size_t start = out->size();
  out->resize(start + kMessagePrefixBytes + length);
  auto* bytes = reinterpret_cast<uint8_t*>(out->data() + start);
  bytes[0] = 0;
  for (int i = 0; i < 4; ++i) bytes[1 + i] = static_cast<uint8_t>(length >> (24 - 8 * i));
  message.SerializeWithCachedSizesToArray(bytes + kMessagePrefixBytes);
}

StatusHeaders StatusHeadersOf(const absl::Status& status) {
  if (status.message().size() > kLongestMessage) return StatusHeadersOf(Shortened(status));
  StatusHeaders headers = {.code = absl::StrCat(static_cast<int>(status.code())),
                           .message = PercentEncode(status.message()),
                           .details = ""};
  const std::string details = SerializedDetails(status);
  if (!details.empty()) absl::Base64Escape(details, &headers.details);
  return headers;
}

std::string PercentEncode(absl::string_view text) {
  constexpr char kDigits[] = "0123456789ABCDEF";
  std::string encoded;
  for (const char c : text) {
    const auto byte = static_cast<uint8_t>(c);
    if (byte >= 0x20 && byte <= 0x7E && c != '%') {
      encoded.push_back(c);
    } else {
      encoded.append({'%', kDigits[byte >> 4], kDigits[byte & 15]});
    }
  }
  return encoded;
}

absl::StatusOr<absl::Duration> ParseTimeout(absl::string_view text) {
  int64_t count = 0;
  const absl::string_view digits = text.substr(0, text.empty() ? 0 : text.size() - 1);
  if (!digits.empty() && digits.size() <= kTimeoutDigits &&
      absl::c_all_of(digits, [](char c) { return absl::ascii_isdigit(c); }) &&
      absl::SimpleAtoi(digits, &count)) {
    const absl::Duration unit = TimeoutUnit(text.back());
    if (unit != absl::ZeroDuration()) return count * unit;
  }
  return InvalidArgument("grpc-timeout", "1 to 8 digits and one of H, M, S, m, u, n",
                         absl::StrCat("\"", text, "\""));
}

bool IsGrpcContentType(absl::string_view content_type) {
  if (!absl::ConsumePrefix(&content_type, "application/grpc")) return false;
  absl::ConsumePrefix(&content_type, "+proto");
  return content_type.empty() || content_type[0] == ';';
}

}  // namespace spikeserve
