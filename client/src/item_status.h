// The status of one item of a batch or a stream.
#pragma once

#include <cstdint>
#include <optional>

#include "absl/status/status.h"
#include "spikeserve/status.h"

namespace spikeserve {

// Converts the status of a v1::ActResult or v1::ActError.
template <typename Item>
absl::Status StatusOfItem(const Item& item) {
  std::optional<double> retry_after;
  if (item.has_retry_after_seconds()) retry_after = item.retry_after_seconds();
  std::optional<uint64_t> decision;
  if (item.has_expected_decision()) decision = item.expected_decision();
  std::optional<int64_t> episode;
  if (item.has_expected_episode()) episode = item.expected_episode();
  return ForSession(StatusFromCode(item.code(), item.message(), retry_after, decision, episode));
}

}  // namespace spikeserve
