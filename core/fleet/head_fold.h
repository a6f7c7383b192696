// The heads of one policy version as the entries of their log leave them.
//
//   HeadFold fold(heads);
//   for (const LoggedEntry& entry : entries) fold.Fold(entry);
//
// Folds of the same entries have heads that are equal bit for bit: the merge, its bounds, the guard
// and the budgets depend on the entries alone. Not thread-safe, except that the
// heads may be read at any time.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <iterator>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/head_log.h"
#include "core/fleet/head_entry.h"
#include "core/learning/tenant_heads.h"

namespace spikeserve {

class HeadFold {
 public:
  // The outcomes of this many entries are stored, and the digests of this many are remembered.
  static constexpr ptrdiff_t kRemembered = 256;
  static constexpr size_t kDigestsRemembered = 1 << 14;

  // Starts before the first entry, with heads that have learned nothing.
  explicit HeadFold(std::shared_ptr<TenantHeads> heads) : heads_(std::move(heads)) {}

  const std::shared_ptr<TenantHeads>& heads() const { return heads_; }
  const HeadPosition& position() const { return position_; }
  bool paused() const { return paused_; }

  // What an entry has done. The drift of a rollback is that before it.
  struct Folded {
    HeadPosition position;
    std::string session;
    int64_t episode = 0;
    MergeOutcome outcome;
  };
  // Takes the next entry. Returns DATA_LOSS if it does not follow the last one, and
  // INVALID_ARGUMENT if it has a form that this release does not know; then nothing changes.
  absl::Status Fold(const LoggedEntry& entry);

  // Returns the outcome of an entry since ForgetOutcomes(), or of one of the last kRemembered
  // before; or nullopt.
  std::optional<MergeOutcome> Find(const std::string& session, int64_t episode) const;
  // Returns these entries, oldest first.
  const std::deque<Folded>& last() const { return last_; }
  void ForgetOutcomes();
  // Returns true if this fold remembers that it was at `position`.
  bool HasPassed(const HeadPosition& position) const;

  // Converts everything but the position to a binary form.
  std::string Serialize() const;
  // Continues from such a form, at `position`. INVALID_ARGUMENT if it is not that of heads of this
  // policy; then nothing changes.
  absl::Status Restore(const HeadPosition& position, const std::string& bytes);
  // Becomes equal to `other`.
  void TakeOver(const HeadFold& other);

 private:
  MergeOutcome Apply(const HeadEntry& entry, const LoggedEntry& logged);
  std::deque<Folded>::const_iterator FirstRemembered() const {
    return last_.end() - std::min(std::ssize(last_), kRemembered);
  }
  void Remember(const HeadPosition& position);

  const std::shared_ptr<TenantHeads> heads_;
  HeadPosition position_;
  bool paused_ = false;
  std::deque<Folded> last_;                // entries, oldest first
  std::map<int64_t, std::string> passed_;  // digests of positions, by their numbers
};

}  // namespace spikeserve
