#include "core/journal/session_export.h"

#include <cstdint>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/journal/session_bytes.h"
#include "core/learning/learning_options.h"

namespace spikeserve {
namespace {

constexpr size_t kChecksumBytes = 8;

// Returns the 64-bit FNV-1a hash of the bytes, least significant byte first.
std::string ChecksumOf(absl::string_view bytes) {
  uint64_t hash = 0xcbf29ce484222325;
  for (const char byte : bytes) {
    hash ^= static_cast<unsigned char>(byte);
    hash *= 0x100000001b3;
  }
  std::string checksum;
  for (size_t i = 0; i < kChecksumBytes; ++i) {
    checksum.push_back(static_cast<char>(hash >> (8 * i)));
  }
  return checksum;
}

}  // namespace

bool IsFrozenByExport(const Session& session) {
  return session.options.learning.has_value() && session.options.learning->scope == Scope::kFleet;
}

std::string ExportSession(const AgentSession& agent) {
  Session session = agent.session();
  if (session.last_answer.has_value()) {
    session.last_answer->compute_seconds = 0.0;
    session.last_answer->source = {};
    session.last_answer->hold.reset();
  }
  session.seat.reset();  // an operator is heard by the server alone
  if (IsFrozenByExport(session)) {
    session.options.head_delta = agent.HeadDelta();
    session.options.learning.reset();
    session.learner.reset();
    session.pending = nullptr;
  }
  std::string bytes = SerializeSession(session);
  absl::StrAppend(&bytes, ChecksumOf(bytes));
  return bytes;
}

absl::StatusOr<Session> ImportSession(absl::string_view value) {
  const size_t size = value.size() < kChecksumBytes ? 0 : value.size() - kChecksumBytes;
  if (value.substr(size) != ChecksumOf(value.substr(0, size))) {
    return InvalidArgument("session", "the value that ExportSession returned",
                           absl::StrCat(value.size(), " bytes with a wrong checksum"));
  }
  return ParseSession(std::string(value.substr(0, size)));
}

}  // namespace spikeserve
