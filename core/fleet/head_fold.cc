#include "core/fleet/head_fold.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"
#include "core/journal/session_fields.h"
#include "core/learning/fleet_head.h"

namespace spikeserve {
namespace {

constexpr char kHeadsFormat[] = "spikeserve.heads.v1";

struct StoredHead {
  std::string tenant;
  FleetHead::State state;
};

struct StoredHeads {
  bool paused = false;
  std::vector<StoredHead> heads;
  std::vector<HeadFold::Folded> last;
};

// Returns the time at which Redis has made the entry.
absl::Duration TimeOf(const HeadPosition& position) {
  int64_t milliseconds = 0;
  const absl::string_view id = position.id;
  if (!absl::SimpleAtoi(id.substr(0, id.find('-')), &milliseconds)) return absl::ZeroDuration();
  return absl::Milliseconds(milliseconds);
}

}  // namespace

SPIKESERVE_FIELDS(ContributionBudget::Account, in_window, in_minute, suspended_windows)

SPIKESERVE_FIELDS(ContributionBudget, contributors, accounts, minute_ms, total_in_minute)

SPIKESERVE_FIELDS(PeerNorms, contributors, norms)

SPIKESERVE_FIELDS(FleetHead::Gathered, contributor, delta)

SPIKESERVE_FIELDS(FleetHead::State, delta, gathered, guard, held_out_guard, budget, held_out_budget,
                  norms, updates, rejected, trimmed, rollbacks)
inline size_t MoreFields(const FleetHead::State& state) { return state.past == nullptr ? 0 : 1; }
SPIKESERVE_MORE_FIELDS(FleetHead::State, past)

template <Is<FleetHead::Kept> T, typename Visitor>
void VisitFields(T& kept, Visitor&& visit) {
  visit("contributor", kept.contribution.contributor);
  visit("held_out", kept.contribution.held_out);
  visit("operators", kept.contribution.operators);
  visit("delta", kept.contribution.delta);
  visit("episode_return", kept.contribution.episode_return);
  visit("time_ms", kept.time_ms);
  visit("members", kept.members);
}

SPIKESERVE_FIELDS(FleetHead::Past, base, kept, forgotten_ms)

SPIKESERVE_FIELDS(HeadPosition, id, number, digest)

SPIKESERVE_FIELDS(MergeOutcome, paused, update, rolled_back, drift, watched_return)
inline size_t MoreFields(const MergeOutcome& outcome) { return outcome.undone == 0 ? 0 : 1; }
SPIKESERVE_MORE_FIELDS(MergeOutcome, undone)

SPIKESERVE_FIELDS(HeadFold::Folded, position, session, episode, outcome)

namespace {

SPIKESERVE_FIELDS(StoredHead, tenant, state)

SPIKESERVE_FIELDS(StoredHeads, paused, heads, last)

}  // namespace

absl::Status HeadFold::Fold(const LoggedEntry& entry) {
  if (entry.position.number != position_.number + 1 ||
      entry.position.digest != NextDigest(position_.digest, entry)) {
    return absl::DataLossError(absl::StrCat("expected the entry after ", position_.number,
                                            ", received number ", entry.position.number));
  }
  ASSIGN_OR_RETURN(const auto parsed, ParseHeadEntry(entry.bytes));
  const bool merges = parsed.kind == HeadEntry::Kind::kMerge;
  const auto size = static_cast<Eigen::Index>(heads_->policy()->weights.head.weight.values.size());
  if (merges && parsed.contribution.delta.size() != size) {
    return InvalidArgument("delta", absl::StrCat(size, " numbers"),
                           parsed.contribution.delta.size());
  }
  if (parsed.kind == HeadEntry::Kind::kUndo && parsed.contribution.operators.empty()) {
    return InvalidArgument("operators", "that of an undo", "none");
  }
  position_ = entry.position;
  Remember(position_);
  last_.push_back({.position = position_,
                   .session = parsed.contribution.session,
                   .episode = parsed.contribution.episode,
                   .outcome = Apply(parsed, entry)});
  return absl::OkStatus();
}

MergeOutcome HeadFold::Apply(const HeadEntry& entry, const LoggedEntry& logged) {
  MergeOutcome outcome;
  switch (entry.kind) {
    case HeadEntry::Kind::kPause:
    case HeadEntry::Kind::kResume:
      paused_ = entry.kind == HeadEntry::Kind::kPause;
      return outcome;
    case HeadEntry::Kind::kRollback:
      outcome.drift = heads_->Of(entry.contribution.head)->Rollback()->drift;
      return outcome;
    case HeadEntry::Kind::kUndo:
      return heads_->Of(entry.contribution.head)
          ->Undo(entry.contribution.operators.front(),
                 absl::Seconds(entry.contribution.episode_return), TimeOf(logged.position));
    case HeadEntry::Kind::kMerge:
      break;
  }
  const std::shared_ptr<FleetHead> head = heads_->Of(entry.contribution.head);
  if (!paused_) {
    return head->Merge(entry.contribution, TimeOf(logged.position),
                       static_cast<size_t>(std::max<int64_t>(logged.members, 0)));
  }
  const auto snapshot = head->Read();
  return {.paused = true, .drift = snapshot->drift, .watched_return = snapshot->level.mean};
}

std::optional<MergeOutcome> HeadFold::Find(const std::string& session, int64_t episode) const {
  const auto found = std::find_if(last_.begin(), last_.end(), [&](const Folded& folded) {
    return folded.session == session && folded.episode == episode;
  });
  if (found == last_.end()) return std::nullopt;
  return found->outcome;
}

void HeadFold::ForgetOutcomes() { last_.erase(last_.begin(), FirstRemembered()); }

bool HeadFold::HasPassed(const HeadPosition& position) const {
  if (position.number == 0) return true;
  const auto found = passed_.find(position.number);
  return found != passed_.end() && found->second == position.digest;
}

void HeadFold::Remember(const HeadPosition& position) {
  passed_.insert_or_assign(position.number, position.digest);
  if (passed_.size() > kDigestsRemembered) passed_.erase(passed_.begin());
}

std::string HeadFold::Serialize() const {
  StoredHeads stored = {.paused = paused_, .heads = {}, .last = {FirstRemembered(), last_.end()}};
  for (const std::string& tenant : heads_->Tenants()) {
    stored.heads.push_back({.tenant = tenant, .state = heads_->Of(tenant)->state()});
  }
  return codec::Serialize(kHeadsFormat, stored);
}

absl::Status HeadFold::Restore(const HeadPosition& position, const std::string& bytes) {
  ASSIGN_OR_RETURN(const StoredHeads stored,
                   codec::Parse<StoredHeads>(bytes, "heads", kHeadsFormat));
  const FleetHead any(heads_->policy());
  for (const StoredHead& head : stored.heads) {
    if (!any.IsPossible(head.state)) {
      return InvalidArgument("heads",
                             absl::StrCat("a head of the policy as that of tenant ", head.tenant),
                             "another one");
    }
  }
  for (const StoredHead& head : stored.heads) heads_->Of(head.tenant)->Restore(head.state);
  position_ = position;
  paused_ = stored.paused;
  last_ = {stored.last.begin(), stored.last.end()};
  passed_.clear();
  for (const Folded& folded : last_) Remember(folded.position);
  Remember(position);
  return absl::OkStatus();
}

void HeadFold::TakeOver(const HeadFold& other) {
  // Heads that the other one does not have become like new.
  for (const std::string& tenant : heads_->Tenants()) other.heads_->Of(tenant);
  for (const std::string& tenant : other.heads_->Tenants()) {
    heads_->Of(tenant)->Restore(other.heads_->Of(tenant)->state());
  }
  // What came before stays known if the other one continues it.
  if (!other.HasPassed(position_)) passed_.clear();
  for (const auto& [number, digest] : other.passed_) passed_.insert_or_assign(number, digest);
  while (passed_.size() > kDigestsRemembered) passed_.erase(passed_.begin());
  position_ = other.position_;
  paused_ = other.paused_;
  last_ = other.last_;
}

}  // namespace spikeserve
