// Tells a session that the store has lost from one that never was, or has ended.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include "absl/status/status.h"
#include "absl/strings/cord.h"

namespace spikeserve {

inline constexpr char kLostSessionUrl[] = "spikeserve/lost-session";

// Returns `status`, of a claim that has found nothing, with the mark that the store says nothing of
// an end of the session either. The mark is for this server: it is not to reach a caller.
inline absl::Status MarkLost(absl::Status status) {
  status.SetPayload(kLostSessionUrl, absl::Cord());
  return status;
}

// Returns whether MarkLost() has made the status.
inline bool IsLost(const absl::Status& status) {
  return status.GetPayload(kLostSessionUrl).has_value();
}

}  // namespace spikeserve
