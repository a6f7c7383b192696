// The methods of PolicyHandler that amend episodes after their ends.
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "server/agent/policy_handler.h"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

constexpr size_t kLongestId = 64;
constexpr size_t kLongestText = 128;

absl::Status CheckLength(const char* field, const std::string& text, size_t least, size_t most) {
  if (text.size() >= least && text.size() <= most) return absl::OkStatus();
  return InvalidArgument(field, absl::StrCat(least, " to ", most, " bytes"), text.size());
}

absl::Status CheckRewards(const v1::AmendEpisodeRequest& request) {
  const auto check = [](const std::string& field, double reward) {
    return std::abs(reward) <= kLargestDataNumber
               ? absl::OkStatus()
               : InvalidArgument(field, "a finite number of at most 1e18", reward);
  };
  RETURN_IF_ERROR(check("reward", request.reward()));
  for (int i = 0; i < request.rewards_size(); ++i) {
    RETURN_IF_ERROR(check(absl::StrCat("rewards[", i, "]"), request.rewards(i)));
  }
  return absl::OkStatus();
}

// Returns the line that a recording gets.
absl::StatusOr<EpisodeAmendment> LineFromProto(const v1::AmendEpisodeRequest& request,
                                               const Credential& caller) {
  const bool says_something = request.rewards_size() > 0 || request.has_reward() ||
                              request.has_success() || !request.label().empty();
  if (!says_something) {
    return absl::InvalidArgumentError(
        "rewards: expected these, reward, success or label, received none of them");
  }
  v1::AmendEpisodeRequest content = request;
  content.clear_session_id();
  content.clear_amendment_id();
  if (content.author().empty()) content.set_author(caller.name());
  RETURN_IF_ERROR(CheckLength("amendment_id", request.amendment_id(), 1, kLongestId));
  RETURN_IF_ERROR(CheckLength("author", content.author(), 0, kLongestText));
  RETURN_IF_ERROR(CheckLength("label", request.label(), 0, kLongestText));
  RETURN_IF_ERROR(CheckRewards(request));
  EpisodeAmendment line = {.id = request.amendment_id(),
                           .digest = Sha256Of(content.SerializeAsString()),
                           .author = content.author(),
                           .time = absl::FormatTime(absl::Now(), absl::UTCTimeZone()),
                           .rewards = {request.rewards().begin(), request.rewards().end()},
                           .label = request.label()};
  if (request.has_reward()) line.reward = request.reward();
  if (request.has_success()) line.success = request.success();
  return line;
}

// Returns the error for a verdict that the session has, if its recording could not be amended.
absl::Status NotWritten(const absl::Status& cause) {
  return Annotate(cause,
                  "recording: expected the verdict, which the session has, to be written, too; "
                  "send the same request again");
}

}  // namespace

absl::Status PolicyHandler::AmendEpisode(CallContext& context,
                                         const v1::AmendEpisodeRequest& request,
                                         v1::AmendEpisodeResponse* response) const {
  ASSIGN_OR_RETURN(const EpisodeAmendment line, LineFromProto(request, *context.caller));
  const std::string& tenant = context.caller->tenant()->name();
  auto entry = gate_->Find(context, request.session_id());
  if (const auto closed = store_->closed().Find(request.session_id(), tenant);
      !entry.ok() && closed != nullptr) {
    entry = closed;
  }
  if (entry.ok()) {
    RETURN_IF_ERROR(CheckMayPlay(*context.caller, **entry));
    const Amendment amendment = {.episode = request.episode(),
                                 .id = line.id,
                                 .digest = line.digest,
                                 .rewards = line.rewards,
                                 .reward = line.reward.value_or(0.0)};
    return AmendSession(context, amendment, line, **entry, response);
  }
  if (recordings_ == nullptr) return entry.status();
  const auto amended = recordings_->Amend(request.session_id(), tenant, request.episode(), line);
  // A stored session of this id is claimed first.
  if (absl::IsNotFound(amended.status())) return entry.status();
  if (!amended.ok()) return amended.status();
  response->set_episode_return(amended->after);
  response->set_recording(v1::STORED);
  return absl::OkStatus();
}

absl::Status PolicyHandler::AmendSession(CallContext& context, const Amendment& amendment,
                                         const EpisodeAmendment& line, SessionEntry& entry,
                                         v1::AmendEpisodeResponse* response) const {
  std::string recording;
  absl::StatusOr<Verdict> verdict;
  {
    absl::MutexLock lock(&entry.mutex);
    const Session& session = entry.agent.session();
    if (entry.journal != nullptr) entry.journal->WriteAgainIfMissing(session);
    if (amendment.episode >= session.episode) {
      // Another server may have ended it since; then this copy is lost.
      const auto refused = SessionGate::Refused(
          context, {.episode = amendment.episode + 1},
          absl::NotFoundError(absl::StrCat("episode: expected one that has ended, below ",
                                           session.episode, ", received ", amendment.episode)),
          entry);
      const bool is_here = entry.journal == nullptr || !entry.journal->lost();
      if (is_here) context.may_claim = context.has_claimed = false;
      return refused;
    }
    const uint64_t before = entry.journal == nullptr ? 0 : entry.journal->written();
    verdict = entry.agent.Amend(amendment);
    recording = session.options.recording;
    const bool waits = verdict.ok() || !absl::IsNotFound(verdict.status());
    if (waits) {
      const bool has_written = entry.journal != nullptr && entry.journal->written() != before;
      AddCommit(entry, has_written ? Await::kOwned : Await::kConfirmed, &context.commits);
    }
    const auto& contribution = entry.agent.contribution();
    if (verdict.ok() && !context.commits.empty() && contribution != nullptr &&
        contribution->value().episode == amendment.episode) {
      context.commits.back().contribution = contribution;
    }
    if (!verdict.ok() && waits) return verdict.status();
  }
  absl::StatusOr<Recordings::AmendedReturn> amended = absl::NotFoundError("not recorded");
  if (recordings_ != nullptr && !recording.empty()) {
    amended =
        recordings_->Amend(recording, context.caller->tenant()->name(), amendment.episode, line);
  }
  if (!verdict.ok() && !amended.ok()) {
    // The session is here: what is missing is the episode.
    context.may_claim = context.has_claimed = false;
    return absl::IsNotFound(amended.status()) ? verdict.status() : amended.status();
  }
  if (!amended.ok() && !absl::IsNotFound(amended.status())) return NotWritten(amended.status());
  if (amended.ok()) response->set_recording(v1::STORED);
  if (verdict.ok()) {
    response->set_episode_return(verdict->episode_return);
    if (verdict->learning.has_value()) {
      *response->mutable_learning() = ToProto(*verdict->learning);
    }
    return absl::OkStatus();
  }
  response->set_episode_return(amended->after);
  if (!amended->is_new) return absl::OkStatus();
  absl::MutexLock lock(&entry.mutex);
  entry.agent.OnAmended(amendment.episode, amended->after - amended->before);
  return absl::OkStatus();
}

}  // namespace spikeserve
