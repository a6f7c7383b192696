#include "server/agent/beat_requests.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

// How many beats are appended between two looks at the clock.
constexpr int64_t kBeatsPerLook = 4;
// So many steps are checked, or skipped, in less time than one beat takes.
constexpr int64_t kChecks = 128;

// Returns views of the beats of a request.
class RequestBeats {
 public:
  explicit RequestBeats(const v1::ActRequest& request) : request_(request) {}

  Beat operator()(size_t i) const {
    const v1::Beat& beat = request_.history(static_cast<int>(i));
    return {.step = beat.step(),
            .observation = beat.observation(),
            .reward = beat.reward(),
            .executed = FromProto(beat.executed()),
            .has_reward = beat.has_reward()};
  }

 private:
  const v1::ActRequest& request_;
};

// `beats` must outlive the result.
BeatHistory HistoryOf(const v1::ActRequest& request, const RequestBeats& beats) {
  return {.step = request.step(),
          .decision =
              request.has_decision() ? std::optional<uint64_t>(request.decision()) : std::nullopt,
          .skipped_rewards = request.skipped_rewards(),
          .size = static_cast<size_t>(request.history_size()),
          .beat = beats,
          .observation = request.observation(),
          .reward = request.reward(),
          .end_reward = request.has_end_episode()
                            ? std::optional<double>(request.end_episode().reward())
                            : std::nullopt};
}

// What no robot reports: a kilohertz for 30 years, and a gap of four months.
constexpr uint64_t kMostBeats = 1'000'000'000'000;
constexpr double kLongestGapSeconds = 1e7;

absl::Status CheckReport(const v1::BeatReport& report) {
  const std::pair<const char*, uint64_t> counts[] = {
      {"fresh", report.fresh()},
      {"held", report.held()},
      {"local", report.local()},
      {"safe", report.safe()},
      {"late_answers", report.late_answers()},
      {"cancelled_calls", report.cancelled_calls()},
      {"reconnects", report.reconnects()},
      {"invalid_observations", report.invalid_observations()}};
  for (const auto& [name, count] : counts) {
    if (count > kMostBeats) {
      return absl::InvalidArgumentError(
          absl::StrCat("report.", name, ": expected at most ", kMostBeats, ", received ", count));
    }
  }
  const std::pair<const char*, double> times[] = {
      {"longest_gap_seconds", report.longest_gap_seconds()},
      {"oldest_age_seconds", report.oldest_age_seconds()}};
  for (const auto& [name, seconds] : times) {
    if (!(seconds >= 0.0 && seconds <= kLongestGapSeconds)) {  // true for NaN
      return absl::InvalidArgumentError(absl::StrCat("report.", name, ": expected 0 to ",
                                                     kLongestGapSeconds, ", received ", seconds));
    }
  }
  return absl::OkStatus();
}

// Notes the time and the report of a request. Returns the errors of the times.
absl::Status TakeNews(const v1::ActRequest& request, absl::Duration received,
                      SessionObserver& observer, bool is_new_session, RobotLink* robot) {
  if (request.has_valid_until() && !request.has_observed_at()) {
    return absl::InvalidArgumentError(
        "observed_at: expected a time, because the request has valid_until, received none");
  }
  if (request.has_observed_at() && request.observed_at() < 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("observed_at: expected at least 0, received ", request.observed_at()));
  }
  if (request.has_report()) {
    RETURN_IF_ERROR(CheckReport(request.report()));
  }
  if (request.has_observed_at()) {
    robot->OnRequest(received, absl::Nanoseconds(request.observed_at()));
  }
  if (request.has_report()) {
    const auto added = robot->OnReport(FromProto(request.report()), is_new_session, received);
    if (added.has_value()) {
      observer.OnReport(*added);
    } else {
      observer.OnImplausible();
    }
  }
  return absl::OkStatus();
}

bool IsExpired(const v1::ActRequest& request, absl::Duration now, const RobotLink& robot) {
  if (!request.has_valid_until()) return false;
  const absl::Duration observed_at = absl::Nanoseconds(request.observed_at());
  return robot.LeastAge(now, observed_at) > absl::Nanoseconds(request.valid_until()) - observed_at;
}

}  // namespace

std::optional<ReportedAction> ExecutedBefore(const v1::ActRequest& request) {
  if (request.history_size() > 0) {
    const v1::Beat& last = request.history(request.history_size() - 1);
    if (last.observation().empty()) return std::nullopt;  // the session has skipped it
    return FromProto(last.executed());
  }
  if (!request.has_executed_action()) return std::nullopt;
  return FromProto(request.executed_action());
}

absl::StatusOr<bool> TakeBeats(const v1::ActRequest& request, absl::Duration received,
                               const Clock& clock, SessionObserver& observer, bool is_new_session,
                               AgentSession* agent, RobotLink* robot, BeatBudget* budget,
                               BeatProgress* progress,
                               absl::FunctionRef<void(const Beat&)> on_appended) {
  const absl::Duration start = clock.Now();
  if (!progress->started) {
    if (auto status = TakeNews(request, received, observer, is_new_session, robot); !status.ok()) {
      return status;
    }
    progress->started = true;
  }
  if (!HasPastBeats(request)) {
    progress->expired = IsExpired(request, start, *robot);
    // A request for an answer that was given is answered.
    if (progress->expired && request.step() < agent->session().step) progress->expired = false;
    if (progress->expired) observer.OnExpired();
    return !progress->expired;
  }
  const RequestBeats beats(request);
  BeatHistory history = HistoryOf(request, beats);
  const bool is_late = !request.observation().empty() && IsExpired(request, start, *robot);
  if (is_late) history.observation = {};  // no decision follows the beats
  progress->finished = false;
  if (!progress->checked) {
    const auto checks = static_cast<int64_t>(history.size + history.skipped_rewards.size());
    if (budget->beats > 0) budget->beats = std::max<int64_t>(1, budget->beats - checks / kChecks);
  }
  while (!progress->finished && budget->beats > 0) {
    history.is_checked = progress->checked;
    const auto done =
        AppendBeats(history, agent, std::min(budget->beats, kBeatsPerLook), on_appended);
    --budget->beats;  // also for what is refused
    if (!done.ok()) return done.status();
    budget->beats -= std::max<int64_t>(0, done->appended - 1) + done->dropped / kChecks;
    progress->checked = true;
    progress->appended += done->appended;
    progress->dropped += done->dropped;
    agent->CountMissingRewards(done->missing_rewards);
    if (done->dropped > 0) observer.OnSkippedBeats(done->dropped);
    progress->finished = done->finished;
    if (clock.Now() >= budget->until) budget->beats = 0;
  }
  progress->spent += clock.Now() - start;
  if (!progress->finished) return false;
  // Asks again for an answer that was given, or for none.
  if (request.step() < agent->session().step) return !request.observation().empty();
  progress->expired = is_late;
  if (is_late) observer.OnExpired();
  if (!progress->expired && !request.observation().empty()) return true;
  RETURN_IF_ERROR(TakeLastExecuted(history, agent));
  return false;
}

void FillBeats(const v1::ActRequest& request, const BeatProgress& progress, const Session& session,
               absl::Duration received, absl::Duration begun, v1::ActResponse* response) {
  response->set_session_id(request.session_id());
  response->set_step(request.step());
  if (request.has_observed_at()) response->set_observed_at(request.observed_at());
  response->set_next_step(session.step);
  response->set_appended(progress.appended);
  response->set_dropped(progress.dropped);
  response->set_expired(progress.expired);
  const absl::Duration queued = begun - received - progress.spent;
  response->set_queue_seconds(absl::ToDoubleSeconds(std::max(queued, absl::ZeroDuration())));
  response->set_append_seconds(absl::ToDoubleSeconds(progress.spent));
}

BeatCounts FromProto(const v1::BeatReport& report) {
  return {.fresh = report.fresh(),
          .held = report.held(),
          .local = report.local(),
          .safe = report.safe(),
          .late_answers = report.late_answers(),
          .cancelled_calls = report.cancelled_calls(),
          .reconnects = report.reconnects(),
          .invalid_observations = report.invalid_observations(),
          .longest_gap_seconds = report.longest_gap_seconds(),
          .oldest_age_seconds = report.oldest_age_seconds()};
}

void ToProto(const BeatCounts& counts, v1::BeatReport* report) {
  report->set_fresh(counts.fresh);
  report->set_held(counts.held);
  report->set_local(counts.local);
  report->set_safe(counts.safe);
  report->set_late_answers(counts.late_answers);
  report->set_cancelled_calls(counts.cancelled_calls);
  report->set_reconnects(counts.reconnects);
  report->set_invalid_observations(counts.invalid_observations);
  report->set_longest_gap_seconds(counts.longest_gap_seconds);
  report->set_oldest_age_seconds(counts.oldest_age_seconds);
}

}  // namespace spikeserve
