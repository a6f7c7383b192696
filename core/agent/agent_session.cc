#include "core/agent/agent_session.h"

#include <algorithm>
#include <map>
#include <string>
#include <utility>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Returns what follows from a verdict about the wiring of a session with these labels.
WiringResponse WiringResponseOf(const std::map<std::string, std::string>& labels,
                                const SessionObserver& observer) {
  const auto label = labels.find(kWiringLabel);
  if (label == labels.end()) return observer.wiring_response();
  return ParseEnum<WiringResponse>(kWiringLabel, label->second)
      .value_or(observer.wiring_response());
}

}  // namespace

AgentSession::AgentSession(std::shared_ptr<const ServedPolicy> served, Session session,
                           const Clock* clock)
    : served_(std::move(served)),
      clock_(clock),
      session_(std::move(session)),
      created_(clock->Now()),
      life_(session_.decisions, session_.episode),
      head_(served_, &session_),
      wiring_response_(WiringResponseOf(session_.options.labels, *served_->observer)),
      seat_(clock, session_) {}

void AgentSession::AddListener(std::shared_ptr<SessionListener> listener) {
  SPIKESERVE_DCHECK(listener != nullptr);
  listeners_.push_back(std::move(listener));
}

absl::StatusOr<const Answer*> AgentSession::Act(std::optional<int64_t> step,
                                                absl::Span<const float> observation, double reward,
                                                const std::optional<ReportedAction>& executed) {
  Step call = {.session = this,
               .place = {.step = step},
               .observation = observation,
               .reward = reward,
               .executed = executed};
  Apply({&call});
  if (!call.result.status.ok()) return call.result.status;
  return call.result.answer;
}

absl::StatusOr<EpisodeSummary> AgentSession::EndEpisode(
    const EpisodeEnd& end, const std::optional<ReportedAction>& executed) {
  Step call = {.session = this, .executed = executed, .end = end};
  Apply({&call});
  if (!call.result.status.ok()) return call.result.status;
  return *std::move(call.result.summary);
}

absl::Status AgentSession::AddBlindStep(double reward,
                                        const std::optional<ReportedAction>& executed) {
  if (blind_rewards_.empty() && executed.has_value() && !session_.history.empty()) {
    RETURN_IF_ERROR(ReportExecuted(*executed));
  }
  blind_rewards_.push_back(reward);
  return absl::OkStatus();
}

void AgentSession::AppendPendingAction() {
  AgentSession* const session = this;
  AppendPendingActions(absl::MakeConstSpan(&session, 1));
}

Help AgentSession::NeedsHelp() const {
  // A return-to-go that has grown asks for more than any episode begins with; one above 0 where all
  // returns are negative asks for what no episode can have.
  const double lacking = session_.return_to_go - std::max(session_.target_return, 0.0);
  // Training maps the returns from return_offset - return_scale to return_offset + return_scale to
  // [-1, 1].
  return life_.help().Now(lacking, 2.0 * static_cast<double>(policy().return_scale));
}

absl::Status AgentSession::TakeControl(const Seat& seat, bool takes_over) {
  const Seat* const before = this->seat();
  const bool renews = before != nullptr && before->lease_id == seat.lease_id;
  const bool has_ended = before == nullptr && session_.seat.has_value();
  const SeatChange change = before == nullptr ? SeatChange::kTaken : SeatChange::kTakenOver;
  RETURN_IF_ERROR(seat_.Take(seat, takes_over, &session_));
  if (has_ended) served_->observer->OnSeat(SeatChange::kEnded);
  if (!renews) {
    ++session_.interventions;
    served_->observer->OnSeat(change);
  }
  for (const auto& listener : listeners_) listener->OnChange(session_);
  return absl::OkStatus();
}

absl::Status AgentSession::ReturnControl(absl::string_view lease_id) {
  RETURN_IF_ERROR(seat_.Return(lease_id, &session_));
  ++session_.interventions;
  served_->observer->OnSeat(SeatChange::kReturned);
  for (const auto& listener : listeners_) listener->OnChange(session_);
  return absl::OkStatus();
}

std::optional<int64_t> AgentSession::UndoCorrections(absl::string_view operator_id,
                                                     absl::Duration ago) {
  const auto undone = head_.UndoCorrections(operator_id, ago, &session_);
  if (undone.value_or(0) > 0) {
    ++session_.interventions;
    for (const auto& listener : listeners_) listener->OnChange(session_);
  }
  return undone;
}

void AgentSession::Compact() {
  DropContext();
  session_.history.ShrinkToFit();
}

}  // namespace spikeserve
