// The part of Link that sends requests and takes replies.
#include <algorithm>
#include <utility>

#include "client/src/item_status.h"
#include "client/src/pilot/link.h"
#include "client/src/steady_time.h"
#include "spikeserve/status.h"

namespace spikeserve::piloting {

void Link::OpenStream() {
  {
    absl::MutexLock lock(&state_->mutex);
    replica_ = replicas_->Choose(*route_, without_);
    if (had_stream_) ++state_->counters.counts().reconnects;
    had_stream_ = true;
    state_->is_connected = true;
    state_->ends_on_stream = !waits_for_merge_;
  }
  Listener* const listener = this;
  stream_ = std::make_unique<ActionStream>(&replica_->connection, *route_, listener);
}

void Link::DropStream() {
  const bool is_renewed = stream_->IsRenewed();
  stream_.reset();
  absl::MutexLock lock(&state_->mutex);
  const auto end = std::exchange(stream_end_, std::nullopt);
  if (!end.has_value()) return;
  if (is_renewed) {
    next_try_ = -absl::InfiniteDuration();
    return;
  }
  ReplicaFailed();
  LogFailure(end->ok() ? absl::UnavailableError("the server ended the stream") : *end);
  PauseTries();
}

void Link::SendRequest() {
  v1::ActRequest request;
  {
    absl::MutexLock lock(&state_->mutex);
    const absl::Duration now = SteadyNow();
    const bool is_end = !state_->log.is_current();
    if (!is_end) state_->queued.reset();
    if (is_end ? !MaySendEnd(now) : !state_->is_connected) return;
    const RobotEpisode& episode = state_->log.asked();
    state_->log.FillRequest(&request);
    request.set_session_id(state_->session_id);
    const bool ends = is_end && state_->ends_on_stream && state_->log.FitsOne();
    if (ends) {
      state_->log.FillEnd(request.mutable_end_episode());
      state_->log.BeginEnd();
    }
    if (request.has_observed_at()) {
      request.set_valid_until(request.observed_at() + absl::ToInt64Nanoseconds(options_.oldest()));
    }
    v1::BeatReport report;
    if (state_->counters.FillReport(now, &report)) *request.mutable_report() = std::move(report);
    state_->under_way.Push({.episode = episode.index,
                            .number = episode.first + static_cast<uint64_t>(request.step()),
                            .sent = now,
                            .ends = ends,
                            .asks = request.observation_size() > 0});
  }
  stream_->Send(std::move(request));
}

void Link::OnReply(const v1::ActResponse& reply) {
  const absl::Duration now = SteadyNow();
  absl::MutexLock lock(&state_->mutex);
  if (!state_->is_connected || state_->under_way.empty()) return;
  // An answer alone is no work for the background thread.
  const bool may_work = reply.has_error() || !state_->log.is_current() || state_->log.is_ending() ||
                        state_->queued.has_value();
  const SentRequest request = state_->under_way.Pop();
  replied_at_ = now;
  replica_->connection.Answered();
  replicas_->Answered(*route_, *replica_);
  if (reply.has_error()) {
    ++state_->counters.counts().cancelled_calls;
    TakeError(StatusOfItem(reply.error()), request);
  } else if (request.episode == state_->log.oldest().index) {
    Succeeded();
    state_->log.ForgetDurable(reply.durable_decision(), reply.durable_episode());
    if (request.ends) {
      TakeEnd(reply);
    } else {
      state_->log.Acknowledge(reply.next_step());
      if (reply.has_action()) TakeAnswer(reply, request, now);
    }
  }
  if (may_work) state_->NotifyWork();
}

void Link::TakeEnd(const v1::ActResponse& reply) {
  if (reply.has_ended()) {
    v1::EndEpisodeResponse summary = reply.ended();
    Ending ending = Settle(&summary);
    settled_.emplace_back(std::move(ending), std::move(summary));
    return;
  }
  // A server of an earlier release has taken the beats, and ignored the end.
  state_->ends_on_stream = false;
  state_->log.AbandonEnd();
  state_->log.Acknowledge(reply.next_step());
}

void Link::TakeAnswer(const v1::ActResponse& reply, const SentRequest& request,
                      absl::Duration now) {
  const absl::Duration took = now - request.sent;
  state_->round_trip = state_->round_trip.has_value()
                           ? *state_->round_trip + (took - *state_->round_trip) / 8
                           : took;
  const absl::Duration observed_at = absl::Nanoseconds(reply.observed_at());
  const absl::Duration age = RobotNow() - observed_at;
  PilotStats& counts = state_->counters.counts();
  if (age > options_.period) ++counts.late_answers;
  if (age > options_.oldest()) {
    // More requests would only make the queue longer.
    state_->window = std::max<size_t>(1, state_->window / 2);
    ++counts.stale;
    return;
  }
  state_->window = std::min(state_->window + 1, options_.most_in_flight());
  Decision& newest = state_->answer;
  if (newest.is_there && request.number <= newest.number) return;
  newest.is_there = state_->fallback.shape().Fit(ViewOf(reply.action()), &newest.action);
  newest.number = request.number;
  newest.observed_at = observed_at;
  newest.is_miswired = reply.wiring().is_safe_action();
  state_->has_decision.notify_all();
}

void Link::TakeError(const absl::Status& error, const SentRequest& request) {
  const auto expected = ExpectedDecision(error);
  const bool is_oldest = request.episode == state_->log.oldest().index;
  const bool is_end = request.ends && is_oldest;
  if (is_end) state_->log.AbandonEnd();
  if (expected.has_value()) {
    // A request behind an end that failed, or one that was sent twice, fails without consequence.
    if (!is_oldest) return;
    // The server has lost what it had acknowledged, the ends of episodes, too, and gets it again.
    // If it has lost nothing, it has another end of the episode.
    const bool is_kept = state_->log.Rewind(*expected, ExpectedEpisode(error));
    const bool is_same = request.episode == state_->log.oldest().index;
    if (!is_kept || (is_end && is_same && state_->log.is_complete())) GiveUp(error);
  } else if (const auto after = RetryAfter(error)) {
    state_->paused_until = SteadyNow() + *after;
  } else if (absl::IsNotFound(error) && MayBeElsewhere(replica_)) {
    LogFailure(error);
    PauseTries();
    EndStream();
  } else if (absl::IsNotFound(error) || absl::IsFailedPrecondition(error) ||
             absl::IsInvalidArgument(error) || absl::IsDataLoss(error)) {
    GiveUp(error);
  } else {
    LogFailure(error);
    PauseTries();
    ReplicaFailed();
    EndStream();
  }
}

void Link::OnEnd(const absl::Status& status) {
  absl::MutexLock lock(&state_->mutex);
  if (!state_->is_connected) return;  // the pilot has ended it
  stream_end_ = status;
  EndStream();
}

void Link::EndStream() {
  if (!state_->is_connected) return;
  state_->is_connected = false;
  state_->counters.counts().cancelled_calls += state_->under_way.size();
  state_->under_way.Clear();
  state_->log.AbandonEnd();
  state_->queued.reset();
  state_->window = options_.most_in_flight();
  state_->NotifyWork();
  state_->has_decision.notify_all();  // nobody waits for answers that are lost
}

}  // namespace spikeserve::piloting
